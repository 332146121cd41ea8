"""Noise of pairs of frames, and the part that all pixels of a row, or of a column, share.

A few rows hold few independent values of row noise, which would hide the photon noise of flats. It
is subtracted from flats, line by line, and its covariances are added back as measured in frames
without light, which have many more rows.
"""

import math

import numpy as np

from pixcal.estimators.detector.emva import Measure
from pixcal.kernels.medians import SIGMA_OF_MAD, median_and_sigma
from pixcal.kernels.photon_transfer import BLOCK, COLUMNS, LAGS, bin_pairs, pair_statistics
from pixcal.kernels.robust import lit, median_and_deviation
from pixcal.model.arrays import F32, F64

LINES = {"row": ((0, 1), (0, 2)), "column": ((1, 0), (2, 0))}  # lags along a line
# As far along a line, and to the next one.
_ASLANT = {"row": ((1, 1), (1, 2)), "column": ((1, 1), (2, 1))}

_SHARED = 5.0  # significance (errors) from which the noise shared by lines counts
_OUT = 5.0  # standard deviations of outlying samples
_PAIR_LAMP_CHANGE = 0.05
_NEARLY = 5.0  # standard deviations below saturation from which a pixel's noise is clipped
_ROUNDS = 12  # each leaves less than a third of the part that block means removed
# Pixels from one to the next along a line. No filter of a camera reaches the last.
_ALONG = (1, BLOCK // 4, BLOCK // 2 - 1)
_NO_BLOCKS = np.zeros((0, COLUMNS))


def shared_by_lines(dark: F64) -> dict[str, Measure]:
    """Temporal variance that all pixels of a row, or of a column, share, with its error (ADU²).

    ``dark``: (N_BINS, COLUMNS) sums of `bin_pairs`. Zero where it is not significant.
    """
    total = dark.sum(axis=0)
    if not total[0]:
        return {}
    error = total[2] / total[0] / math.sqrt(total[0])
    covariance = dict(zip(map(tuple, LAGS.tolist()), total[3:] / total[0], strict=True))
    # Coupling reaches lag 1 only, a repeat of every second row lag 2 only; line noise has both.
    seen = np.array([min(covariance[lag] for lag in own) for own in LINES.values()])
    kept, taken = BLOCK / (BLOCK + 1), (BLOCK - 1) / BLOCK**2
    # Neighbouring rows share noise, or columns do: that of rows depends on the rows between pixels.
    near, rows, columns, far = (covariance[lag] for lag in ((1, 1), (1, 2), (2, 1), (2, 2)))
    of_rows = (near - rows) ** 2 + (columns - far) ** 2
    of_columns = (near - columns) ** 2 + (rows - far) ** 2
    smooth, other = (1, 0) if of_columns < of_rows else (0, 1)
    # What rows share, and what block means took off, drops out of the difference of pairs in one
    # column and in two, which is the noise of columns; or the other way round.
    name, shared = tuple(LINES)[other], np.empty(2)
    pairs = zip(LINES[name], _ASLANT[name], strict=True)
    apart = min(covariance[along] - covariance[aslant] for along, aslant in pairs)
    shared[other] = apart / (kept + taken)
    # Subtracting block means took as much off the covariances of one line, and of lines one and two
    # apart. It is more where every second line repeats the noise. Waves of any period have at least
    # as much at one line as at two.
    left = np.array([seen[smooth], columns if smooth else rows, far]) + taken * shared[other]
    own, next_one, second = left * (1 - BLOCK**-2)
    removed = 0.0
    for _ in range(_ROUNDS):
        repeated = max(second + removed - abs(next_one + removed), 0.0)
        removed = (own + removed) / BLOCK + 2 * (BLOCK - 2) / BLOCK**2 * repeated
    shared[smooth] = own + removed
    errors = np.where(np.arange(2) == other, math.sqrt(2), 1) * error
    return {
        name: (float(own) if own > _SHARED * error else 0.0, error)
        for name, own, error in zip(LINES, shared, errors.tolist(), strict=True)
    }


def shared_by_blocks(difference: F32, quantum: float) -> float:
    """Variance (ADU²) of a sample that the pixels of a block share beyond chance.

    It comes from lines, outputs and large-scale variation, without the level of the whole frame.
    `pair_statistics` removes it with its block means. ``difference``: (y, x) of two frames without
    light, of full blocks; outliers are excluded.
    """
    blocks = _clipped(difference, quantum).reshape(-1, BLOCK**2)
    within = float(blocks.var(axis=1, ddof=1).mean()) / BLOCK**2
    return float(blocks.mean(axis=1).var(ddof=1) - within) / 2


def _clipped(difference: F32, quantum: float) -> F64:
    """Blocks (n, BLOCK, BLOCK) of a difference of frames, less its median; zero for outliers."""
    tiles = difference.reshape(len(difference) // BLOCK, BLOCK, -1, BLOCK)
    blocks = tiles.swapaxes(1, 2).reshape(-1, BLOCK, BLOCK).astype(float)
    middle, sigma = median_and_sigma(blocks)
    blocks -= middle
    blocks[~(np.abs(blocks) <= _OUT * max(sigma, quantum))] = 0
    return blocks


def along_lines(difference: F32, quantum: float) -> F64:
    """Covariances (2 lines, 3 lags) of pixels along a row, and along a column (ADU²).

    Noise of a whole line is the same at all lags, and that of outputs many columns wide falls
    evenly: the lags are next, far, and midway. Noise of a filter is at the first only.
    ``difference``: as in `shared_by_blocks`.
    """
    blocks = _clipped(difference, quantum)
    turned = blocks, blocks.swapaxes(1, 2)
    products = [[(b[:, :, :-lag] * b[:, :, lag:]).mean() for lag in _ALONG] for b in turned]
    return np.array(products) / 2


def dark_pair_sums(
    frames: F32, read_noise: float, quantum: float, without: tuple[str, ...] = ()
) -> F64:
    """Sums (N_BINS, COLUMNS) over frames 0 and 1, 2 and 3, … without light.

    ``frames``: (t, y, x) less their common level (ADU); NaN where a sample is not to be used.
    ``read_noise, quantum``: as in `pair_statistics`. ``without``: lines whose common noise is
    subtracted.
    """
    pairs = zip(frames[::2], frames[1::2], strict=False)
    guess = {"gain": np.inf, "read_noise": read_noise, "quantum": quantum}
    blocks = [_blocks(a, b, without, **guess) for a, b in pairs]
    return bin_pairs(np.concatenate([_NO_BLOCKS, *blocks]))


def flat_pair_sums(
    frames: F32,
    levels: F32,
    gain: float,
    read_noise: float,
    quantum: float,
    line_noise: "LineNoise",
    full: F32 | float = np.inf,
    dark: float = 0.0,
    bands: bool = True,
) -> F64:
    """As above for flats (2, N_BINS, COLUMNS): of the frames, and without noise that rows share.

    The two frames of a pair are scaled to equal level. `without_bands` takes the result.

    frames : (t, y, x) ADU above bias and dark
    levels : (t,) their common levels, in any unit; pairs that differ too much are not used
    gain, read_noise, quantum : as in `pair_statistics`
    line_noise : of these pixels
    full : (y, x) or scalar, where samples saturate, ADU above bias and dark
    dark : dark signal, ADU: it has shot noise too, and belongs to the level
    bands : whether rows may share more than without light; if not, both results are the first
    """
    lines = line_noise.lines or ()
    also_rows = tuple(dict.fromkeys((*lines, "row"))) if bands else lines
    blocks = {without: [_NO_BLOCKS] for without in (lines, also_rows)}
    for n in range(0, len(frames) - 1, 2):
        (a, b), (first, second) = levels[n : n + 2], frames[n : n + 2]
        if not np.isfinite(a + b) or abs(a - b) > _PAIR_LAMP_CHANGE * (a + b) / 2:
            continue
        first, second = first * ((a + b) / (2 * a)), second * ((a + b) / (2 * b))
        level = (first + second) / 2
        noise = np.sqrt(read_noise**2 + np.maximum(level, 0) / gain)
        # The noise of nearly full pixels is clipped, that of another colour beside them is not.
        # Full pixels beside those of an overscan would pass for half-full ones without noise.
        first[~lit(level) | (level + _NEARLY * noise > full)] = np.nan
        guess = {"gain": gain, "read_noise": read_noise, "quantum": quantum}
        for without, parts in blocks.items():
            parts.append(_blocks(first, second, without, **guess))
    joined = {}
    for without, parts in blocks.items():
        every = np.concatenate(parts)
        every[:, 1] += dark * (every[:, 0] > 0)
        joined[without] = line_noise.put_back(bin_pairs(every))
    return np.stack([joined[lines], joined[also_rows]])


def without_bands(lit: F64, rest: F64) -> F64:
    """Sums of flats: ``rest``, without the noise that rows share, if that exceeds its error.

    A lamp that flickers while rows are exposed one by one makes bands, which are no photon noise.
    """
    noise = lit[:, 2].sum()
    shared = noise - rest[:, 2].sum()
    return rest if shared > noise * math.sqrt(2 / max(lit[:, 0].sum(), 1)) else lit


def _blocks(first: F32, second: F32, without: tuple[str, ...], **guess: float) -> F64:
    if not np.isfinite(first + second).any():
        return _NO_BLOCKS
    others = []
    for name in without:
        # One column for each line.
        lines = np.ascontiguousarray((first - second).T if name == "row" else first - second)
        middle, deviation = median_and_deviation(lines)
        used = np.abs(lines - middle) <= _OUT * SIGMA_OF_MAD * deviation + guess["quantum"]
        number = used.sum(axis=0)
        # Medians of integers would be too coarse.
        means = np.where(used, lines, 0).sum(axis=0) / np.maximum(number, 1)
        second = second + (means[:, None] if name == "row" else means).astype(np.float32)
        others.append(max(number[number > 0].mean() - 1, 1))
    blocks = pair_statistics(first, second, **guess)
    for name, number in zip(without, others, strict=True):
        across = 0 if name == "row" else 1
        # Of each variance, and of each covariance along the line; neighbours share noise, too.
        along = LAGS[:, across] == 0
        taken = (blocks[:, 2] + 2 * blocks[:, 3:] @ along) / number
        blocks[:, 2] += taken
        blocks[:, 3:] += np.outer(taken, along)
        # A block's mean varies less without lines, and took less off each of them.
        blocks[:, 2:] -= taken[:, None] / min(BLOCK, first.shape[across])
    return blocks


class LineNoise:
    """Noise that pixels of lines share, with all its covariances, from frames without light."""

    def __init__(self) -> None:
        self.lines: tuple[str, ...] | None = None
        self._whole, self._rest = np.zeros((2, COLUMNS))

    def add(self, frames: F32, sums: F64, read_noise: float, quantum: float) -> None:
        """Add frames as in `dark_pair_sums`, and its ``sums``; the first decide which lines."""
        if self.lines is None:
            self.lines = tuple(name for name, (own, _) in shared_by_lines(sums).items() if own)
        if self.lines:
            self._whole += sums.sum(axis=0)
            self._rest += dark_pair_sums(frames, read_noise, quantum, self.lines).sum(axis=0)

    def put_back(self, sums: F64) -> F64:
        """Sums with the noise of lines added back, as measured in frames without light."""
        if self.lines:
            shared = self._whole[2:] / self._whole[0] - self._rest[2:] / self._rest[0]
            sums[:, 2:] += sums[:, :1] * shared
        return sums
