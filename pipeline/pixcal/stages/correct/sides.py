"""Sides at which the detector extends beyond the window, from its maps."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixcal.stages.correct.surroundings import DEPTH, Sides, border_misfit, decided
from pixcal.stages.correct.swept import Swept, free_of_samples, undone

ALONG = 1024  # pixels along a side that tell whether it is open


def sides_of(sets: Sequence[Swept]) -> Sides:
    """Sides at which the detector extends beyond the window, from the maps of all sets."""
    misfits = np.zeros((4, 2))
    for swept in sets:
        if swept.passes_borders:
            for side in range(4):
                misfits[side] += [_misfit(swept, side, is_open) for is_open in (False, True)]
    return decided(misfits)


def _misfit(swept: Swept, side: int, is_open: bool) -> float:
    """Misfit of the pixels at one side, that being open or not."""
    shape = swept.source.shape
    axis, last = divmod(side, 2)
    strip = [(0, shape[0]), (0, shape[1])]
    length = shape[1 - axis]
    middle = max(0, (length - ALONG) // 2)
    strip[1 - axis] = (middle, min(length, middle + ALONG))
    strip[axis] = (max(0, shape[axis] - DEPTH), shape[axis]) if last else (0, DEPTH)
    if min(shape) < 2 * DEPTH:
        return 0.0
    y, x = strip
    sides = [False] * 4
    sides[side] = is_open
    one = replace(swept, open_sides=(sides[0], sides[1], sides[2], sides[3]))
    part, inside = one.around(y, x), one.inside(y, x)
    maps, good = free_of_samples(one, part)
    theta, good = undone(maps, swept.effects)[0].theta[(slice(None), *inside)], good[inside]
    kx, ky = swept.k
    if axis:
        theta, good, kx, ky = theta.swapaxes(1, 2), good.T, ky, kx
    if last:
        theta, good, ky = theta[:, ::-1], good[::-1], -ky
    return border_misfit(theta, (kx, ky), good)
