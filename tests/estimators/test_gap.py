"""The gap between data and simulations, on curves drawn with known distributions."""

import numpy as np
import pytest
from scipy.stats import kstest, norm

from pixcal.estimators.test_statistics import Curve, Key, known_statistics
from pixcal.estimators.test_statistics.expectation import (
    Reference,
    expect_nominal,
    expect_with,
    scaled,
)
from pixcal.estimators.test_statistics.gap import (
    FALSE_ALARM_RATE,
    compare,
    flagged,
    log_likelihood,
    remaining,
)
from pixcal.stages.diagnose.thresholds import MIN_LOGLIK_GAIN

LINEAR: Key = ("harmonics", "a")
POWER: Key = ("contrast_of_frames", "a")


def drawn(seed: int, shift: float = 0.0, power: float = 1.0) -> dict[Key, Curve]:
    rng = np.random.default_rng(seed)
    x = np.arange(6.0)
    return {
        LINEAR: Curve(x, 3e-6 * (rng.standard_normal(6) + shift)),
        POWER: Curve(x, 1e-9 * power * rng.chisquare(7, 6) / 7),
    }


def reference(seeds: range = range(100, 116)) -> Reference:
    return Reference.of([drawn(seed) for seed in seeds])


def test_the_kinds_are_what_the_test_takes_them_for() -> None:
    assert known_statistics()[LINEAR[0]].kind == "linear"
    assert known_statistics()[POWER[0]].kind == "power"


def test_the_scale_of_powers_is_smooth_and_rises() -> None:
    ratio = np.geomspace(1e-4, 1e6, 4001)
    values = scaled(ratio, np.ones_like(ratio))
    slopes = np.diff(values) / np.diff(ratio)
    assert np.all(slopes > 0)
    near = scaled(np.array([1 - 1e-6, 1.0, 1 + 1e-6]), np.ones(3))
    np.testing.assert_allclose(near, [-1e-6, 0, 1e-6], rtol=1e-5, atol=1e-12)


def test_deviations_by_chance_are_as_rare_as_they_are_called() -> None:
    sigmas = []
    for n in range(60):
        known = reference(range(1000 * n, 1000 * n + 16))
        data = known.on_scale(drawn(1000 * n + 500))
        sigmas.append(compare(data, expect_nominal(known))[LINEAR].sigmas)
    chance = norm.cdf(np.concatenate(sigmas))
    assert kstest(chance, "uniform").pvalue > 1e-3


@pytest.mark.quick(1)
@pytest.mark.parametrize("alike", [0.0, 0.6, 0.95, 1.0])
def test_the_chance_of_a_curve_is_uniform_however_alike_its_values_are(alike: float) -> None:
    def curves(rng: np.random.Generator) -> dict[Key, Curve]:
        common, own = rng.standard_normal(), rng.standard_normal(9)
        return {LINEAR: Curve(np.arange(9.0), np.sqrt(alike) * common + np.sqrt(1 - alike) * own)}

    rng, chances, counts = np.random.default_rng(5), [], []
    for _ in range(300):
        known = Reference.of([curves(rng) for _ in range(16)])
        (found,) = compare(known.on_scale(curves(rng)), expect_nominal(known)).values()
        chances.append(np.exp(found.log_chance))
        counts.append(known.independent[LINEAR])
    assert kstest(chances, "uniform").pvalue > 1e-3
    # All alike count as one; independent ones as several, a little less than they are.
    assert (np.median(counts) < 1.3) if alike == 1 else (np.median(counts) > 1.3)
    if not alike:
        assert 6 < np.median(counts) <= 9


def test_no_gap_is_found_where_there_is_none() -> None:
    found = 0
    for n in range(100):
        known = reference(range(1000 * n, 1000 * n + 16))
        found += bool(
            flagged(compare(known.on_scale(drawn(1000 * n + 500)), expect_nominal(known)))
        )
    # Binomial of 100 at twice the chance: more than 7 once in a thousand.
    assert found <= 7
    assert FALSE_ALARM_RATE <= 0.05


def test_a_shift_is_a_gap_that_its_cause_closes_and_another_does_not() -> None:
    known = reference()
    data = known.on_scale(drawn(7, shift=40, power=30))
    nominal = expect_nominal(known)
    before = compare(data, nominal)
    assert flagged(before) == {LINEAR, POWER}
    right = expect_with(known, [drawn(s, shift=40, power=30) for s in range(100, 108)])
    after = compare(data, right)
    assert not flagged(after)
    assert remaining(before, before, flagged(before)).total == pytest.approx(1, abs=0.05)
    assert remaining(before, after, flagged(before)).total < 0.02
    wrong = expect_with(known, [drawn(s, shift=-40) for s in range(100, 108)])
    assert log_likelihood(data, right) > log_likelihood(data, nominal) + 50
    # A wrong effect widens what is expected, which is worth less than one that is taken.
    assert log_likelihood(data, wrong) < log_likelihood(data, nominal) + MIN_LOGLIK_GAIN


