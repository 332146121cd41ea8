"""Frames are grouped by exposure time, and what headers do not say is said in a sentence."""

from typing import Any

import numpy as np
import pytest

from pixcal.stages.reduce.exposures import group_exposures


def tables(**exptimes: list[float | None]) -> dict[str, dict[str, Any]]:
    return {name.replace("__", "/"): {"exptime_s": times} for name, times in exptimes.items()}


def test_groups_hold_the_frames_of_one_exposure_time_in_order() -> None:
    found = group_exposures(
        tables(
            bias=[0.0, 0.0], dark=[2.0, 1.0, 2.0], flat=[0.2, 0.1, 0.20001, 0.1], fringes__a=[1.0]
        )
    )
    assert [(g.array, g.exptime, g.frames) for g in found.dark] == [
        ("bias", 0.0, (0, 1)),
        ("dark", 1.0, (1,)),
        ("dark", 2.0, (0, 2)),
    ]
    assert [g.frames for g in found.flat] == [(1, 3), (0, 2)]
    assert found.has_rate
    assert found.known
    assert found.warnings == []
    np.testing.assert_array_equal(found.fringes["fringes/a"], np.float32([1.0]))


def test_the_read_noise_is_that_of_the_bias_frames_else_of_most_darks() -> None:
    both = group_exposures(tables(bias=[0.0, 0.0], dark=[1.0] * 9))
    assert both.read_series is not None
    assert both.read_series.array == "bias"
    darks = group_exposures(tables(dark=[1.0, 2.0, 2.0]))
    assert darks.read_series is not None
    assert darks.read_series.exptime == 2.0
    assert group_exposures(tables(bias=[0.0])).read_series is None


def test_darks_of_two_times_are_enough_without_bias() -> None:
    found = group_exposures(tables(dark=[1.0, 2.0], flat=[1.0, 1.0], fringes__a=[0.5]))
    assert found.has_rate
    assert found.warnings == []


@pytest.mark.parametrize(
    ("times", "sentence"),
    [
        ({"flat": [1.0]}, "no bias and no dark frames"),
        ({"bias": [0.0]}, "no flat frames"),
        ({"dark": [1.0, 1.0], "flat": [1.0]}, "is subtracted as bias and dark signal"),
        ({"dark": [1.0], "fringes__a": [1.0, 2.0]}, "EXPTIME differs in 1 of 2 frames"),
        ({"bias": [1.0], "dark": [1.0], "flat": [1.0]}, "dark signal is included in the bias"),
        ({"bias": [0.0], "dark": [1.0, None], "flat": [1.0]}, "no EXPTIME in 1 of 2 dark frames"),
        ({"bias": [0.0], "dark": [1.0], "flat": [None]}, "dark signal is not removed"),
        ({"bias": [0.0], "flat": [1.0, None]}, "no EXPTIME in 1 of 2 flat frames"),
        (
            {"bias": [0.0], "dark": [1.0], "fringes__a": [None, 1.0]},
            "a: no EXPTIME in 1 of 2 frames",
        ),
        ({"bias": [None], "dark": [None], "fringes__a": [None]}, "electrons per exposure"),
    ],
)
def test_what_is_missing_is_said(times: dict[str, list[float | None]], sentence: str) -> None:
    assert any(sentence in warning for warning in group_exposures(tables(**times)).warnings)


def test_without_any_exptime_darks_are_exposed_as_long_as_fringes() -> None:
    found = group_exposures(
        tables(bias=[None] * 3, dark=[None] * 2, flat=[None] * 4, fringes__a=[None] * 5)
    )
    assert [g.exptime for g in found.dark] == [0.0, 1.0]
    assert [g.exptime for g in found.flat] == [1.0]
    np.testing.assert_array_equal(found.fringes["fringes/a"], np.ones(5, np.float32))


def test_fringes_of_unknown_exposure_have_no_dark_signal_removed() -> None:
    found = group_exposures(tables(bias=[0.0], dark=[1.0], fringes__a=[None, 0.5]))
    np.testing.assert_array_equal(found.fringes["fringes/a"], np.float32([0, 0.5]))
