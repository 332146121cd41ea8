"""Tables of a part of the frames."""

from typing import Any

import numpy as np
import pytest

from pixcal.stages.diagnose.parts import select
from pixcal.stages.evidence import begin_mjd
from pixcal.stages.reduce.ingested import starts_of

CUBE: dict[str, list[Any]] = {"time_s": [0.0, 1.5, 3.0, 4.5, 6.0], "mjd": [61100.25, *[None] * 4]}


@pytest.mark.parametrize("frames", [[0, 1], [1, 3], [4]])
def test_an_array_begins_when_it_did_whichever_frames_are_taken(frames: list[int]) -> None:
    found = select({"bias": CUBE}, {"bias": np.array(frames)})["bias"]
    assert begin_mjd(found) == pytest.approx(61100.25, abs=1e-8)
    assert found["time_s"] == [CUBE["time_s"][n] for n in frames]


def test_without_time_stamps_the_beginning_stays_unknown() -> None:
    table = CUBE | {"mjd": [None] * 5}
    found = select({"bias": table}, {"bias": np.array([2, 3])})["bias"]
    assert np.isnan(begin_mjd(found))
    assert found["mjd"] == [None, None]


def test_an_array_without_time_stamps_hides_the_times_of_no_other() -> None:
    unknown = CUBE | {"mjd": [None] * 5}
    starts = starts_of(
        {"bias": unknown, "dark": CUBE, "flat": CUBE | {"mjd": [61100.5, *[None] * 4]}}
    )
    assert np.isnan(starts["bias"])
    assert starts["dark"] == 0
    assert starts["flat"] == pytest.approx(21600, abs=0.01)
    assert np.isnan(starts_of({"bias": unknown})["bias"])
