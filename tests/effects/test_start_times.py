"""Start times of the recordings that a simulation of an acquisition is given."""

from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pixcal.simulation.replica import _starts

NAN = float("nan")


def recording(name: str, start: float, frames: int, period: float) -> Any:
    """A series of frames as in the evidence."""
    times = period * np.arange(frames)
    return SimpleNamespace(name=name, start_s=start, time_s=times, adu=times)


@given(
    st.lists(st.booleans(), min_size=1, max_size=6),
    st.lists(st.integers(2, 9), min_size=6, max_size=6),
)
def test_recordings_without_time_stamps_come_first_and_move_no_other(
    stamped: list[bool], frames: list[int]
) -> None:
    """None overlap, and those with stamps keep the times between them."""
    period, every, clock = 0.25, [], 0.0
    for n, (known, count) in enumerate(zip(stamped, frames, strict=False)):
        every.append(recording(f"set {n}", clock if known else NAN, count, period))
        clock += 1.5 * count * period
    half = len(every) // 2
    found = _starts(cast(Any, SimpleNamespace(stacks=every[:half])), every[half:])
    starts = list(found.values())
    spans = sorted(
        (a, a + len(s.adu) * period, np.isfinite(s.start_s))
        for a, s in zip(starts, every, strict=True)
    )
    assert all(one[1] <= other[0] + 1e-9 for one, other in pairwise(spans))
    assert [known for *_, known in spans] == sorted(stamped)
    moved = [a - s.start_s for a, s in zip(starts, every, strict=True) if np.isfinite(s.start_s)]
    np.testing.assert_allclose(moved, moved[:1] * len(moved), atol=1e-9)
