"""Full wells are detected from the noise of flats, at whatever code they end."""

import numpy as np
import pytest

from pixcal.estimators.detector.bad_pixels import nonlinear
from pixcal.estimators.detector.calibration import (
    ExposureLevel,
    relative_response,
    step_levels,
    unsaturated,
    usual_variance,
)

SHAPE = (37, 53)
GAIN = 0.75


def ladder(
    well_e: float,
    *,
    well_spread: float = 0.0,
    read_e: float = 1.0,
    bend: float = 0.0,
    border: int = 0,
) -> tuple[list[ExposureLevel], np.ndarray]:
    rng = np.random.default_rng(3)
    response = 1 + 0.02 * rng.standard_normal(SHAPE)
    response[:border] = 0
    wells = well_e * (1 + well_spread * rng.standard_normal(SHAPE))
    steps = []
    for exptime in np.arange(1, 11):
        light = rng.poisson(4000.0 * exptime * response, (8, *SHAPE))
        charge = np.minimum(light - bend * light**2 / 4e4, wells)
        adu = (charge + read_e * rng.standard_normal(charge.shape)) / GAIN
        variance = adu.var(axis=0, ddof=1)
        noise = usual_variance(variance, 7)
        steps.append(ExposureLevel(float(exptime), 8, adu.mean(axis=0), variance / 8, noise))
    return steps[::-1], response


@pytest.mark.parametrize("spread", [0.0, 0.01])
def test_full_pixels_neither_flatten_the_response_nor_are_nonlinear(spread: float) -> None:
    steps, response = ladder(30_500.0, well_spread=spread)
    assert nonlinear(steps, step_levels(steps), 0.03).mean() > 0.05
    kept, _ = unsaturated(steps, step_levels(steps))
    assert not nonlinear(kept, step_levels(kept), 0.03).any()
    rate, error = relative_response(kept, step_levels(kept))
    off = rate / np.median(rate) - response / np.median(response)
    assert np.std(off) == pytest.approx(np.median(error / rate), rel=0.1)


def test_of_pixels_that_are_just_not_full_all_is_kept() -> None:
    steps, _ = ladder(28_100.0)
    kept, _ = unsaturated(steps, step_levels(steps))
    lost = [float(np.isnan(step.signal).mean()) for step in kept][::-1]
    assert lost[:6] == [0.0] * 6
    assert lost[7:] == [1.0] * 3


def test_pixels_without_light_are_not_full() -> None:
    steps, _ = ladder(30_500.0, read_e=10.0, border=4)
    kept, _ = unsaturated(steps, step_levels(steps))
    below = [step.signal[:4] for step in kept if step.exptime < 7]
    assert np.isfinite(below).all()


@pytest.mark.parametrize(("read", "bend"), [(1.0, 0.0), (60.0, 0.0), (1.0, 0.15)])
def test_without_an_end_nothing_is_left_out(read: float, bend: float) -> None:
    steps, _ = ladder(1e9, read_e=read, bend=bend)
    kept, _ = unsaturated(steps, step_levels(steps))
    assert all(np.isfinite(step.signal).all() for step in kept)


def test_dim_levels_whose_noise_is_high_by_chance_are_no_slope() -> None:
    noise = (280.0, 290.0, 310.0, 340.0, 390.0)
    levels = (52.0, 340.0, 620.0, 910.0, 1200.0)
    steps = [
        ExposureLevel(1.0 + n, 2, np.full(SHAPE, level), np.full(SHAPE, variance / 2), variance)
        for n, (level, variance) in enumerate(zip(levels, noise, strict=True))
    ]
    kept, _ = unsaturated(steps, step_levels(steps), 235.0)
    assert all(np.isfinite(step.signal).all() for step in kept)
