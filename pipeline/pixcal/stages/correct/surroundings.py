"""What lies around the pixels of a tile: flagged pixels, and what is beyond the window.

A flagged pixel has been fitted like the others, and what it gives to its neighbours follows from
that: only where its samples are missing or saturated is it taken to be like those around it. The
window may be a part of a larger detector, whose pixels give to those at its border, or end with
the chip, where nothing comes from beyond: the maps tell, side by side.
"""

import numpy as np

from pixcal.model.arrays import F64, U8, Mask
from pixcal.model.flags import PixelFlag
from pixcal.simulation.effect import FringeMaps

# top, bottom, left and right of the window, rows counted from the top
Sides = tuple[bool, bool, bool, bool]

CLOSED: Sides = (False, False, False, False)
BEYOND = 8  # pixels beyond an open side that are taken to be there
# flags of pixels whose fit tells nothing of their light
UNKNOWN = int(PixelFlag.SATURATED | PixelFlag.NO_DATA)
# lines of pixels that tell what the one at the border should be; those beside it do not count
DEPTH, SKIPPED = 24, 4
# difference of chi-square by which one side is told by itself; others go by all together
CLEAR = 9.0
# of neighbours, so that the errors of any two of them add up in squares on average
SIGNS = ((0, 0), (0, 1), (1, 0), (1, 1))


def scatter_of(phase: F64) -> float:
    """Robust scatter (rad) of phases from pixel to pixel, from differences of neighbours."""
    apart = np.abs(np.diff(phase, axis=1))
    apart = apart[np.isfinite(apart)]
    return float(1.4826 * np.median(apart) / np.sqrt(2)) if apart.size else 0.0


def disturbed(maps: FringeMaps, unknown: Mask, beyond: Mask, scatter: float) -> list[FringeMaps]:
    """The maps with unknown pixels perturbed by their errors, in the patterns of `SIGNS`.

    Pixels (y, x) that are ``unknown`` may have any light from none to twice that around them; those
    ``beyond`` the window have known light, and unknown offsets of a ``scatter`` in phase, rad.
    """
    y, x = np.indices(unknown.shape)
    y, x = y + maps.origin[0], x + maps.origin[1]
    variants = []
    for a, b in SIGNS:
        sign = 1.0 - 2.0 * ((a * y + b * x) % 2)
        moved = maps.turned(scatter * sign * beyond)
        moved.theta[1:] *= np.where(unknown, 1 + sign, 1.0)
        variants.append(moved)
    return variants


def usable(theta: F64, mask: U8) -> Mask:
    """Pixels (y, x) whose fitted signal is usable, flagged or not."""
    return np.asarray(np.isfinite(theta).all(axis=0) & (mask & UNKNOWN == 0))


def border_misfit(theta: F64, k: tuple[float, float], good: Mask) -> float:
    """Chi-square of the first line of pixels against an extrapolation of the next ones.

    Of maps (3, line, pixel) of the strip along a side, the line at the border first; ``k`` is along
    the lines and from line to line, rad/px.
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
    together = bool(gain.sum() > 0)
    top, bottom, left, right = (bool(g > 0) if abs(g) > CLEAR else together for g in gain.tolist())
    return top, bottom, left, right
