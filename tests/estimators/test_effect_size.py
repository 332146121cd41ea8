"""Effect sizes of the gap, on curves drawn with known distributions."""

import numpy as np
import pytest

from pixcal.estimators.test_statistics import Curve, Key
from pixcal.estimators.test_statistics.expectation import (
    FLOOR,
    STRAIGHT,
    Expectation,
    Reference,
    expect_nominal,
    expect_with,
    signature_curve,
    signature_key,
    straight_significance,
)
from pixcal.estimators.test_statistics.gap import (
    EffectSizes,
    SizeScale,
    compare,
    flagged,
    gap_of_sizes,
    sigmas_of,
)
from pixcal.model.arrays import F64

LINEAR: Key = ("harmonics", "a")
POWER: Key = ("contrast_of_frames", "a")
SIGNATURE = signature_key("lag", "time")


def drawn(seed: int, shift: float = 0.0, power: float = 1.0, sigmas: float = 0) -> dict[Key, Curve]:
    rng = np.random.default_rng(seed)
    x = np.arange(5.0)
    return {
        LINEAR: Curve(x, 3e-6 * (rng.standard_normal(5) + shift)),
        POWER: Curve(x, 1e-9 * power * rng.chisquare(200, 5) / 200),
        SIGNATURE: signature_curve(sigmas + rng.standard_normal()),
    }


REFERENCE = Reference.of([drawn(seed) for seed in range(100, 116)])
NOMINAL = expect_nominal(REFERENCE)


def sizes(data: dict[Key, F64], expected: Expectation) -> EffectSizes:
    return SizeScale(data, NOMINAL).compared(expected)


def sizes_of(**effect: float) -> dict[Key, float]:
    data = REFERENCE.on_scale(drawn(7, **effect))
    return {key: abs(size) for key, size in sizes(data, NOMINAL).size.items()}


def test_a_size_grows_with_the_strength_where_a_significance_saturates() -> None:
    weak, strong = sizes_of(shift=40), sizes_of(shift=4000)
    assert strong[LINEAR] / weak[LINEAR] == pytest.approx(100, rel=0.1)
    data = [REFERENCE.on_scale(drawn(7, shift=shift)) for shift in (40, 4000)]
    limited = [sigmas_of(compare(one, NOMINAL)[LINEAR].log_chance) for one in data]
    assert limited[1] < 3 * limited[0]


def test_powers_count_as_amplitudes() -> None:
    weak, strong = sizes_of(power=4.0), sizes_of(power=1e6)
    assert strong[POWER] / weak[POWER] == pytest.approx(999, rel=0.3)


@pytest.mark.parametrize("sigmas", [50.0, 3000.0])
def test_a_significance_counts_in_full(sigmas: float) -> None:
    assert sizes_of(sigmas=sigmas)[SIGNATURE] == pytest.approx(sigmas, rel=0.5)
    values = np.array([-sigmas, -3.0, 0.0, STRAIGHT, sigmas])
    on_scale = np.array([signature_curve(v).value[0] for v in values])
    np.testing.assert_allclose(straight_significance(on_scale), values, rtol=1e-12)


def test_nothing_differs_beyond_two_standard_deviations_from_itself() -> None:
    found = sizes(dict(NOMINAL.mean), NOMINAL)
    assert not any([*found.size.values(), *found.beyond.values()])
    inside = {key: NOMINAL.mean[key] + 1.9 * np.sqrt(NOMINAL.variance[key]) for key in NOMINAL.mean}
    found = sizes(inside, NOMINAL)
    assert all(size > 0.5 for size in found.size.values())
    assert not any(found.beyond.values())


def test_the_size_is_that_of_the_most_significant_value() -> None:
    """So it belongs to the place that is told, although a power may be larger elsewhere."""
    spread = np.array([1e-3, 0.5])
    rng = np.random.default_rng(3)
    powers = [
        {POWER: Curve(np.arange(2.0), np.exp(spread * rng.normal(size=2)))} for _ in range(16)
    ]
    known = Reference.of(powers)
    data = known.on_scale({POWER: Curve(np.arange(2.0), np.array([1.5, 8.0]))})
    nominal = expect_nominal(known)
    worst = compare(data, nominal)[POWER].worst
    size = SizeScale(data, nominal).compared(nominal).size[POWER]
    middle, noise = nominal.mean[POWER][worst], np.sqrt(nominal.noise[POWER][worst])
    amplitude = (np.exp(data[POWER][worst] / 2) - np.exp(middle / 2)) / (np.exp(noise / 2) - 1)
    assert size == pytest.approx(amplitude, rel=0.1)


def test_statistics_that_never_scatter_have_finite_sizes() -> None:
    same = {POWER: Curve(np.arange(2.0), np.ones(2)), LINEAR: Curve(np.arange(2.0), np.zeros(2))}
    known = Reference.of([same] * 16)
    other = {key: Curve(curve.x, curve.value + 3) for key, curve in same.items()}
    nominal = expect_nominal(known)
    found = SizeScale(known.on_scale(other), nominal).compared(nominal)
    assert np.isfinite([*found.size.values(), *found.beyond.values()]).all()
    gap = gap_of_sizes(found, found, {POWER, LINEAR}, {POWER, LINEAR})
    assert gap.total == pytest.approx(1)
    assert gap_of_sizes(found, found, set(), set()).total == 0


def test_the_strong_effect_is_the_gap_and_what_it_opens_counts() -> None:
    data = REFERENCE.on_scale(drawn(7, shift=4000, power=2.0))
    before = sizes(data, NOMINAL)
    where = flagged(compare(data, NOMINAL))
    assert where == {LINEAR, POWER}

    def left_with(**effect: float) -> float:
        expected = expect_with(REFERENCE, [drawn(s, **effect) for s in range(100, 108)])
        after = sizes(data, expected)
        return gap_of_sizes(before, after, where, flagged(compare(data, expected))).total

    weak, strong = (abs(before.size[key]) for key in (POWER, LINEAR))
    assert strong > 100 * weak
    assert left_with() == pytest.approx(1, abs=0.01)
    assert left_with(shift=4000) == pytest.approx(weak / (weak + strong), rel=0.1)
    assert left_with(power=2.0) == pytest.approx(strong / (weak + strong), rel=1e-3)
    assert left_with(shift=4000, power=2.0, sigmas=4000.0) > 0.5


def test_the_least_scatter_of_a_significance_is_its_floor() -> None:
    alike = Reference.of([{SIGNATURE: signature_curve(0.0)} for _ in range(16)])
    nominal = expect_nominal(alike)
    data = alike.on_scale({SIGNATURE: signature_curve(5.0)})
    size = SizeScale(data, nominal).compared(nominal).size[SIGNATURE]
    assert size == pytest.approx(5 / FLOOR)
