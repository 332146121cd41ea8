"""Telegraph noise by its moments: unbiased however faint and slow; likelihoods against SciPy."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, ncx2

from pixcal.estimators.detector.telegraph.dwell import PixelSeries, find_stays
from pixcal.estimators.detector.telegraph.find import find_telegraph, own_levels
from pixcal.estimators.detector.telegraph.moments import QUIET, Series, moments_of, thinned
from pixcal.estimators.detector.telegraph.population import log_ratio_of_jumps
from pixcal.model.arrays import F64, Indices

PERIOD_S = 0.14


def jumping(
    rng: np.random.Generator,
    share: float,
    amplitude: float,
    switching_s: float,
    decades: float = 0.0,
    frames_of_series: Sequence[int] = (30, 20),
    n: int = 16_000,
    differ: float = 0.0,
    tail: float = 0.0,
    upper: float = 0.5,
) -> list[Series]:
    """Series of the same pixels, of noise one and jumps with amplitudes about ``amplitude``.

    ``differ``: standard deviation of the logarithm of the pixels' own noise. ``tail``: the same of
    the amplitudes, if they are not exponential. ``upper``: share of the time in the upper level.
    """
    own = rng.lognormal(0, differ, n) if differ else 1.0
    times = switching_s * 10 ** (decades * (rng.random(n) - 0.5)) if decades else switching_s
    sizes = rng.lognormal(0, tail, n) if tail else rng.standard_exponential(n)
    jumps = np.where(rng.random(n) < share, amplitude * sizes, 0.0)
    series = []
    for frames in frames_of_series:
        anew = rng.random((frames, n)) < 1 - np.exp(-2 * PERIOD_S / times)
        anew[0] = True
        coin, levels = rng.random((frames, n)) < upper, np.empty((frames, n))
        for t in range(frames):
            levels[t] = np.where(anew[t], coin[t], levels[t - 1])
        noise = own * rng.standard_normal((frames, n)) + (levels - upper) * jumps
        series.append(Series(noise, np.arange(frames), np.arange(n), 1.0, PERIOD_S))
    return series


@pytest.mark.long
@pytest.mark.parametrize(
    ("amplitude", "switching_s"), [(1.0, 0.8), (1.5, 0.8), (3.0, 0.4), (10.0, 1.5)]
)
def test_pixels_that_hardly_stand_out_tell_share_amplitude_and_time(
    amplitude: float, switching_s: float
) -> None:
    found = find_telegraph(jumping(np.random.default_rng(8), 0.03, amplitude, switching_s))
    assert found is not None
    assert abs(found.share - 0.03) < 4 * found.share_error < 0.03
    assert abs(found.amplitude - amplitude) < 4 * found.amplitude_error < amplitude
    assert abs(found.stays.mean_s - switching_s) < 4 * found.switching_error < 2 * switching_s
    assert found.signs.significance > 8
    assert found.stays.decades == 0


@pytest.mark.parametrize("seed", range(2))
def test_few_frames_do_not_make_equal_jumps_more_frequent(seed: int) -> None:
    rng = np.random.default_rng(seed)
    series = jumping(rng, 0.01, 5.0, 4 * PERIOD_S, frames_of_series=(10,), n=60_000, tail=1e-9)
    found = find_telegraph(series)
    assert found is not None
    assert abs(found.share - 0.01) < 4 * found.share_error < 0.0025
    assert abs(found.stays.mean_s - 4 * PERIOD_S) < 4 * found.switching_error < 4 * PERIOD_S


def test_the_share_allows_for_pixels_that_jump_in_none_of_few_frames() -> None:
    off = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        found = find_telegraph(jumping(rng, 0.03, 3.5, 0.9, 1.5, (12,), 13_000, tail=0.4))
        assert found is not None
        off.append((found.share - 0.03) / found.share_error)
    assert np.sqrt(np.mean(np.square(off))) < 1.5


@pytest.mark.parametrize("dof", [5, 9, 60, 700])
def test_a_variance_with_jumps_is_a_noncentral_chi_square(dof: int) -> None:
    variance, added = np.array([0.5, 1.0, 2.0, 5.0, 12.0]), np.array([0.05, 0.5, 3.0, 10.0])
    expected = ncx2.logpdf(dof * variance[:, None], dof, dof * added)
    expected -= chi2.logpdf(dof * variance, dof)[:, None]
    found, finite = log_ratio_of_jumps(variance, added, dof), np.isfinite(expected)
    np.testing.assert_allclose(found[finite], expected[finite], atol=0.5 / dof)


@pytest.mark.long
@pytest.mark.parametrize("differ", [0.1, 0.2])
@pytest.mark.parametrize("seed", range(3))
def test_pixels_of_different_noise_do_not_hide_the_population(differ: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    series = jumping(rng, 0.02, 6.0, 0.5, 0.0, (60, 20), 4_000, differ)
    found = find_telegraph(series)
    assert found is not None
    assert abs(found.share - 0.02) < 4 * found.share_error < 0.04
    assert abs(found.amplitude - 6) < 4 * found.amplitude_error < 6
    assert abs(found.stays.mean_s - 0.5) < 4 * found.switching_error < 0.5


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_a_few_pixels_that_jump_far_do_not_hide_how_long_the_others_stay(seed: int) -> None:
    series = jumping(np.random.default_rng(seed), 0.02, 7.0, 0.4, 0.0, (40,), 6_400, tail=1.5)
    found = find_telegraph(series)
    assert found is not None
    assert abs(found.stays.mean_s - 0.4) < 4 * found.switching_error < 0.4


@pytest.mark.long
def test_of_stays_longer_than_the_frames_no_more_is_said() -> None:
    found = find_telegraph(jumping(np.random.default_rng(9), 0.03, 2.0, 40.0))
    assert found is not None
    assert found.stays.mean_s <= 30 * PERIOD_S * 1.001
    assert abs(found.amplitude - 2.0) < 4 * found.amplitude_error


@pytest.mark.long
def test_times_that_differ_from_pixel_to_pixel_are_told() -> None:
    found = find_telegraph(jumping(np.random.default_rng(9), 0.03, 8.0, 1.2, 1.5, (60, 60)))
    assert found is not None
    assert found.stays.decades > 1
    assert abs(found.stays.mean_s - 1.2) < 4 * found.switching_error
    assert abs(found.share - 0.03) < 4 * found.share_error


def test_quiet_pixels_stand_for_those_left_out() -> None:
    """Sums over the pixels stay right, and no noisy pixel is left out."""
    rng = np.random.default_rng(12)
    n, jumping_pixels = 6 * QUIET, 200
    noise = rng.standard_normal((16, n))
    noise[:, :jumping_pixels] += 20 * rng.choice([-1.0, 1.0], (16, jumping_pixels))
    whole = moments_of(Series(noise, np.arange(16), np.arange(n), 1.0, PERIOD_S))
    assert whole is not None
    (some,) = thinned([whole])
    assert len(some.pixel) < 1.2 * QUIET
    assert set(range(jumping_pixels)) <= set(some.pixel.tolist())
    assert some.stands_for.sum() == pytest.approx(n)
    error = np.sqrt(2 / 15 * n * n / QUIET)
    assert abs(some.stands_for @ some.variance - whole.variance.sum()) < 4 * error


def lit_series(
    charge: F64, weight: F64 | float, pixels: Indices, fitted: F64 | None = None
) -> PixelSeries:
    """Charge (t, n) less what fits of functions of time (t, k), or of a mean, take up."""
    weight = np.broadcast_to(weight, charge.shape)
    of_time = np.ones((len(charge), 1)) if fitted is None else fitted
    root = np.sqrt(weight)
    rest = np.empty_like(charge)
    for n in range(charge.shape[1]):
        (found, *_) = np.linalg.lstsq(root[:, n, None] * of_time, root[:, n] * charge[:, n])
        rest[:, n] = charge[:, n] - of_time @ found
    return PixelSeries(rest, weight, np.arange(len(charge)), PERIOD_S, pixels, of_time)


@pytest.mark.parametrize(
    ("time_s", "decades", "noisier"),
    [(0.3, 0.0, 9.0), (1.5, 0.0, 9.0), (0.9, 1.5, 9.0), (0.3, 0.0, 20.0), (1.5, 0.0, 20.0)],
)
def test_frames_of_fringes_tell_how_long_pixels_stay(
    time_s: float, decades: float, noisier: float
) -> None:
    """Also where the few frames by which they were chosen let those that stay long go unseen.

    And where the fit of fringes of four phases takes up much of the light's own noise.
    """
    rng = np.random.default_rng(5)
    dark, bright = jumping(rng, 1.0, 8.0, time_s, decades, (21, 311), 420, tail=0.3)
    for quiet in (dark, bright):
        quiet.noise[:, 400:] = rng.standard_normal((len(quiet.noise), 20))
    # The light's own noise, over that of the dark frames: the brighter, the more.
    phase = np.pi / 2 * (np.arange(311) % 4)[:, None]
    sigma = noisier * np.sqrt(1 + 0.5 * np.cos(phase + 6 * rng.random(420)))
    charge = bright.noise + sigma * rng.standard_normal(bright.noise.shape)
    weight = 1 / (1 + sigma**2)
    fitted = np.hstack([np.ones((311, 1)), np.cos(phase), np.sin(phase)])
    seen = moments_of(with_quiet(dark, rng))
    assert seen is not None
    chosen = seen.pixel[seen.excess > 0]
    chosen = chosen[chosen < 400]
    lit = lit_series(charge[:, chosen], weight[:, chosen], chosen, fitted)
    found = find_stays([lit], seen)
    assert found is not None
    stays, error, *_ = found
    assert abs(stays.mean_s - time_s) < 4 * error < 1.6 * time_s
    assert abs(stays.decades - decades) <= 0.5


@pytest.mark.parametrize("upper", [0.05, 0.2, 0.5, 0.9])
def test_frames_of_fringes_tell_how_much_of_the_time_pixels_are_in_the_upper_level(
    upper: float,
) -> None:
    rng = np.random.default_rng(7)
    (bright,) = jumping(rng, 1.0, 12.0, 0.3, 0.0, (311,), 200, tail=0.3, upper=upper)
    noisier = rng.uniform(3.0, 9.0, bright.noise.shape)
    charge = bright.noise + noisier * rng.standard_normal(noisier.shape)
    lit = lit_series(charge, 1 / (1 + noisier**2), np.arange(200))
    assert own_levels([lit], 1.0).common_upper == pytest.approx(upper, rel=0.15)
    # Another set may lack some of the pixels.
    fewer = replace(lit, charge=lit.charge[:, 7:], weight=lit.weight[:, 7:], pixel=lit.pixel[7:])
    assert own_levels([lit, fewer], 1.0).common_upper == pytest.approx(upper, rel=0.15)
    noise = replace(lit, charge=noisier * rng.standard_normal(noisier.shape))
    assert own_levels([noise], 1.0).common_upper == 0.5


def test_pixels_with_different_shares_of_the_time_have_none_in_common() -> None:
    """As many are rarely in the upper level as in the lower one."""
    rng = np.random.default_rng(31)
    upper = rng.choice([0.06, 0.94], 240)
    amplitude = np.exp(rng.uniform(0.0, 2.3, 240))
    series = []
    for frames, noise in ((40, 1.0), (300, 8.0), (300, 8.0)):
        up = rng.random((frames, 240)) < upper
        charge = up * 4 * amplitude + noise * rng.standard_normal(up.shape)
        series.append(lit_series(charge, noise**-2, np.arange(240)))
    series[0] = replace(series[0], chosen=True)
    assert own_levels(series, 1.0).common_upper == 0.5


def test_levels_of_single_pixels_are_those_that_they_have() -> None:
    """Weak ones by the dark frames, strong ones by those of fringes, also where one was unseen."""
    rng = np.random.default_rng(3)
    amplitude = np.repeat([5.0, 25.0, 0.0], [60, 40, 30])
    upper = np.repeat([0.5, 0.2, 0.5], [60, 40, 30])
    series = []
    for frames, noise in ((40, 1.0), (311, 7.0), (290, 7.0)):
        up = rng.random((frames, len(amplitude))) < upper
        if frames == 40:
            up[:, 70:80] = False  # they stayed in the lower one
        x = up * amplitude + noise * rng.standard_normal(up.shape)
        series.append(lit_series(x, noise**-2, 3 * np.arange(len(amplitude))))
    lacking = replace(
        series[2],
        charge=series[2].charge[:, 5:],
        weight=series[2].weight[:, 5:],
        pixel=series[2].pixel[5:],
    )
    found = own_levels([*series[:2], lacking], 1.0)
    number = found.pixel // 3
    assert set(range(100)) <= set(number.tolist())
    assert np.count_nonzero(number >= 100) <= 1
    weak, strong = number < 60, (number >= 60) & (number < 100)
    # Of a weak one 40 frames tell it to a sigma over the root of 40, at best.
    assert found.amplitude[weak].mean() == pytest.approx(5, rel=0.05)
    assert found.amplitude[weak].std() < 0.6
    assert found.amplitude[strong].mean() == pytest.approx(25, rel=0.02)
    assert found.amplitude[strong].std() < 2.0
    assert found.upper[strong].mean() == pytest.approx(0.2, abs=0.03)
    # Fringes hardly show the weak ones, 40 dark frames to the root of 1/160.
    assert np.sqrt(np.mean((found.upper[weak] - 0.5) ** 2)) < 1.3 * 160**-0.5


@pytest.mark.long
def test_pixels_that_are_rarely_in_the_upper_level_are_counted() -> None:
    rng = np.random.default_rng(8)
    shape = {"tail": 0.3, "upper": 0.06}
    dark, bright = jumping(rng, 0.03, 15.0, 0.5, 0.0, (40, 311), **shape)
    charge = bright.noise + 6 * rng.standard_normal(bright.noise.shape)

    def lit(pixels: Indices) -> list[PixelSeries]:
        return [lit_series(charge[:, pixels], 1 / 37, pixels)]

    found = find_telegraph([dark], lit)
    assert found is not None
    assert found.stays.upper == pytest.approx(0.06, rel=0.2)
    assert found.share == pytest.approx(0.03, rel=0.3)
    assert found.amplitude == pytest.approx(15 * np.exp(0.045), rel=0.15)


def test_noise_without_jumps_tells_no_stays() -> None:
    rng = np.random.default_rng(6)
    (dark,) = jumping(rng, 0.2, 6.0, 0.5, 0.0, (40,), 1000)
    seen = moments_of(dark)
    assert seen is not None
    charge = rng.standard_normal((307, 60))
    assert find_stays([lit_series(charge, 1.0, np.arange(60))], seen) is None
    assert find_stays([], seen) is None


def with_quiet(series: Series, rng: np.random.Generator) -> Series:
    """The series with 4,000 more pixels of usual noise."""
    noise = np.hstack([series.noise, rng.standard_normal((len(series.noise), 4000))])
    return Series(noise, series.frame, np.arange(noise.shape[1]), 1.0, PERIOD_S)
