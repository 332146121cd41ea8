"""What lies around the pixels of a tile: flagged pixels, and what is beyond the window.

A flagged pixel has been fitted like the others, and what it gives to its neighbours follows from
that: only where its samples are missing or saturated is it taken to be like those around it. The
window may be a part of a larger detector, whose pixels give to those at its border, or end with
the chip, where nothing comes from beyond: the maps tell, side by side.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixcal.model.arrays import F64, Mask
from pixcal.simulation.effect import FringeMaps
from pixcal.stages.correct.sweep_to_correct import Sides, Swept, corrected, free_of_samples

# lines of pixels that tell what the one at the border should be; those beside it do not count
DEPTH, SKIPPED = 24, 4
ALONG = 1024  # pixels along a side that tell whether it is open
# difference of chi-square by which one side is told by itself; others go by all together
CLEAR = 9.0
# of neighbours, so that the errors of any two of them add up in squares on average
SIGNS = ((0, 0), (0, 1), (1, 0), (1, 1))


def disturbed(maps: FringeMaps, unknown: Mask, beyond: Mask, phase: F64) -> list[FringeMaps]:
    """The maps with unknown pixels perturbed by their errors, in the patterns of `SIGNS`.

    ``unknown``: of any light up to twice that around them; ``beyond``: the window, of unknown
    offsets that scatter as a ``phase`` (y, x), rad, does.
    """
    apart = np.abs(np.diff(phase, axis=1))
    apart = apart[np.isfinite(apart)]
    scatter = 1.4826 * float(np.median(apart)) / np.sqrt(2) if apart.size else 0.0
    y, x = np.indices(unknown.shape)
    y, x = y + maps.origin[0], x + maps.origin[1]
    variants = []
    for a, b in SIGNS:
        sign = 1.0 - 2.0 * ((a * y + b * x) % 2)
        moved = maps.turned(scatter * sign * beyond)
        moved.theta[1:] *= np.where(unknown, 1 + sign, 1.0)
        variants.append(moved)
    return variants


def sides_of(sets: Sequence[Swept]) -> Sides:
    """Sides at which the detector extends beyond the window, from the maps of all sets."""
    misfits = np.zeros((4, 2))
    for swept in sets:
        if swept.passes_borders and min(swept.source.shape) >= 2 * DEPTH:
            for side in range(4):
                misfits[side] += [_misfit(swept, side, is_open) for is_open in (False, True)]
    return decided(misfits)


def _misfit(swept: Swept, side: int, is_open: bool) -> float:
    """Misfit of the pixels at one side, that being open or not."""
    axis, last = divmod(side, 2)
    shape, (kx, ky) = swept.source.shape, swept.k
    length = shape[1 - axis]
    middle = max(0, (length - ALONG) // 2)
    along = (middle, min(length, middle + ALONG))
    across = (shape[axis] - DEPTH, shape[axis]) if last else (0, DEPTH)
    y, x = (along, across) if axis else (across, along)
    top, bottom, left, right = (is_open and n == side for n in range(4))
    one = replace(swept, open_sides=(top, bottom, left, right))
    inside = one.inside(y, x)
    maps, good = free_of_samples(one, one.around(y, x))
    theta, good = corrected(maps, swept.effects)[0].theta[(slice(None), *inside)], good[inside]
    if axis:
        theta, good, kx, ky = theta.swapaxes(1, 2), good.T, ky, kx
    if last:
        theta, good, ky = theta[:, ::-1], good[::-1], -ky
    return border_misfit(theta, (kx, ky), good)


def border_misfit(theta: F64, k: tuple[float, float], good: Mask) -> float:
    """Chi-square of the first line of a strip (3, line, pixel) against the next ones' trend.

    ``k``: along the lines and from line to line, rad/px.
    """
    lines, pixels = good.shape
    y, x = np.arange(lines)[:, None], np.arange(pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (theta[2] + 1j * theta[1]) / theta[0] * np.exp(-1j * (k[0] * x + k[1] * y))
        z /= np.nanmean(np.where(good, z, np.nan))
        value = np.log(z)
    depth = np.arange(SKIPPED, lines)
    total = 0.0
    for part in (value.real, value.imag):
        values = np.where(good & np.isfinite(part), part, np.nan)
        values = values - np.nanmedian(values[SKIPPED:], axis=0)
        mean = np.nanmedian(values, axis=1)
        spread = 1.4826 * np.nanmedian(np.abs(values[SKIPPED:] - mean[SKIPPED:, None]))
        error = spread * np.sqrt(np.pi / 2 / max(int(good[0].sum()), 1))
        if not (error > 0 and np.isfinite(mean).all()):
            continue
        slope, start = np.polyfit(depth, mean[depth], 1)
        # What an effect that is not quite known leaves in lines is no sign of a border.
        lines_apart = 1.4826 * np.median(np.abs(mean[depth] - start - slope * depth))
        total += float((mean[0] - start) ** 2 / (error**2 + lines_apart**2))
    return total


def decided(misfits: F64) -> Sides:
    """Which sides are open, from the chi-squares (side, closed or open)."""
    gain = misfits[:, 0] - misfits[:, 1]
    top, bottom, left, right = np.where(np.abs(gain) > CLEAR, gain > 0, gain.sum() > 0).tolist()
    return top, bottom, left, right
