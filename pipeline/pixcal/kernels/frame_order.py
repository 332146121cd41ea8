"""Order of frames in a recording by their numbers: consecutive frames, and gaps."""

import numpy as np
from numpy.polynomial.legendre import legvander

from pixcal.model.arrays import F32, Indices, Mask


def runs(numbers: Indices) -> list[tuple[int, int]]:
    """Ranges (first, one after the last) of consecutive numbers (t,), ascending."""
    if not len(numbers):
        return []
    cuts = np.flatnonzero(np.diff(numbers) > 1) + 1
    return [(int(run[0]), int(run[-1]) + 1) for run in np.split(numbers, cuts)]


def follows(numbers: Indices, steps: int = 1) -> Mask:
    """Whether the frame ``steps`` places before in an array was taken ``steps`` frames before (t,).

    ``numbers``: (t,) of the frames, ascending. Negative ``steps``: the same for frames after.
    """
    return np.asarray(numbers - np.roll(numbers, steps) == steps)


def with_neighbours(numbers: Indices) -> Indices:
    """Places of the frames whose previous and next frames are also in the array."""
    return np.flatnonzero(follows(numbers, 1) & follows(numbers, -1))


def since_gap(numbers: Indices, steps: int) -> Mask:
    """Frames (t,) with fewer than ``steps`` frames between them and the last gap or the start."""
    begins = np.flatnonzero(~follows(numbers))
    place = np.arange(len(numbers))
    return np.asarray(place - begins[np.searchsorted(begins, place, "right") - 1] < steps)


def slow_trends(frame: Indices) -> F32:
    """Orthonormal functions (t, k) of the frame number for drifting light, a constant first."""
    past = (frame - frame[0]) / max(int(frame[-1] - frame[0]), 1)
    courses = legvander(2 * past - 1, min(3, (len(frame) - 1) // 8))
    return np.linalg.qr(courses)[0].astype(np.float32)
