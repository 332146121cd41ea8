"""Two maps taken apart by scale: sums that add up, calibrated significance, known closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from pixcal.stages.compare.agreement import (
    Grouping,
    Part,
    Projection,
    VarianceEstimate,
    double,
    halve,
    strongest_period,
    three_cornered_hat,
)

SHAPE = (45, 52)
NOISE = (8e-4, 1.1e-3)


def plane(shape):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.stack([np.ones(shape), x - shape[1] / 2, y - shape[0] / 2, np.cos(1.3 * x)])


def taken_apart(maps, modes, good, levels=3):
    """Parts at blocks of 1, 2, 4, 8 pixels (the last with all larger ones), and all together."""
    variance = np.stack([np.full(good.shape, n**2) for n in NOISE])
    sums = np.concatenate([maps, modes, variance, np.ones((1, *good.shape))]) * good
    groupings, _ = double(sums, levels)
    whole = Grouping.of(sums.sum(axis=(1, 2))[:, None])
    projection, n = Projection.of(groupings[0]), groupings[0].groups
    pairs = zip(groupings, [*groupings[1:], whole], strict=True)
    return [projection.part(a, b, n) for a, b in pairs], projection.part(groupings[0], whole, n)


def draw(rng, signal=6e-3, shape=SHAPE):
    true = rng.normal(0, signal, shape)
    return np.stack([true + rng.normal(0, n, shape) for n in NOISE])


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**31))
def test_halving_keeps_the_sum(ny, nx, seed):
    values = np.random.default_rng(seed).normal(size=(2, ny, nx))
    half = halve(values)
    assert half.shape == (2, -(-ny // 2), -(-nx // 2))
    np.testing.assert_allclose(half.sum(axis=(1, 2)), values.sum(axis=(1, 2)), atol=1e-12)
    assert half[0, 0, 0] == pytest.approx(values[0, :2, :2].sum())


@given(st.integers(0, 2**31))
@settings(max_examples=20)
def test_the_scales_add_up(seed):
    rng = np.random.default_rng(seed)
    maps, modes, good = draw(rng), plane(SHAPE), rng.random(SHAPE) > 0.05
    parts, total = taken_apart(maps, modes, good)
    for key in ("first", "second", "both", "freedom"):
        assert sum(getattr(p, key) for p in parts) == pytest.approx(getattr(total, key), rel=1e-9)
    assert sum(p.expected for p in parts) == pytest.approx(total.expected, rel=2e-2)
    # By plain least squares on the maps themselves.
    basis = modes[:, good].T
    rest = maps[:, good].T - basis @ np.linalg.lstsq(basis, maps[:, good].T, rcond=None)[0]
    assert total.first == pytest.approx((rest[:, 0] ** 2).sum(), rel=1e-6)
    assert total.both == pytest.approx((rest[:, 0] * rest[:, 1]).sum(), rel=1e-6)
    assert total.freedom == pytest.approx(good.sum() - 4)


def test_a_checkerboard_is_all_at_its_own_scale():
    """Squares of 4 px: nothing in smaller blocks, nothing in larger ones."""
    y, x = np.mgrid[:64, :96]
    board = np.where((y // 4 + x // 4) % 2, 1.0, -1.0)
    good = np.ones(board.shape, bool)
    parts, _ = taken_apart(np.stack([board, 3 * board]), np.ones((1, 64, 96)), good, levels=4)
    shares = [p.both / p.pixels for p in parts]
    assert shares == pytest.approx([0, 0, 3, 0, 0], abs=1e-12)
    assert parts[2].freedom == 3 / 4 * 64 * 96 / 16


def test_modes_that_are_alike_count_once():
    rng = np.random.default_rng(2)
    good = np.ones(SHAPE, bool)
    maps, modes = draw(rng), plane(SHAPE)
    twice = np.concatenate([modes, 3 * modes[::-1], modes[:1] + modes[1:2]])
    once, again = (taken_apart(maps, m, good)[1] for m in (modes, twice))
    assert again.freedom == pytest.approx(once.freedom)
    assert again.first == pytest.approx(once.first, rel=1e-6)


def test_significances_are_standard_normal_and_sizes_unbiased():
    """Over 250 pairs of maps of the same pixels, with masked ones and modes taken off."""
    rng = np.random.default_rng(7)
    modes = plane(SHAPE)
    z, pulls, slopes = [], [], []
    for _ in range(250):
        parts, total = taken_apart(draw(rng), modes, rng.random(SHAPE) > 0.02)
        z.append([p.significance(0.0) for p in parts])
        first, second = total.own(0.0)
        shared, excess = total.common(), total.beyond_noise(0.0)
        pulls.append([e.variance / e.error for e in (first, second, excess)])
        pulls[-1].append((shared.variance - 36e-6) / shared.error)
        line = total.line()
        slopes.append((line.slope - 1) / line.slope_error)
    for values in (*np.array(z).T, *np.array(pulls).T, np.array(slopes)):
        # 250 draws: the mean is known to 0.063, the spread to 0.045.
        assert abs(values.mean()) < 0.25
        assert 0.84 < values.std() < 1.16


def test_a_signal_of_one_side_is_found_there():
    rng = np.random.default_rng(3)
    maps = draw(rng)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    maps[1] += 6e-4 * np.where((y // 4 + x // 4) % 2, 1.0, -1.0)
    parts, total = taken_apart(maps, plane(SHAPE), np.ones(SHAPE, bool))
    assert [p.significance() > 5 for p in parts] == [False, False, True, False]
    excess = parts[2].beyond_noise()
    assert excess.variance == pytest.approx(36e-8, abs=3 * excess.error)
    first, second = parts[2].own()
    assert second.variance == pytest.approx(36e-8, abs=4 * second.error)
    assert abs(first.variance) < 4 * first.error
    assert total.beyond_noise().facts()["upper_px"] > excess.facts()["px"]


def test_the_line_is_that_of_orthogonal_distances():
    """The least of chi-square with errors in both, sought by numbers."""
    rng = np.random.default_rng(11)
    true = rng.normal(0, 3e-3, SHAPE)
    maps = np.stack([true + rng.normal(0, 8e-4, SHAPE), 1.3 * true + rng.normal(0, 1.1e-3, SHAPE)])
    _, total = taken_apart(maps, plane(SHAPE)[:1], np.ones(SHAPE, bool))
    line = total.line()
    x, y = (m.ravel() - m.mean() for m in maps)

    def chi2(slope):
        return ((y - slope * x) ** 2).sum() / (NOISE[1] ** 2 + slope**2 * NOISE[0] ** 2)

    least = minimize_scalar(chi2, bracket=(1.0, 1.5), tol=1e-12)
    assert line.slope == pytest.approx(least.x, rel=1e-6)
    # One sigma away chi-square is higher by one; that leaves out the noise of the abscissae.
    raised = chi2(line.slope + line.slope_error) - least.fun
    assert 1.0 < raised < 1.4
    assert abs(line.slope - 1.3) < 4 * line.slope_error
    assert line.correlation == pytest.approx(np.corrcoef(*maps.reshape(2, -1))[0, 1])


def test_no_line_where_nothing_is_common():
    rng = np.random.default_rng(1)
    _, total = taken_apart(draw(rng, signal=0.0), plane(SHAPE), np.ones(SHAPE, bool))
    line = total.line()
    assert (line.slope, line.slope_error) == (None, None)
    assert abs(line.correlation) < 4 * line.correlation_error


def test_the_accuracy_of_sigma_is_allowed_for():
    n = 100_000
    p = Part(n, n, 1.0, 1.0 + 2e-2 * 2, 0.0, (1.0, 1.0))
    assert p.significance(0.0) > 4
    assert p.significance(0.02) < 1
    upper = [p.beyond_noise(accuracy).facts()["upper_px"] for accuracy in (0.0, 0.02)]
    assert upper[1] > upper[0]
    assert Part(0, 0.5, 1, 1, 0, (1, 1)).significance() == 0.0


def test_sizes_of_estimates():
    def size(variance, error):
        facts = VarianceEstimate(variance, error).facts()
        return facts["px"], facts["error_px"], facts["upper_px"]

    assert size(-1.0, 0.5)[0] == 0
    assert size(4.0, 0.0) == (2, 0, 2)
    assert size(1e-6, 1e-8)[1] == pytest.approx(1e-8 / 2e-3, rel=0.01)
    assert size(0.0, 1.0)[2] == pytest.approx(1.645**0.5, rel=1e-3)


def test_periods():
    rng = np.random.default_rng(5)
    x = np.arange(160)
    error = rng.uniform(0.8, 1.2, 160)
    noise = error * rng.normal(size=160)
    wave = strongest_period(1.5 * np.sin(2 * np.pi * x / 4 + 0.3) + noise, error)
    assert wave is not None
    assert wave.px == pytest.approx(4)
    assert wave.amplitude_px == pytest.approx(1.5, abs=0.4)
    assert wave.chance < 1e-6
    chances = []
    for _ in range(300):
        values = error * rng.normal(size=160)
        values[[3, 77]] = np.nan
        found = strongest_period(values, error)
        assert found is not None
        chances.append(found.chance)
    # Uniform: what noise makes half of the time has a chance of a half.
    assert 0.4 < np.median(chances) < 0.6
    assert 0.04 < np.mean(np.array(chances) < 0.1) < 0.17
    assert strongest_period(np.ones(5), np.ones(5)) is None


def test_three_cornered_hat():
    own_of = [1.0, 4.0, 0.0]
    pairs = [(0, 1), (0, 2), (1, 2)]
    found = three_cornered_hat(
        pairs, [VarianceEstimate(own_of[i] + own_of[j], 0.1) for i, j in pairs]
    )
    assert [e.variance for e in found] == pytest.approx(own_of)
    assert [e.error for e in found] == pytest.approx([0.1 * 0.75**0.5] * 3)
    four = [(i, j) for i in range(4) for j in range(i)]
    assert len(three_cornered_hat(four, [VarianceEstimate(1.0, 1.0)] * 6)) == 4
