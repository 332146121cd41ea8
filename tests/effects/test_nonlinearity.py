"""Nonlinearity: its polynomial, the harmonics it makes, its inverse, and its coefficients again."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import galsim
import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.nonlinearity import CurvePoint, Nonlinearity, _straight_on
from pixcal.estimators.detector.response_of_flats import _bent_by_noise
from pixcal.estimators.detector.transfer_curve import TransferCurve
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.arrays import F64
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Estimate
from pixcal.simulation.recording import recordings

QUIET = {
    "detector.shape": [9, 7],
    "detector.read_noise_e": 0.0,
    "detector.prnu_rms": 0.0,
    "detector.hot_fraction": 0.0,
    "detector.bias_pixel_rms_adu": 0.0,
    "detector.dark_e_s": 0.0,
    "frames.fringes.0.count": 90,
    "frames.fringes.0.phase_law": "ramp",
    "frames.fringes.0.phase_step_rad": 2 * np.pi / 30,
}


def quiet(make: Callable[..., Bench]) -> Bench:
    return replace(make(QUIET), shot_noise=False)


@pytest.fixture(scope="module")
def bent(acquired: Callable[..., Evidence]) -> tuple[Evidence, Estimate]:
    """An acquisition with the effect as it usually is, and what is found in it."""
    evidence = acquired(None, {"nonlinearity": {}})
    found = Nonlinearity.estimate(evidence)
    assert found is not None
    return evidence, found


def assert_recovered(found: Estimate | None, truth: Nonlinearity) -> None:
    assert found is not None
    assert isinstance(found.effect, Nonlinearity)
    for name in ("quadratic", "cubic"):
        off = getattr(found.effect, name) - getattr(truth, name)
        assert abs(off) < 4 * found.errors[name], name


def test_the_response_is_the_published_polynomial() -> None:
    effect = Nonlinearity(-0.02, 0.006)
    charge = np.linspace(0, 60_000, 77, dtype=np.float32).reshape(7, 11)
    image = galsim.Image(charge.copy())
    w = effect.level_e
    image.applyNonlinearity(lambda s: s - 0.02 * s**2 / w + 0.006 * s**3 / w**2)
    np.testing.assert_allclose(effect.response(charge), image.array, rtol=1e-6)
    assert effect.response(np.float32([50_000]))[0] == pytest.approx(50_000 * (1 - 0.02 + 0.006))


@pytest.mark.parametrize(
    "effect",
    [
        Nonlinearity(),
        Nonlinearity(-0.1, 0.05),
        Nonlinearity(0.2, 0.1),
        Nonlinearity(0.0, -0.3),
        Nonlinearity(
            0.01,
            0.0,
            bends=(CurvePoint(0.0, 0.0), CurvePoint(900.0, 40.0), CurvePoint(50_000.0, -30.0)),
        ),
    ],
)
def test_the_inverse_gives_the_charge_back(effect: Nonlinearity) -> None:
    charge = np.linspace(-200, 60_000, 999, dtype=np.float32)
    charge = charge[charge < 0.9 * effect.turns_at * effect.level_e]
    assert len(charge) > 700
    np.testing.assert_allclose(effect.linearised(effect.response(charge)), charge, atol=0.05)


def test_beyond_its_top_the_response_stays_there() -> None:
    effect = Nonlinearity(-0.3, -0.3)
    top = effect.turns_at * effect.level_e
    above = np.float32([1.1 * top, 3 * top])
    np.testing.assert_allclose(effect.response(above), effect.response(np.float32([top]))[0])
    np.testing.assert_allclose(effect.linearised(above), top, rtol=1e-3)
    assert np.isnan(effect.linearised(np.float32([np.nan]))[0])


def test_a_well_beyond_the_top_is_refused(make_effect_bench: Callable[..., Bench]) -> None:
    bench = make_effect_bench({"detector.full_well_e": 60_000.0})
    Nonlinearity().check(bench)
    with pytest.raises(InputError, match=r"effects.nonlinearity: .* stops rising at 3"):
        Nonlinearity(-0.3, -0.3).check(bench)


def test_fringes_get_the_harmonics_of_the_polynomial(
    make_effect_bench: Callable[..., Bench],
) -> None:
    bench = quiet(make_effect_bench)
    effect = Nonlinearity(-0.03, 0.02)
    fringes = next(r for r in recordings(bench) if r.kind == "fringes")
    made = frames_of(bench, fringes, [effect]).astype(float) - bench.detector.bias_adu
    plain = frames_of(bench, fringes).astype(float) - bench.detector.bias_adu
    phase = 2 * np.pi / 30 * np.arange(90)

    def harmonic(frames: np.ndarray, n: int) -> np.ndarray:
        return np.abs(np.tensordot(np.exp(-1j * n * phase), frames, 1)) * 2 / len(phase)

    iota, alpha, w = plain.mean(axis=0), harmonic(plain, 1), effect.level_e
    second = alpha**2 / 2 * np.abs(effect.quadratic / w + 3 * effect.cubic * iota / w**2)
    third = alpha**3 / 4 * abs(effect.cubic) / w**2
    # Rounding to whole ADU leaves 0.3 / sqrt(90 / 2) in each.
    np.testing.assert_allclose(harmonic(made, 2), second, atol=0.3)
    np.testing.assert_allclose(harmonic(made, 3), third, atol=0.3)
    assert second.min() > 3
    assert third.min() > 5


@pytest.mark.long
def test_its_coefficients_are_found(bent: tuple[Evidence, Estimate]) -> None:
    assert_found_well(bent[1], Nonlinearity())


@pytest.mark.long
def test_its_significance_needs_no_estimate(bent: tuple[Evidence, Estimate]) -> None:
    evidence, found = bent
    assert Nonlinearity.detect(replace(evidence)) == found.significance


@pytest.mark.long
def test_coefficients_of_a_small_one_are_found(acquired: Callable[..., Evidence]) -> None:
    effects = {"nonlinearity": {"quadratic": 0.003, "cubic": 0.0}}
    found = Nonlinearity.estimate(acquired(None, effects))
    assert found is not None
    assert_found_well(found, Nonlinearity(0.003, 0.0))


def assert_found_well(found: Estimate, truth: Nonlinearity) -> None:
    assert_recovered(found, truth)
    assert max(found.errors.values()) < 3e-4
    assert found.significance > 15


@pytest.mark.long
def test_another_response_is_measured_beside_the_polynomial(
    acquired: Callable[..., Evidence],
) -> None:
    """The first electrons are lost: no polynomial of third order, and seen in dark fringes only."""
    levels = np.concatenate([np.geomspace(30, 60_000, 60)])
    lost = -150 * (1 - np.exp(-levels / 1200))
    points = [{"level_e": 0.0, "change_e": 0.0}]
    points += [
        {"level_e": float(a), "change_e": float(b)} for a, b in zip(levels, lost, strict=True)
    ]
    on = {"quadratic": 0.0, "cubic": 0.0, "bends": points}
    found = Nonlinearity.estimate(acquired(None, {"nonlinearity": on}))
    assert found is not None
    assert isinstance(found.effect, Nonlinearity)
    assert isinstance(found.by_law, Nonlinearity)
    assert found.by_law.bends == ()
    lit = np.linspace(2_000, 44_000, 200, dtype=np.float32)
    truth = -150 * (1 - np.exp(-lit.astype(float) / 1200))
    # Without what fringes do not tell: an offset and a factor.
    for one, most in ((found.effect, 4.0), (found.by_law, np.inf)):
        rest = one.response(lit) - lit - truth
        rest -= np.polyval(np.polyfit(lit, rest, 1), lit)
        assert rest.std() < most
    assert rest.std() > 8.0


@pytest.mark.long
def test_a_knee_is_measured_to_a_hundredth_of_its_size(acquired: Callable[..., Evidence]) -> None:
    """Straight up to a knee, and 1500 e- too low at the top: no polynomial has that response."""
    levels = np.linspace(0, 60_000, 241)
    lost = -1500 * np.maximum(levels / 45_000 - 0.6, 0) ** 2 / 0.16
    points = [
        {"level_e": float(a), "change_e": float(b)} for a, b in zip(levels, lost, strict=True)
    ]
    on = {"quadratic": 0.0, "cubic": 0.0, "bends": points}
    evidence = acquired(None, {"nonlinearity": on})
    found = Nonlinearity.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, Nonlinearity)
    # Charge that gives the same signal: but for an offset and a factor, that of the truth.
    lit = np.linspace(2_500, 42_000, 200, dtype=np.float32)
    truth = Nonlinearity(0.0, 0.0, bends=tuple(CurvePoint(**point) for point in points))
    charge = found.effect.linearised(truth.response(lit)).astype(float)
    rest = charge - np.polyval(np.polyfit(lit, charge, 1), lit)
    assert rest.std() < 12.0
    # The size is that of the curve, not of the polynomial that describes it poorly.
    at = float(found.size["of"].split()[-2])
    true = float(np.interp(at, levels, lost)) / at
    assert abs(found.size["value"] - true) < 5 * found.size["error"] < -0.1 * true


@pytest.mark.long
def test_a_response_that_one_set_denies_is_refused(
    acquired: Callable[..., Evidence], bent: tuple[Evidence, Estimate]
) -> None:
    (on, both), off = bent, acquired()
    assert not both.refused
    name = next(iter(on.fringes))
    mixed = {**on.fringes, name: off.fringes[name]}
    found = Nonlinearity.estimate(replace(on, fringes=mixed))
    assert found is not None
    assert found.significance > 4
    assert "sets disagree" in found.refused


@pytest.mark.long
def test_bad_samples_do_not_matter(bent: tuple[Evidence, Estimate]) -> None:
    evidence, _ = bent
    fringes = {}
    for name, one in evidence.fringes.items():
        electrons, good = one.electrons.copy(), one.good.copy()
        electrons[7, 30:40] = np.nan
        electrons[:, 20, 11] = np.nan
        good[20, 11] = good[3:7, 50] = False
        fringes[name] = replace(one, electrons=electrons, good=good)
    assert_recovered(Nonlinearity.estimate(replace(evidence, fringes=fringes)), Nonlinearity())


@pytest.mark.long
def test_one_set_tells_less(bent: tuple[Evidence, Estimate]) -> None:
    """With one spacing of fringes a response and moving boundaries differ by their noise only."""
    evidence, both = bent
    name, one = next(iter(evidence.fringes.items()))
    found = Nonlinearity.estimate(replace(evidence, fringes={name: one}))
    assert_recovered(found, Nonlinearity())
    assert found is not None
    assert found.errors["quadratic"] > 5 * both.errors["quadratic"]
    assert found.significance > 4


def test_flats_tell_where_there_are_no_fringes(acquired: Callable[..., Evidence]) -> None:
    evidence = replace(acquired(None, {"nonlinearity": {}}), fringes={})
    found = Nonlinearity.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, Nonlinearity)
    # Few levels tell one power of the response; the lamp is known to a thousandth.
    top = np.array([found.effect.level_e], np.float32)
    off = (found.effect.response(top) - Nonlinearity().response(top))[0] / top[0]
    assert abs(off) < 4 * found.errors["quadratic"] < 0.012
    assert found.significance > 6
    at = float(found.size["of"].split()[-2])
    true = float(Nonlinearity().response(np.float32([at]))[0]) / at - 1
    assert abs(found.size["value"] - true) < 4 * found.size["error"] < -2 * true
    nominal = Nonlinearity.estimate(replace(acquired(), fringes={}))
    assert nominal is not None
    assert nominal.significance < 4
    two = tuple(s for s in evidence.stacks if s.kind != "flat" or s.exptime_s < 0.025)
    assert Nonlinearity.estimate(replace(evidence, stacks=two)) is None


@pytest.mark.long
def test_moving_boundaries_are_not_taken_for_it(acquired: Callable[..., Evidence]) -> None:
    found = Nonlinearity.estimate(acquired(None, {"brighter_fatter": {"shift_px_per_e": 1e-6}}))
    assert found is not None
    assert found.significance < 4


def test_beyond_the_brightest_fringe_a_measured_response_goes_straight_on() -> None:
    """Where its polynomial, which darker samples gave, would be 3 % lower."""
    points = (
        CurvePoint(0.0, 0.0),
        CurvePoint(500.0, 28.0),
        CurvePoint(9000.0, -9.0),
        CurvePoint(18_000.0, 40.0),
    )
    curve = Nonlinearity(0.16, -0.3, bends=points)

    def beside(brightest: float) -> Any:
        flat = SimpleNamespace(adu=np.full((2, 5, 7), brightest))
        return SimpleNamespace(bias=0.0, gain=1.0, of_kind=lambda _: [flat])

    assert _straight_on(curve, beside(17_000.0)) == []
    whole = replace(curve, bends=(*points, *_straight_on(curve, beside(30_000.0))))
    at = np.float32([9000, 18_000, 19_000, 22_000, 26_000, 30_000])
    signal = whole.response(at).astype(float)
    straight = signal[1] + (signal[1] - signal[0]) / 9000 * (at[2:] - 18_000)
    np.testing.assert_allclose(signal[2:], straight, atol=8)
    below = np.linspace(0, 17_000, 100, dtype=np.float32)
    np.testing.assert_allclose(whole.response(below), curve.response(below), atol=20)
    assert abs(curve.response(at)[-1] - straight[-1]) > 900


def _transfer(signal: Callable[[F64], F64], error: float, levels: int) -> TransferCurve:
    """Noise of flats behind a response, by its derivative."""
    charge = np.linspace(0.1, 1, levels) * 1e4
    at, step = signal(charge), 1.0
    slope = (signal(charge + step) - signal(charge - step)) / (2 * step)
    shares = slope**2 * charge / at
    shares += error * np.random.default_rng(1).standard_normal(levels)
    return TransferCurve(1.0, error, 0.0, error, float(at[-1]), at, shares, np.full(levels, error))


def test_noise_of_many_levels_shows_a_response_of_two_terms() -> None:
    """As an S: neither term can be left out."""
    found = _bent_by_noise(
        _transfer(lambda e: e * (1 + 0.1 * e / 1e4 - 0.15 * (e / 1e4) ** 2), 0.005, 12)
    )
    assert found is not None
    sizes, covariance = found
    top = 1 + 0.1 - 0.15  # the highest signal over its charge
    pulls = (sizes - [0.1 * top, -0.15 * top**2]) / np.sqrt(np.diag(covariance))
    assert np.abs(pulls).max() < 4


@pytest.mark.parametrize(("quadratic", "levels"), [(0.0, 12), (-0.03, 12), (-0.1, 5)])
def test_noise_along_a_line_shows_one_term(quadratic: float, levels: int) -> None:
    assert _bent_by_noise(_transfer(lambda e: e * (1 + quadratic * e / 1e4), 0.01, levels)) is None


def test_a_window_of_few_rows_shows_the_response(acquired: Callable[..., Evidence]) -> None:
    """Rows within the reach of charge outside are used where there are no others."""
    sets = [
        {"name": f"set{n}", "baseline_mm": [mm, 0.0], "count": 100, "peak_e": 45000}
        for n, mm in enumerate((11.5, 7.0))
    ]
    few = {"detector.shape": [8, 120], "frames.fringes": sets}
    found = Nonlinearity.estimate(acquired(few, {"nonlinearity": {"quadratic": -0.05}}))
    assert found is not None
    assert found.significance > 5
    assert isinstance(found.effect, Nonlinearity)
    # Fringes constrain neither offset nor factor: the bend of the curve is compared.
    levels = np.float32([10_000, 20_000, 30_000])
    true = Nonlinearity(-0.05, 0.0).response(levels)
    bend, expected = (r[1] - (r[0] + r[2]) / 2 for r in (found.effect.response(levels), true))
    assert bend == pytest.approx(expected, rel=0.2)
