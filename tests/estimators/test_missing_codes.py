"""Codes that never come add noise, which is taken out again."""

import numpy as np
import pytest

from pixcal.estimators.detector.code_histogram import step_of
from pixcal.estimators.detector.missing_codes import (
    missing_codes,
    noise_before_missing_codes,
    step_noise,
)
from pixcal.kernels.gain_fit import fit_gain
from pixcal.kernels.rounding import SHEPPARD
from pixcal.model.arrays import F64, I64

PIXELS, FRAMES = 8000, 40


def samples(rng: np.random.Generator, sigma: float, missing: list[int], side: int) -> I64:
    """Codes (t, pixel) of levels about 100.3, of a converter that leaves codes out."""
    level = 100.3 + 0.6 * rng.standard_normal(PIXELS)
    codes = np.rint(level + sigma * rng.standard_normal((FRAMES, PIXELS))).astype(int)
    for _ in missing:
        codes = np.where(np.isin(codes, missing), codes + side, codes)
    return codes


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


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("sigma", [1.2, 2.0])
def test_so_it_is_where_hardly_a_code_is_left(sigma: float, side: int) -> None:
    """Up to four codes apart; noise of less than a quarter of that is not told as well."""
    test_the_noise_before_missing_codes_is_found_within_a_per_cent(
        sigma, [98, 100, 101, 102, 104], side
    )


def test_a_whole_converter_of_two_amplifiers_misses_nothing() -> None:
    rng = np.random.default_rng(4)
    codes = np.rint(rng.normal([[100], [160]], 3, (2, 50_000))).astype(int)
    assert not len(missing_codes(np.bincount(codes.ravel(), minlength=200).astype(float)))


@pytest.mark.parametrize("apart", [5, 6, 8, 11, 14, 20])
@pytest.mark.parametrize("sigma", [0.5, 0.8, 1.1, 1.5, 2.0])
def test_no_code_is_missing_between_the_colours_of_a_camera(sigma: float, apart: int) -> None:
    rng = np.random.default_rng([int(10 * sigma), apart])
    for level in np.linspace(40, 41, 7):
        colours = rng.normal([[level], [level + apart], [level + 2.3 * apart]], sigma, (3, 80_000))
        counts = np.bincount(np.rint(colours).astype(int).ravel()).astype(float)
        assert not len(missing_codes(counts))


@pytest.mark.parametrize("step", [1.3, 1.6, 2.4])
@pytest.mark.parametrize("sigma", [1.1, 1.5])
def test_noise_before_a_digital_gain_is_found_within_a_per_cent(sigma: float, step: float) -> None:
    rng = np.random.default_rng([int(10 * sigma), int(10 * step)])
    codes = samples(rng, sigma, [], 0)
    found = np.rint(step * codes).astype(int)
    counts: F64 = np.bincount(found.ravel(), minlength=320).astype(float)
    variance = float(found.var(axis=0, ddof=1).mean())
    error = variance * np.sqrt(2 / (PIXELS * (FRAMES - 1)))
    noise = noise_before_missing_codes(variance, error, found.mean(axis=0), FRAMES, counts, step)
    assert noise is not None
    assert noise[0] == pytest.approx(step * sigma, rel=0.01)


def random_codes(rng: np.random.Generator, share: float) -> I64:
    """The code that each of 4096 becomes, where some are missing and the next stands in."""
    there = np.flatnonzero(rng.random(4200) >= share)
    return there[np.searchsorted(there, np.arange(4096))]


@pytest.mark.parametrize("share", [0.05, 0.25, 0.35])
def test_codes_missing_by_chance_add_what_a_geometric_distribution_does(share: float) -> None:
    rng = np.random.default_rng(3)
    counts = np.bincount(random_codes(rng, share), weights=np.full(4096, 1000.0))
    variance, density = step_noise(counts)
    expected = share / (1 - share) ** 2
    assert variance == pytest.approx(expected, rel=0.15)
    # Of neighbouring codes the shifts are related by the share; the sum is known by 128 blocks.
    assert density == pytest.approx(expected * (1 + share) / (1 - share), rel=4 * np.sqrt(2 / 128))
    assert step_of(counts)[0] == 1.0


@pytest.mark.parametrize("seed", range(8))
def test_a_gain_is_right_within_its_error_though_a_quarter_of_the_codes_is_missing(
    seed: int,
) -> None:
    rng, gain, noise, pixels = np.random.default_rng(seed), 3.0, 1.1, 20_000
    code = random_codes(rng, 0.25)
    counts, sums = np.zeros(4200), []
    for level in np.geomspace(60, 3000, 24):
        sigma = np.hypot(noise, np.sqrt(level / gain))
        found = code[np.rint(rng.normal(100 + level, sigma, pixels)).astype(int)]
        counts += np.bincount(found, minlength=4200)
        sums.append([pixels - 1, (pixels - 1) * level, (pixels - 1) * found.var(ddof=1)])
    variance, density = step_noise(counts)
    known = noise**2 + SHEPPARD + variance
    fit = fit_gain(np.array(sums), (known, 0.01 * known), 3000.0, uneven=density)
    assert fit is not None
    assert abs(fit.gain - gain) < 3 * fit.error < 0.06 * gain
