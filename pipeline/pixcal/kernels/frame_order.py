"""Frames by their numbers in a recording: which follow one another, and where there are gaps."""

import numpy as np

from pixcal.model.arrays import Indices, Mask


def runs(numbers: Indices) -> list[tuple[int, int]]:
    """Ranges (first, one after the last) of consecutive numbers (t,), ascending."""
    if not len(numbers):
        return []
    cuts = np.flatnonzero(np.diff(numbers) > 1) + 1
    return [(int(run[0]), int(run[-1]) + 1) for run in np.split(numbers, cuts)]


def follows(numbers: Indices, steps: int = 1) -> Mask:
    """Whether the frame so many steps before in an array was taken so many frames before (t,).

    ``numbers``: (t,) of the frames, ascending. ``steps``: negative: whether the frame so many steps
    after was taken so many frames after.
    """
    return np.asarray(numbers - np.roll(numbers, steps) == steps)


def with_neighbours(numbers: Indices) -> Indices:
    """Places of the frames whose last and next frames are in the array too."""
    return np.flatnonzero(follows(numbers, 1) & follows(numbers, -1))


def since_gap(numbers: Indices, steps: int) -> Mask:
    """Frames (t,) with fewer than so many between them and the last gap, or the beginning."""
    begins = np.flatnonzero(~follows(numbers))
    place = np.arange(len(numbers))
    return np.asarray(place - begins[np.searchsorted(begins, place, "right") - 1] < steps)
