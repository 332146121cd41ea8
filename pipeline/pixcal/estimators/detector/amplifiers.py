"""Amplifiers of slightly different gain: steps that occur both in the flat and in the noise.

A response step between two blocks of columns or rows is a gain step if the shot noise steps with
it. The amplifier with more e-/ADU gives fewer ADU for the same light, and its noise, computed with
the common gain, is smaller by the same factor. If instead the pixels respond differently, the noise
follows the light and has no step.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander

from pixcal.kernels.medians import robust_sigma
from pixcal.model.arrays import F64, I64, Mask

MAX_BOUNDARIES = 7  # most boundaries along each axis
NARROWEST = 8  # fewest rows or columns of an amplifier
SIGNIFICANT = 6.0  # standard deviations of a step of the flat
SMOOTH = (0, 1, 2)  # degrees of the lamp's variation
# The same of noise over light: a curved response follows the lamp, which is mostly even about the
# middle. A tilt would take half of what a step shows.
EVEN = (0, 2)
CERTAIN = 4.0  # the same of a step of the noise, to name the outputs
_TILE = 32  # side (px) of the blocks to which a trend is fitted


def relative_gain(flat: F64, noise: F64, good: Mask) -> F64:
    """Gain (y, x) of every pixel's amplifier over the mean; exactly 1 where no boundary was found.

    ``flat``: (y, x) relative response. ``noise``: (y, x) mean square of samples over that expected.
    """
    log_gain = np.zeros(flat.shape)
    response, squares = _used(flat, noise, good)
    for axis in (0, 1):
        along = _profile(response, axis)
        steps = [np.arange(len(along)) >= at for at in _boundaries(along)]
        if not steps:
            continue
        size, _ = _sizes(along, steps)
        in_noise, error = _sizes(_profile(squares, axis), steps)
        for number, step in enumerate(steps):
            of_gain = (in_noise[number] - size[number]) ** 2 < in_noise[number] ** 2
            clear = abs(size[number]) > 2 * error[number]
            if of_gain and clear:
                log_gain -= np.expand_dims(size[number] * step, 1 - axis)
    return np.asarray(np.exp(log_gain - log_gain.mean()))


def _used(flat: F64, noise: F64, good: Mask) -> tuple[F64, F64]:
    """Logarithms of the response, and noise (y, x); NaN in pixels that are not used."""
    used = good & (flat > 0) & (noise > 0)
    response = np.where(used, np.log(np.where(used, flat, 1.0)), np.nan)
    return response, np.where(used, noise, np.nan)


@dataclass(frozen=True)
class Outputs:
    """Outputs whose gains differ, according to both flat and noise."""

    names: list[str]  # which rows and columns each output reads
    gain: F64  # gain, error: (output,) over the mean, by the noise
    error: F64
    of_pixel: F64  # (y, x) gain of each pixel's output over the mean, by the flat


def differing_outputs(
    flat: F64, noise: F64, good: Mask, first: tuple[int, int] = (0, 0)
) -> Outputs | None:
    """Outputs of blocks of rows and columns, or of alternate ones; None if no gains differ.

    flat, noise : (y, x) relative response, and shot variance over light, of each pixel
    good : (y, x)
    first : row and column of the first pixel, for the names
    """
    response, ratio = _used(flat, noise, good)
    used = np.isfinite(response)
    if not used.any():
        return None
    ratio /= np.nanmean(ratio)
    by_axis = [_parts(response, ratio, axis) for axis in (0, 1)]
    for axis, other in ((0, 1), (1, 0)):
        # The outputs of one half may differ more than the means of both.
        label = _alike(by_axis[other])[1]
        for each in set(label.tolist()) if not by_axis[axis] else ():
            maps = [np.compress(label == each, v, axis=other) for v in (response, ratio)]
            by_axis[axis] = max(by_axis[axis], _parts(maps[0], maps[1], axis), key=len)
    if not any(by_axis):
        return None
    labels, names = [], []
    for axis, patterns in enumerate(by_axis):
        at, label = _alike(patterns) if patterns else ([0], np.zeros(flat.shape[axis], int))
        labels.append(label)
        names.append([_name(patterns, place, first[axis], ("row", "column")[axis]) for place in at])
    cell = labels[0][:, None] * len(names[1]) + labels[1]
    level, error = _of_cells(ratio, cell, used)
    share = np.bincount(cell[used], minlength=len(level)) / used.sum()
    known = share > 0
    log_gain = -_of_cells(response, cell, used)[0]
    log_gain -= share @ log_gain
    return Outputs(
        [", ".join(filter(None, (r, c))) for r in names[0] for c in names[1]],
        (share @ level) / np.where(known, level, np.nan),
        error / np.where(known, level, np.nan),
        np.exp(log_gain[cell]),
    )


def _parts(response: F64, ratio: F64, axis: int) -> list[Mask]:
    """Places (place,) along an axis of outputs whose gains differ from those of the others."""
    along, in_noise = _profile(response, axis), _profile(ratio, axis)
    place = np.arange(len(along))
    if len(along) < 4 * NARROWEST:
        return []
    odd = place % 2 == 1
    even_out = along - _sizes(along, [odd])[0][0] * odd
    patterns = [odd, *(place >= at for at in _boundaries(even_out))]
    # Steps too small for the noise to have them, as of the lamp, would blur the others.
    sizes, errors = _sizes(along, patterns)[0], _sizes(in_noise, patterns, EVEN)[1]
    told = abs(sizes) > CERTAIN / 2 * errors
    patterns = [pattern for pattern, one in zip(patterns, told, strict=True) if one]
    size, error = _sizes(along, patterns)
    seen, noise = _sizes(in_noise, patterns, EVEN)
    there = (abs(size) > SIGNIFICANT * error) & (abs(seen) > CERTAIN * noise)
    alike = abs(seen - size) < np.maximum(CERTAIN / 2 * noise, abs(size) / 2)
    return [pattern for pattern, kept in zip(patterns, there & alike, strict=True) if kept]


def _alike(patterns: Sequence[Mask]) -> tuple[list[int], I64]:
    """First place of each combination of patterns (place,), and the combination of each place."""
    if not patterns:
        return [], np.zeros(0, np.int64)
    _, at, label = np.unique(patterns, axis=1, return_index=True, return_inverse=True)
    return at.tolist(), label


def _name(patterns: Sequence[Mask], place: int, first: int, line: str) -> str:
    """Words for the rows or columns in the same patterns (place,) as a given one."""
    if not patterns:
        return ""
    lines = np.flatnonzero(np.all([p == p[place] for p in patterns], axis=0))
    count, every = len(patterns[0]), np.diff(lines).max(initial=1) == 1
    kind = f"{line}s" if every else f"{('even', 'odd')[place % 2]} {line}s"
    reach = 1 if every else 2
    low, high = lines[0] >= reach, lines[-1] < count - reach
    begin, end = first + lines[0] - (0 if every else lines[0] % 2), first + lines[-1]
    if low and high:
        return f"{kind} {begin} to {end}"
    return f"{kind} from {begin}" if low else f"{kind} up to {end}" if high else kind


def _of_cells(values: F64, cell: I64, used: Mask) -> tuple[F64, F64]:
    """Mean of each cell's pixels beside a smooth trend over all, and its error from their scatter.

    ``values``: (y, x); ``cell``: (y, x) number of each pixel's.
    """
    y, x = (np.linspace(-1, 1, n) for n in values.shape)
    rows, columns = (np.arange(n) // _TILE for n in values.shape)
    tile = rows[:, None] * (columns[-1] + 1) + columns
    _, group = np.unique((cell * (tile.max() + 1) + tile)[used], return_inverse=True)
    count = np.bincount(group)

    def mean(map_: F64) -> F64:
        return np.asarray(np.bincount(group, map_[used]) / count)

    one = np.ones(values.shape)
    trend = [
        mean(y[:, None] ** m * x**n * one) for m, n in ((0, 1), (1, 0), (0, 2), (1, 1), (2, 0))
    ]
    numbers = np.rint(mean(cell * one)).astype(int)
    cells = np.arange(cell.max() + 1)
    design = np.column_stack([numbers[:, None] == cells, *trend]) * np.sqrt(count)[:, None]
    seen = mean(values)
    inverse = np.linalg.pinv(design.T @ design)
    fitted = inverse @ (design.T @ (np.sqrt(count) * seen))
    scatter = (np.square(values[used]).sum() - count @ seen**2) / max(used.sum() - len(count), 1)
    return fitted[: len(cells)], np.sqrt(scatter * np.diag(inverse)[: len(cells)])


def _profile(values: F64, axis: int) -> F64:
    """Mean of each row (axis 0) or column (1); the median of all for empty ones."""
    count = np.isfinite(values).sum(axis=1 - axis)
    means = np.full(values.shape[axis], np.nanmedian(values))
    kept = np.compress(count > 0, values, axis=axis)
    means[count > 0] = np.nanmean(kept, axis=1 - axis)
    return means


def _boundaries(along: F64) -> list[int]:
    """First places of the blocks after the first, most significant steps first, in order."""
    steps: list[int] = []
    noise = robust_sigma(np.diff(along)) / np.sqrt(2)
    places = range(NARROWEST, len(along) - NARROWEST + 1)
    while noise > 0 and len(steps) < MAX_BOUNDARIES:
        free = [p for p in places if all(abs(p - s) >= NARROWEST for s in steps)]
        taken = [np.arange(len(along)) >= at for at in steps]
        basis = np.linalg.qr(_terms(len(along), taken))[0]
        rest = along - basis @ (basis.T @ along)
        best, at = 0.0, 0
        for place in free:
            step = (np.arange(len(along)) >= place).astype(float)
            step -= basis @ (basis.T @ step)
            size = abs(step @ rest) / np.linalg.norm(step)
            best, at = max((best, at), (float(size), place))
        if best < SIGNIFICANT * noise:
            break
        steps.append(at)
    return sorted(steps)


def _terms(count: int, patterns: Sequence[Mask], trend: Sequence[int] = SMOOTH) -> F64:
    smooth = legvander(np.linspace(-1, 1, count), max(trend))[:, trend]
    return np.column_stack([smooth, *patterns])


def _sizes(along: F64, patterns: Sequence[Mask], trend: Sequence[int] = SMOOTH) -> tuple[F64, F64]:
    """Steps of a profile beside a trend, at places (place,) of patterns; errors by its scatter."""
    terms = _terms(len(along), patterns, trend)
    inverse = np.linalg.inv(terms.T @ terms)
    fitted = inverse @ (terms.T @ along)
    scatter = float(np.var(along - terms @ fitted)) * len(along) / (len(along) - terms.shape[1])
    first = len(trend)
    return fitted[first:], np.sqrt(np.diag(inverse)[first:] * scatter)
