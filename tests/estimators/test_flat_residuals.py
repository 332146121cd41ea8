"""Noise of flats as it is correlated between pixels: that of the light alone."""

import numpy as np
import pytest

from pixcal.estimators.crosstalk.residuals import UNIT, all_residuals
from pixcal.estimators.diagnosis.evidence import Evidence, Stack
from pixcal.kernels.crosstalk import Coupling, couple
from pixcal.model.arrays import F64

SHAPE = 193, 211


def evidence(charge: F64) -> Evidence:
    """Flats (t, y, x), e-, of a camera of 1 e-/ADU that needs no correction."""
    flats = Stack("flat", 1.0, np.arange(len(charge)), np.arange(float(len(charge))),
                  charge.astype(np.float32))  # fmt: skip
    zero, one = np.zeros(SHAPE), np.ones(SHAPE)
    return Evidence({}, (flats,), 1.0, 2.0, 2.0, zero, zero, one, one > 0, 1e6, 5.0, 633.0, 400.0)


def noise(charge: F64, known: tuple[Coupling, ...] = ()) -> tuple[float, float]:
    """Variance of the residuals over shot noise, and correlation of adjacent pixels."""
    (one,) = all_residuals(evidence(charge), known)
    frames = len(one.weight)
    e = one.e[:frames] / one.weight
    freedom = (1 - 1 / SHAPE[0]) * (1 - 1 / SHAPE[1])  # means of rows and columns are taken out
    variance = float((e**2).mean() / freedom / (one.charge.mean() + 4 / UNIT))
    return variance, float((e[:, :, 1:] * e[:, :, :-1]).mean() / (e**2).mean())


@pytest.mark.parametrize("contrast", [1e-2, 5e-3, 3.7e-3, 1e-3])
def test_even_light_leaves_shot_noise(contrast: float) -> None:
    """Offset and light of each frame are taken out, however little the two differ."""
    few = 4 / np.sqrt(np.prod(SHAPE))
    for seed in range(8):
        rng = np.random.default_rng(seed)
        level = np.exp(rng.uniform(np.log(2e3), np.log(7e4)))
        light = level * (1 + contrast * rng.standard_normal(SHAPE))
        read = rng.normal(0, 2, (2, *SHAPE))
        variance, correlation = noise(rng.poisson(light, read.shape) + read)
        assert variance == pytest.approx(1, abs=2 * few)
        assert correlation == pytest.approx(0, abs=few)


@pytest.mark.parametrize("per_ke", [0.0, 0.04])
def test_known_couplings_leave_no_correlation(per_ke: float) -> None:
    """Also where shares rise so far that a quarter of a change of the light leaves a pixel."""
    rng = np.random.default_rng(2)
    steps = (0, 1), (0, -1), (1, 0), (-1, 0)
    known = tuple(Coupling(dy, dx, 0.011, per_ke=per_ke) for dy, dx in steps)
    light = 6.5e4 * (1 + 3e-3 * rng.standard_normal(SHAPE))
    read = couple(rng.poisson(light, (2, *SHAPE)).astype(float), known)
    assert noise(read)[1] > 0.015
    variance, correlation = noise(read, known)
    few = 4 / np.sqrt(np.prod(SHAPE))
    assert variance == pytest.approx(1, abs=2 * few)
    assert correlation == pytest.approx(0, abs=few / 4)