def test_a_weak_effect_is_found_beside_a_strong_one() -> None:
    """How uncertain its strength is widens what it does itself, not what the strong one does."""
    known = reference()
    data = known.on_scale(drawn(7, shift=40, power=6))
    strong = expect_with(known, [drawn(s, shift=40) for s in range(100, 108)])
    both = [drawn(s, shift=40, power=6) for s in range(100, 108)]
    beside, alone = (expect_with(known, both, 1 / 3, start) for start in (strong, None))
    np.testing.assert_allclose(beside.variance[LINEAR], strong.variance[LINEAR], rtol=1e-9)
    np.testing.assert_allclose(beside.variance[POWER], alone.variance[POWER], rtol=1e-9)
    before = log_likelihood(data, strong)
    assert log_likelihood(data, beside) > before + MIN_LOGLIK_GAIN > log_likelihood(data, alone)


def test_half_of_a_gap_is_half_closed() -> None:
    """One of two curves that count about alike."""
    known = reference()
    data = known.on_scale(drawn(7, shift=40, power=30))
    nominal = expect_nominal(known)
    before = compare(data, nominal)
    half = expect_with(known, [drawn(s, power=30) for s in range(100, 108)])
    gap = remaining(before, compare(data, half), flagged(before))
    share = gap.weights[LINEAR] / (gap.weights[LINEAR] + gap.weights[POWER])
    assert gap.total == pytest.approx(share, abs=0.03)
    intensity, time = gap.of_domain("intensity"), gap.of_domain("time")
    assert intensity[0] + time[0] == pytest.approx(1)
    assert intensity[1] + time[1] == pytest.approx(gap.total)


def test_a_gap_that_an_effect_opens_counts() -> None:
    known = reference()
    data = known.on_scale(drawn(7, shift=40))
    nominal = expect_nominal(known)
    before = compare(data, nominal)
    where = flagged(before)
    assert where == {LINEAR}
    opens = expect_with(known, [drawn(s, shift=40, power=100) for s in range(100, 108)])
    assert remaining(before, compare(data, opens), where).total > 0.2


def test_effects_that_scatter_by_themselves_are_not_asked_to_agree() -> None:
    """A random effect of the same size, drawn again, closes the gap."""
    known = reference()

    def random(seed: int) -> dict[Key, Curve]:
        rng = np.random.default_rng(10_000 + seed)
        curve = drawn(seed)[LINEAR]
        return {LINEAR: Curve(curve.x, curve.value + 1e-4 * rng.standard_normal(6))}

    known = Reference.of([{LINEAR: drawn(s)[LINEAR]} for s in range(100, 116)])
    nominal = expect_nominal(known)
    left = []
    for n in range(20):
        data = known.on_scale(random(n))
        before = compare(data, nominal)
        after = compare(data, expect_with(known, [random(s) for s in range(100, 108)]))
        assert not flagged(after)
        left.append(remaining(before, after, flagged(before)).total)
    assert np.median(left) < 0.35


@pytest.mark.parametrize("failed", [0, 1, 3, 4])
def test_a_statistic_that_fails_in_a_few_simulations_is_expected_from_the_others(
    failed: int,
) -> None:
    known = reference()
    with_effect = [drawn(seed, shift=40) for seed in range(100, 108)]
    for curves in with_effect[:failed]:
        del curves[LINEAR]
    shift = expect_with(known, with_effect).mean[LINEAR] - expect_nominal(known).mean[LINEAR]
    # Of half of the simulations or more nothing is known.
    usual = known.on_scale(drawn(100, 40))[LINEAR] - known.on_scale(drawn(100))[LINEAR]
    np.testing.assert_allclose(shift, usual if failed < 4 else 0, rtol=1e-9)


@pytest.mark.parametrize(("off_px", "differs"), [(2e-6, False), (1e-5, True)])
def test_harmonics_of_offsets_count_only_where_they_matter(off_px: float, differs: bool) -> None:
    """However well simulations agree: stars need 5e-5 px."""
    rng = np.random.default_rng(8)
    key = ("offset_fringes", "a")

    def curve(size: float) -> dict[Key, Curve]:
        return {key: Curve(np.arange(4.0), size + 2e-7 * rng.standard_normal(4))}

    reference = Reference.of([curve(0.0) for _ in range(16)])
    data = reference.on_scale(curve(off_px))
    assert bool(flagged(compare(data, expect_nominal(reference)))) is differs
