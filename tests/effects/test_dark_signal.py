"""Dark signal without dark frames: visibilities scatter alike, in inverse proportion to light."""

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import pixcal
import study
from pixcal.effects.dark_signal import DarkSignal
from pixcal.effects.intra_pixel_response import IntraPixelResponse
from pixcal.estimators.diagnosis.evidence import Evidence

Acquired = Callable[..., Evidence]
NO_DARKS = {"frames.darks": [], "detector.hot_fraction": 0.0}
RATE = {"dark_signal": {"scatter": 2000.0}}


def measured(evidence: Evidence) -> tuple[float, float, float]:
    found = DarkSignal.estimate(evidence)
    assert found is not None
    return found.effect.scatter, found.errors["scatter"], found.significance


@pytest.mark.parametrize("peaks", [(None, None), (12000.0, 30000.0)])
def test_charge_is_found_in_any_light(
    acquired: Acquired, peaks: tuple[float | None, float | None]
) -> None:
    light = {f"frames.fringes.{n}.peak_e": peak for n, peak in enumerate(peaks) if peak}
    scatter, error, significance = measured(acquired(NO_DARKS | light, RATE))
    # The sample of pixels has a scatter of its own.
    assert scatter == pytest.approx(2000.0, abs=3 * np.hypot(error, 2000 / np.sqrt(2 * 5000)))
    assert significance > 10


def test_one_set_is_enough(acquired: Acquired) -> None:
    both = acquired(NO_DARKS, RATE)
    name, one = next(iter(both.fringes.items()))
    scatter, error, _ = measured(replace(both, fringes={name: one}))
    assert scatter == pytest.approx(2000.0, abs=4 * np.hypot(error, 2000 / np.sqrt(2 * 5000)))


def test_a_nonlinearity_of_all_pixels_does_not_hide_it(acquired: Acquired) -> None:
    """Its harmonics vary over the window as the contrast does; that is no property of pixels."""
    scatter, error, _ = measured(acquired(NO_DARKS, RATE | {"nonlinearity": {"quadratic": -0.05}}))
    assert scatter == pytest.approx(2000.0, abs=4 * np.hypot(error, 2000 / np.sqrt(2 * 5000)))


def test_widths_of_pixels_are_not_taken_for_it(acquired: Acquired) -> None:
    """Crossed fringes see another width each, and share nothing."""
    found = measured(acquired(NO_DARKS, {"intra_pixel_response": {"width_rms_px": 0.02}}))
    assert abs(found[2]) < 4
    width = IntraPixelResponse.estimate(acquired(NO_DARKS, RATE))
    assert width is None or width.refused or width.significance < 4


def with_own_responses(evidence: Evidence, rms: float) -> Evidence:
    """Signals that each pixel bends by a share of its own; maps fitted again."""
    bend = np.random.default_rng(5).normal(0, rms, evidence.good.shape).astype(np.float32)
    fringes = {}
    for name, f in evidence.fringes.items():
        electrons = f.electrons * (1 - bend * f.electrons / np.nanmedian(f.electrons))
        theta = np.einsum("it,tyx->iyx", np.linalg.pinv(f.g), np.nan_to_num(electrons))
        fringes[name] = replace(f, electrons=electrons, theta=theta)
    return replace(evidence, fringes=fringes)


@pytest.mark.parametrize("rate", [0.0, 2000.0])
def test_nonlinearity_of_single_pixels_is_not_taken_for_it(acquired: Acquired, rate: float) -> None:
    """It bends the fringes of a pixel too, which a charge does not."""
    effects = {"dark_signal": {"scatter": rate}} if rate else {}
    scatter, error, significance = measured(with_own_responses(acquired(NO_DARKS, effects), 0.01))
    if rate:
        assert scatter == pytest.approx(rate, abs=4 * np.hypot(error, rate / np.sqrt(2 * 5000)))
    else:
        assert significance < 4


def test_dark_frames_measure_it(acquired: Acquired) -> None:
    evidence = acquired({"detector.hot_fraction": 0.0}, RATE)
    found = DarkSignal.estimate(evidence)
    assert found is not None
    assert found.refused
    assert found.effect.is_null
    # As their map is subtracted, nothing of it is left.
    assert measured(replace(evidence, stacks=evidence.of_kind("bias")))[2] < 4


@pytest.mark.long
def test_an_acquisition_without_darks_is_explained() -> None:
    bench = study.bench(71) | {"effects": RATE}
    bench["frames"]["darks"], bench["detector"]["hot_fraction"] = [], 0.0
    with study.reduced(bench) as run:
        pixcal.fit(run)
        pixcal.diagnose(run)
        found = json.loads((run / "products" / "diagnosis.json").read_text())
    assert found["verdict"] == "explained"
    (cause,) = found["causes"]
    assert cause["effect"] == "dark_signal"
    assert cause["on_map"]["action"] == "unaffected"
    assert cause["size"]["unit"] == "e-/s"
