"""Quantiles of more numbers than memory holds."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from pixcal.model.arrays import F32, F64

_DIGIT = 16  # bits of a number sorted per pass


def quantiles_of_parts(
    parts: Callable[[], Iterable[F32]], levels: Sequence[float] | F64
) -> tuple[F64, int]:
    """Quantiles of positive finite numbers given in parts (n,), equal to `numpy.quantile` of all.

    Returns them (empty without numbers) and the count of numbers; ``parts`` is called twice.
    """
    # The bits of positive floats, read as integers, have the order of their values.
    counts = np.zeros(1 << _DIGIT, np.int64)
    for part in parts():
        counts += np.bincount(part.view(np.uint32) >> _DIGIT, minlength=len(counts))
    n = int(counts.sum())
    if not n:
        return np.zeros(0), 0
    at = np.asarray(levels) * (n - 1)
    ranks = np.stack([np.floor(at), np.ceil(at)]).astype(np.int64)
    before = np.cumsum(counts) - counts
    first = np.searchsorted(before, ranks, side="right") - 1
    within = {int(digit): np.zeros(1 << _DIGIT, np.int64) for digit in np.unique(first)}
    for part in parts():
        bits = part.view(np.uint32)
        for digit, tally in within.items():
            of_digit = bits[bits >> _DIGIT == digit] & ((1 << _DIGIT) - 1)
            tally += np.bincount(of_digit, minlength=len(tally))
    upto = {digit: np.cumsum(tally) for digit, tally in within.items()}
    values = np.empty(ranks.shape, np.float32)
    for place in np.ndindex(ranks.shape):
        digit = int(first[place])
        rank = ranks[place] - before[digit]
        last = int(np.searchsorted(upto[digit], rank, side="right"))
        values[place] = np.array(digit << _DIGIT | last, np.uint32).view(np.float32)
    shares = at - ranks[0]
    return np.array([np.quantile(v, s) for v, s in zip(values.T, shares, strict=True)]), n
