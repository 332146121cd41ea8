"""Batches of frames on a regular grid of time, for the Allan deviation."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pixcal.model.arrays import F64, I32

DEFAULT_FRAMES = 500  # frames of a batch in a long run (paper, section 4.3)
MIN_FRAMES = 16  # fewest frames of a batch: each pixel has three unknowns of its own there
WANTED = 24  # batches wanted of a run too short for `DEFAULT_FRAMES`


@dataclass(frozen=True)
class FrameBatches:
    """Batches of equal duration."""

    frames: int  # frames of a full batch
    period_s: float  # time from frame to frame
    # first frame and the one after the last of each batch; empty for a gap
    ranges: tuple[tuple[int, int], ...]
    time: F64  # (batch,) centre of each batch, seconds from the first frame
    note: str = ""  # what a reader should know, or ""

    @property
    def count(self) -> I32:
        """Frames in each batch."""
        return np.array([b - a for a, b in self.ranges], dtype=np.int32)


def plan_batches(time_s: F64, frames: int | None = None) -> FrameBatches:
    """Divide a run into batches of equal time, by the time (t,) of its frames, gaps included.

    By default of 500 frames, or what leaves some 24 batches of a shorter run.
    """
    n = len(time_s)
    length = frames or max(MIN_FRAMES, min(DEFAULT_FRAMES, n // WANTED))
    steps = np.diff(time_s)
    period = float(np.median(steps)) if n > 1 else 1.0
    note = ""
    if period > 0 and time_s[-1] - time_s[0] < 20 * n * period:
        # Slots are counted from frame to frame: a period that is off by little does not add up.
        slots = np.concatenate([[0], np.cumsum(np.maximum(1, np.rint(steps / period)))])
    else:
        slots, period = np.arange(n, dtype=float), period if period > 0 else 1.0
        note = "time stamps do not follow a regular pace: batches count frames, not seconds"
    n_batches = int((slots[-1] + 1) // length) if n else 0
    edges = np.searchsorted(slots, np.arange(n_batches + 1) * length)
    ranges = tuple((int(a), int(b)) for a, b in pairwise(edges))
    # A batch with few frames left has other noise than the rest: it counts as a gap.
    ranges = tuple((a, b) if b - a >= 0.75 * length else (a, a) for a, b in ranges)
    centre = np.asarray((np.arange(n_batches) + 0.5) * length * period, dtype=np.float64)
    return FrameBatches(length, period, ranges, centre, note)
