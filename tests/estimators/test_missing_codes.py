"""Codes that never come add noise, which is taken out again."""

import numpy as np
import pytest

from pixcal.estimators.detector.missing_codes import missing_codes, noise_before_missing_codes
from pixcal.model.arrays import F64, I64

PIXELS, FRAMES = 8000, 40


def samples(rng: np.random.Generator, sigma: float, missing: list[int], side: int) -> I64:
    """Codes (t, pixel) of levels about 100.3, of a converter that leaves codes out."""
    level = 100.3 + 0.6 * rng.standard_normal(PIXELS)
    codes = np.rint(level + sigma * rng.standard_normal((FRAMES, PIXELS))).astype(int)
    return np.where(np.isin(codes, missing), codes + side, codes)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("missing", [[100], [99, 102], [103], [98, 101]])
@pytest.mark.parametrize("sigma", [0.8, 1.2, 2.0])
def test_the_noise_before_missing_codes_is_found_within_a_per_cent(
    sigma: float, missing: list[int], side: int
) -> None:
    rng = np.random.default_rng([int(10 * sigma), *missing, side + 1])
    found = samples(rng, sigma, missing, side)
    counts: F64 = np.bincount(found.ravel(), minlength=130).astype(float)
    codes: I64 = missing_codes(counts)
    assert codes.tolist() == missing
    variance = float(found.var(axis=0, ddof=1).mean())
    error = variance * np.sqrt(2 / (PIXELS * (FRAMES - 1)))
    noise = noise_before_missing_codes(variance, error, found.mean(axis=0), FRAMES, counts)
    assert noise is not None
    assert noise[0] == pytest.approx(sigma, rel=0.01)


def test_a_whole_converter_of_two_amplifiers_misses_nothing() -> None:
    rng = np.random.default_rng(4)
    codes = np.rint(rng.normal([[100], [160]], 3, (2, 50_000))).astype(int)
    assert not len(missing_codes(np.bincount(codes.ravel(), minlength=200).astype(float)))
