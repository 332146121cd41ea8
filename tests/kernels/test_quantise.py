"""Electrons in two bytes: nothing is lost but what the step says, and nothing wraps around."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pixcal.kernels.quantise import FILL, Scale, choose_scale, coefficients, encode, extremes

F32 = NDArray[np.float32]
GAIN = 0.85
SHAPE = (13, 11, 17)


def maps(rng: np.random.Generator) -> tuple[F32, F32, F32]:
    bias = rng.normal(500, 5, SHAPE[1:])
    dark = rng.exponential(24, SHAPE[1:])
    flat = rng.normal(1, 0.01, SHAPE[1:])
    return bias.astype(np.float32), dark.astype(np.float32), flat.astype(np.float32)


def convert(
    raw: NDArray[np.generic],
    scale: Scale,
    calibration: tuple[F32, F32, F32],
    exptime: F32,
    saturation: float,
) -> tuple[NDArray[np.uint16], NDArray[np.uint32], NDArray[np.uint32], int]:
    codes = np.full(raw.shape, 7, np.uint16)
    saturated, lost = np.zeros((2, *raw.shape[1:]), np.uint32)
    terms = coefficients(scale, GAIN, *calibration)
    total = encode(raw, *terms, exptime, np.float32(saturation), codes, saturated, lost)
    return codes, saturated, lost, total


@pytest.mark.quick(1)
@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "f4"])
def test_codes_are_electrons_to_half_a_step(dtype: str) -> None:
    rng = np.random.default_rng(0)
    bias, dark, flat = calibration = maps(rng)
    top = 250 if dtype == "u1" else 30_000
    raw = rng.integers(0, top, SHAPE).astype(dtype)
    exptime = rng.uniform(0, 2, SHAPE[0]).astype(np.float32)
    scale = Scale(0.75, -900.0)
    codes, saturated, lost, total = convert(raw, scale, calibration, exptime, 65535)
    charge = GAIN * (raw.astype(float) - bias) - dark * exptime[:, None, None].astype(float)
    electrons = codes * scale.step + scale.offset
    assert np.abs(electrons - charge / flat).max() < 0.51 * scale.step
    assert not saturated.any()
    assert not lost.any()
    assert total == codes.sum(dtype=int)


def test_saturated_missing_and_distant_samples_get_the_fill_value_and_are_counted() -> None:
    rng = np.random.default_rng(1)
    calibration = maps(rng)
    raw = rng.uniform(1000, 2000, SHAPE).astype(np.float32)
    odd = {(0, 0, 0): 60_000.0, (1, 2, 3): 1e30, (2, 2, 3): np.inf}
    missing = {(3, 4, 5): np.nan, (4, 4, 5): -np.inf, (5, 5, 5): -1e30, (6, 6, 6): 59_999.0}
    for where, value in (odd | missing).items():
        raw[where] = value
    exptime = np.zeros(SHAPE[0], np.float32)
    codes, saturated, lost, total = convert(raw, Scale(0.5, 0.0), calibration, exptime, 60_000)
    filled = codes == FILL
    assert {tuple(map(int, where)) for where in np.argwhere(filled)} == set(odd | missing)
    assert saturated.sum() == len(odd)
    assert saturated[2, 3] == 2
    assert lost.sum() == len(missing)
    assert lost[4, 5] == 2
    assert total == codes[~filled].sum(dtype=int)


@given(
    low=st.floats(-1e5, 0),
    span=st.floats(1e-3, 1e6),
    noise=st.floats(0, 100),
    share=st.floats(1e-5, 1e-1),
)
@settings(max_examples=300, deadline=None)
def test_a_scale_covers_the_range_and_costs_no_more_than_it_must(
    low: float, span: float, noise: float, share: float
) -> None:
    high = low + span
    scale = choose_scale(low, high, noise**2, share)
    first, last = ((v - scale.offset) / scale.step for v in (low, high))
    assert first > -0.5
    assert last < 65534.5
    assert scale.offset / scale.step == pytest.approx(round(scale.offset / scale.step), abs=1e-6)
    if scale.variance > share * noise**2:
        # Only because the range needs it.
        assert scale.step < 1.02 * max(high - low, 1e-6) / 65532
    else:
        assert (4 * scale.variance > share * noise**2) or scale.step < 1.02 * span / 65532


def test_the_gigapyx_is_stored_for_less_than_a_thousandth_of_its_variance() -> None:
    read_noise, full_range = 15.0, 65535 / 0.95
    scale = choose_scale(-500, full_range, (read_noise / 1.05) ** 2, 1e-3)
    assert scale.variance < 1e-3 * (read_noise / 1.05) ** 2
    assert scale.offset + 65534 * scale.step >= full_range


@pytest.mark.parametrize("level", [0.0, 100.0, 25_000.0])
def test_the_variance_that_rounding_adds_is_what_it_is_said_to_be(level: float) -> None:
    rng = np.random.default_rng(2)
    read_noise = 15.0
    scale = choose_scale(-600, 66_000, read_noise**2, 1e-3)
    shape = (64, 128, 128)
    exact = rng.poisson(level, shape) + rng.normal(0, read_noise, shape)
    raw = (exact / GAIN + 500).astype(np.float32)
    flat, zero = np.ones(shape[1:], np.float32), np.zeros(shape[1:], np.float32)
    calibration = (np.full_like(flat, 500), zero, flat)
    codes, _, lost, _ = convert(raw, scale, calibration, np.zeros(shape[0], np.float32), np.inf)
    assert not lost.any()
    added = codes * scale.step + scale.offset - GAIN * (raw.astype(float) - 500)
    share = added.var() / (level + read_noise**2)
    assert share < 1e-3
    assert share == pytest.approx(scale.variance / (level + read_noise**2), rel=0.03)
    # Rounding and noise are independent: the variances add.
    stored = (codes * scale.step + scale.offset).var()
    assert stored == pytest.approx(exact.var() + scale.variance, rel=1e-4)


def test_extremes_are_those_of_the_samples_below_saturation() -> None:
    raw = np.random.default_rng(3).uniform(0, 1000, SHAPE).astype(np.float32)
    raw[4, 5, 6] = np.nan
    lowest, highest = np.full(SHAPE[1:], np.inf, np.float32), np.full(SHAPE[1:], -np.inf, "f4")
    extremes(raw[:7], np.float32(900), lowest, highest)
    extremes(raw[7:], np.float32(900), lowest, highest)
    good = np.where(raw < 900, raw, np.nan)
    np.testing.assert_array_equal(lowest, np.nanmin(good, axis=0))
    np.testing.assert_array_equal(highest, np.nanmax(good, axis=0))
