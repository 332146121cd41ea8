"""Standard normals of pixels, each a function of a key, its frame and its place.

Philox4x32-10 (Salmon et al., SC'11) turns a counter of four words and a key of two into four random
words; two of them make a pair of normals (Box and Muller 1958). The counter is the place and the
frame, so results do not depend on how work is divided, and there is no state to initialise.

Measured on one core (AMD EPYC, Zen 5), 128 x 128 pixels: 2 ns per normal. Logarithm, sine and
cosine are those of Cephes in single precision, written out so that the compiler vectorises them.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels import inner, kernel
from pixcal.model.arrays import F32

Key = tuple[int, int]  # two words of 32 bits
U32 = NDArray[np.uint32]

_ROUNDS = 10
_TIMES = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL = np.uint32(0x9E3779B9), np.uint32(0xBB67AE85)
_HALF_WORD = np.uint64(32)
_ROOT_HALF = np.int32(0x3F3504F3)  # bits of 1/sqrt(2)
_MANTISSA = np.int32(0x007FFFFF)
_LOG_2 = np.float32(math.log(2))
_LOG = tuple(
    np.float32(c)
    for c in (
        7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1,
        -1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1,
    )
)  # fmt: skip
_SINE = tuple(np.float32(c) for c in (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1))
_COSINE = tuple(np.float32(c) for c in (2.443315711809948e-5, -1.388731625493765e-3, 4.1666646e-2))
_TURN = np.float32(2 * math.pi / 2**32)


def pixel_normals(key: Key, frame: int, rows: tuple[int, int], columns: int) -> F32:
    """Two independent arrays (2, y, x) of standard normals for rows of the window.

    Other keys give other numbers. ``rows``: the first and the one after the last; the numbers of a
    row do not depend on this range. ``columns``: width of the window.
    """
    first, last = rows[0] // 2, -(-rows[1] // 2)
    pairs = np.empty((2, last - first, 2, columns), np.float32)
    words = np.empty((4, columns), np.uint32)
    _fill(np.uint32(key[0]), np.uint32(key[1]), np.uint32(frame), first, words, pairs)
    skip = rows[0] - 2 * first
    every = pairs.reshape(2, -1, columns)
    return every[:, skip : skip + rows[1] - rows[0]]


@kernel()
def philox(
    a: np.uint32, b: np.uint32, c: np.uint32, d: np.uint32, key: np.uint32, other: np.uint32
) -> Any:
    """Four random words of a counter (a, b, c, d) and a key."""
    for _ in range(_ROUNDS):
        one, two = _TIMES[0] * np.uint64(a), _TIMES[1] * np.uint64(c)
        a, b, c, d = (
            np.uint32(two >> _HALF_WORD) ^ b ^ key,
            np.uint32(two),
            np.uint32(one >> _HALF_WORD) ^ d ^ other,
            np.uint32(one),
        )
        key, other = np.uint32(key + _WEYL[0]), np.uint32(other + _WEYL[1])
    return a, b, c, d


@kernel()
def _fill(
    key: np.uint32, other: np.uint32, frame: np.uint32, first: int, words: U32, pairs: F32
) -> None:
    """Fill (2, pair of rows, 2, x) from pair ``first`` on: one counter for each pair and column."""
    # ``words`` (4, x) is scratch.
    for i in range(pairs.shape[1]):
        _draw(np.uint32(first + i), frame, key, other, words)
        _box_muller(words[0], words[1], pairs[0, i, 0], pairs[1, i, 0])
        _box_muller(words[2], words[3], pairs[0, i, 1], pairs[1, i, 1])


@inner()
def _draw(row: np.uint32, frame: np.uint32, key: np.uint32, other: np.uint32, words: U32) -> None:
    """Words (4, x) of a pair of rows, in a separate loop so that the compiler vectorises it."""
    for x in range(words.shape[1]):
        a, b, c, d = philox(np.uint32(x), row, frame, np.uint32(0), key, other)
        words[0, x], words[1, x], words[2, x], words[3, x] = a, b, c, d


@inner()
def _box_muller(radius: U32, angle: U32, one: F32, other: F32) -> None:
    """Pairs of normals (x,) from pairs of words, within ±6.8."""
    for x in range(len(radius)):
        uniform = (np.float32(radius[x]) + np.float32(0.5)) * np.float32(2.0**-32)
        size = math.sqrt(np.float32(-2) * _log(uniform))
        cosine, sine = _circle(angle[x])
        one[x], other[x] = size * cosine, size * sine


@inner()
def _log(value: np.float32) -> np.float32:
    """Natural logarithm of a positive number."""
    bits = np.int32(np.float32(value).view(np.int32) - _ROOT_HALF)
    exponent = np.int32(bits >> np.int32(23))
    mantissa = np.int32((bits & _MANTISSA) + _ROOT_HALF)
    x = mantissa.view(np.float32) - np.float32(1)
    series = _LOG[0]
    for c in _LOG[1:]:
        series = series * x + c
    square = x * x
    return x * square * series - np.float32(0.5) * square + x + np.float32(exponent) * _LOG_2


@inner()
def _circle(word: np.uint32) -> Any:
    """Cosine and sine of a word as a fraction of a turn."""
    turn = np.int32(word)
    quarter = np.int32(np.int32(turn + np.int32(1 << 29)) >> np.int32(30))  # the nearest
    x = np.float32(np.int32(turn - np.int32(quarter << np.int32(30)))) * _TURN
    square = x * x
    s = ((_SINE[0] * square + _SINE[1]) * square + _SINE[2]) * square * x + x
    c = ((_COSINE[0] * square + _COSINE[1]) * square + _COSINE[2]) * square * square
    c = c - np.float32(0.5) * square + np.float32(1)
    between = (quarter & np.int32(1)) != 0
    cosine, sine = (s, c) if between else (c, s)
    cosine = -cosine if ((quarter + np.int32(1)) & np.int32(2)) != 0 else cosine
    return cosine, (-sine if (quarter & np.int32(2)) != 0 else sine)
