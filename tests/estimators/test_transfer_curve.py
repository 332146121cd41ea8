"""Detector frames tell gain, response and converter, of a camera with little noise too."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import chdtrc

from pixcal.effects.nonlinearity import Nonlinearity
from pixcal.effects.quantisation import Quantisation
from pixcal.estimators.crosstalk.boundaries import shared_charge
from pixcal.estimators.crosstalk.kernel import within
from pixcal.estimators.crosstalk.links import links
from pixcal.estimators.crosstalk.sources import sources_of, total
from pixcal.estimators.detector.flat_noise import shot_share_of_flats
from pixcal.estimators.detector.response_of_flats import ladder_curve
from pixcal.estimators.detector.transfer_curve import shot_share, sums_of_stacks, transfer_curve
from pixcal.estimators.diagnosis.evidence import Evidence, Stack
from pixcal.estimators.test_statistics.noise import read_noise
from pixcal.kernels.boundaries import boundary_shifts
from pixcal.simulation.forward import numbers, with_numbers

SHAPE = (93, 101)
READ, GAIN, BIAS, DARK = 1.0, 1.5, 200.3, 0.4


Response = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def knee(charge: NDArray[np.float64]) -> NDArray[np.float64]:
    """Signal that bends above 12 ke-: 6 % at 18 ke-."""
    return charge * (1 - 0.06 * np.maximum(charge / 6e3 - 2, 0) ** 2)


def evidence(
    seed: int = 1,
    quadratic: float = 0.0,
    read: float = READ,
    response: Response = lambda charge: charge,
    lamp: float | None = None,
    count: int = 8,
    rows: float = 0.0,
    lights: tuple[float, float] = (1500, 18000),
) -> Evidence:
    """Flats in pairs, and bias and dark frames whose signal is about the read noise."""
    rng = np.random.default_rng(seed)
    pattern = 1 + 0.01 * rng.standard_normal(SHAPE)

    def stack(kind: str, frames: int, seconds: float, light: float) -> Stack:
        charge = rng.poisson(light * pattern + DARK * seconds, (frames, *SHAPE)).astype(float)
        charge *= 1 + quadratic * charge / 2e4
        charge = response(charge)
        charge += read * rng.standard_normal(charge.shape)
        charge[:, ::2] += rows * rng.standard_normal((frames, 1, 1))
        adu = np.rint(BIAS + charge / GAIN).astype(np.float32)
        return Stack(
            kind, seconds, np.arange(frames), np.arange(float(frames)), adu, step=int(light)
        )

    levels = np.linspace(*lights, count)
    times = np.zeros(count) if lamp is None else levels / 1e5
    every = levels * (1 + (lamp or 0.0) * rng.standard_normal(count))
    return Evidence(
        fringes={},
        stacks=(
            stack("bias", 40, 0.0, 0),
            stack("dark", 10, 1.0, 0),
            *(stack("flat", 2, *one) for one in zip(times, every, strict=True)),
        ),
        gain=GAIN,
        read_noise=float(np.hypot(read, GAIN / np.sqrt(12))),
        amplifier_noise=read,
        bias=np.full(SHAPE, BIAS),
        dark_rate=np.full(SHAPE, DARK),
        flat=pattern,
        good=np.ones(SHAPE, np.bool_),
        saturation_adu=65535.0,
        pitch_um=5.0,
        wavelength_nm=600.0,
        distance_mm=1000.0,
        photon_transfer=(GAIN, 0.01, 1.0),
    )


def test_dark_signal_of_the_order_of_the_read_noise_leaves_the_photon_transfer_right() -> None:
    curve = transfer_curve(evidence())
    assert curve is not None
    assert abs(curve.share - 1) < 4 * curve.error < 0.04
    assert abs(curve.slope) < 4 * curve.slope_error


def test_however_many_the_samples_the_noise_is_known_to_half_a_per_cent_at_best() -> None:
    found = shot_share(1e8 * sums for sums in sums_of_stacks(evidence()))
    assert found is not None
    assert found[1] == pytest.approx(0.005, rel=0.01)


@pytest.mark.parametrize("dark", [0.8, 1.3])
def test_noise_of_dark_frames_that_is_not_that_of_flats_does_not_bend_the_curve(
    dark: float,
) -> None:
    """As of a camera that clips black; `reduce` finds that the darks are not on the curve."""
    read = 20.0
    true = float(np.hypot(read, GAIN / np.sqrt(12)))
    frames = evidence(3, read=read, count=16, lights=(100, 4000))
    frames = replace(
        frames,
        stacks=tuple(
            s if s.kind == "flat" else replace(s, adu=BIAS + dark * (s.adu - BIAS))
            for s in frames.stacks
        ),
    )
    biased = transfer_curve(frames)
    assert biased is not None
    assert abs(biased.slope) > 4 * biased.slope_error
    known = replace(frames, without_dark=True, read_noise_error=0.01 * true)
    curve = transfer_curve(known)
    assert curve is not None
    assert abs(curve.share - 1) < 4 * curve.error < 0.2
    assert abs(curve.slope) < 4 * curve.slope_error < 0.2
    share = shot_share_of_flats(known)
    assert share is not None
    assert abs(share[0] - 1) < 4 * share[1] < 0.1


@pytest.mark.parametrize("seed", range(6, 9))
def test_a_knee_is_measured_from_level_to_level(seed: int) -> None:
    frames = evidence(seed, response=knee, lamp=0.0, count=16)
    found = Nonlinearity.estimate(frames)
    assert found is not None
    assert isinstance(found.effect, Nonlinearity)
    # Low signals are straight: their slope is part of the gain.
    assert [bend.change_e for bend in found.effect.bends[:3]] == [0, 0, 0]
    at = np.array([bend.level_e for bend in found.effect.bends[3:]])
    # Its errors hang together: all changes are off by the same factor if the gain is.
    steps = np.array([[own[key] for key in found.errors][2:] for own in found.together])
    off = np.linalg.solve(steps.T, found.effect.response(at) - knee(at))
    assert chdtrc(len(at), off @ off) > 1e-4
    assert np.hypot.reduce(steps, axis=0)[-1] < 0.02 * at[-1]
    assert found.significance > 10


@pytest.mark.parametrize("seed", range(6, 8))
@pytest.mark.parametrize(
    ("share", "start", "count"), [(0.2, 17e3, 16), (0.4, 18e3, 16), (0.2, 17.8e3, 6)]
)
def test_a_response_is_straight_up_to_where_it_bends(
    share: float, start: float, count: int, seed: int
) -> None:
    """No polynomial describes it: that of the noise is 6 to 8 % off at half of the level."""
    frames = evidence(
        seed, response=lambda e: e - share * np.maximum(e - start, 0), lamp=0.0, count=count
    )
    found = Nonlinearity.estimate(frames)
    assert found is not None
    assert isinstance(found.effect, Nonlinearity)
    assert found.significance > 5
    at = np.linspace(3e3, 14e3, 20)
    values = numbers(found.effect)
    shifts = [{key: values[key] + step for key, step in own.items()} for own in found.together]
    moved = [with_numbers(found.effect, values | own) for own in shifts]
    off = np.array([one.response(at) - found.effect.response(at) for one in moved])
    assert (np.abs(found.effect.response(at) - at) < 4 * np.hypot.reduce(off)).all()
    assert (np.hypot.reduce(off) < 0.015 * at).all()


@pytest.mark.parametrize("lamp", [0.02, None])
def test_levels_of_a_lamp_that_is_not_known_tell_no_curve(lamp: float | None) -> None:
    assert ladder_curve(evidence(5, response=knee, lamp=lamp)) is None


@pytest.mark.parametrize("seed", range(6, 9))
def test_where_a_polynomial_suffices_no_curve_is_told(seed: int) -> None:
    assert ladder_curve(evidence(seed, quadratic=-0.04, lamp=0.0)) is None


def test_photon_transfer_tells_a_response_that_bends() -> None:
    found = Nonlinearity.estimate(evidence(2, quadratic=-0.04))
    assert found is not None
    assert isinstance(found.effect, Nonlinearity)
    at_2e4 = found.effect.quadratic * 2e4 / found.effect.level_e
    error = found.errors["quadratic"] * 2e4 / found.effect.level_e
    assert abs(at_2e4 + 0.04) < 4 * error < 0.04
    assert found.significance > 4


@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_flats_tell_missing_codes_where_the_read_noise_is_below_a_code(missing: float) -> None:
    given = evidence(3, read=0.5)
    there = np.random.default_rng(4).random(1 << 14) >= missing
    there[-1] = True
    codes = np.flatnonzero(there)
    code = codes[np.searchsorted(codes, np.arange(1 << 14))].astype(np.float32)
    stacks = tuple(replace(s, adu=code[s.adu.astype(int)]) for s in given.stacks)
    found = Quantisation.estimate(replace(given, stacks=stacks))
    assert found is not None
    assert (found.significance > 10) == (missing > 0)
    assert found.significance > 10 or found.significance < 4


def with_pixels(noise: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Read-noise statistic with masked pixels that have a noise (t, pixel), and without."""
    given = evidence(5)
    bias, *others = given.stacks
    adu, good = bias.adu.copy(), given.good.copy()
    adu[:, 3, : noise.shape[1]] += noise.astype(np.float32)
    good[3, : noise.shape[1]] = False
    changed = replace(given, stacks=(replace(bias, adu=adu), *others), good=good)
    found, before = read_noise.measure(changed), read_noise.measure(given)
    assert found is not None
    assert before is not None
    return found.value, before.value


def test_masked_pixels_are_part_of_the_read_noise_only_if_they_jump() -> None:
    rng = np.random.default_rng(6)
    loud, quiet = with_pixels(10 * rng.standard_normal((40, 60)))
    assert loud == pytest.approx(quiet, rel=0.05)
    jumps = 20.0 * ((rng.random((40, 60)) < 0.2).cumsum(axis=0) % 2)
    loud, quiet = with_pixels(jumps)
    assert loud[-1] > 2 * quiet[-1]


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_what_every_second_row_has_in_common_is_no_shot_noise(seed: int) -> None:
    """Of two frames it may be much or nothing."""
    curve = transfer_curve(evidence(seed, rows=60.0))
    assert curve is not None
    assert np.abs((curve.shares - 1) / curve.errors).max() < 4


def test_pairs_of_flats_without_shared_charge_show_none_within_the_error() -> None:
    shifts = boundary_shifts(0.5)
    found = [shared_charge(evidence(seed, count=4), shifts) for seed in range(60)]
    pulls = [
        [one.size / one.variance**0.5, *(one.axes / np.diag(one.covariance) ** 0.5)]
        for one in found
        if one is not None
    ]
    scatter = np.std(pulls, axis=0)
    # Of 60 a standard deviation is known to a tenth.
    assert (scatter > 0.78).all()
    assert (scatter < 1.3).all()


@pytest.mark.parametrize("count", [2, 8])
def test_pairs_of_flats_without_couplings_show_none_within_the_error(count: int) -> None:
    """Two residuals of a pair are the same with the other sign: one product, not two."""
    steps, found = within(SHAPE), []
    for seed in range(100, 112):
        sources = sources_of([evidence(seed, count=count)], lambda _: steps)
        assert sources is not None
        normal, right = total(next(sources.periods())[1])
        found.append(right.sum(axis=1) / normal.sum(axis=(1, 2)) ** 0.5)
    # Of 144 a standard deviation is known to 6 %.
    assert np.std(found) == pytest.approx(1, abs=0.25)


def shared(share: float, rising: bool) -> Response:
    """A share of the charge, or one that rises with it up to 18 ke-, goes to the columns beside."""

    def coupled(charge: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = charge * charge / 1.8e4 if rising else charge
        beside = np.roll(moved, 1, -1) + np.roll(moved, -1, -1)
        return np.asarray(charge + share * (beside - 2 * moved))

    return coupled


def test_a_coupling_of_flats_is_shared_charge_where_it_rises_with_the_level() -> None:
    """Not where it is crosstalk, which has as much noise in common at all levels."""
    sigmas = {}
    for rising in (True, False):
        # The correlation of neighbours in the brightest flats is the same.
        response = shared(0.013 if rising else 0.026, rising)
        found = [
            shared_charge(evidence(n, response=response), boundary_shifts(0.5)) for n in range(12)
        ]
        sigmas[rising] = [one.axes[0] / one.covariance[0, 0] ** 0.5 for one in found if one]
    # The correlation rises to 5.2 %, 0.0103 known from a pair: 8.3 sigma of eight pairs.
    assert np.median(sigmas[True]) > 6
    assert np.abs(np.median(sigmas[False])) < 2


def test_a_simulation_has_the_levels_of_what_it_is_held_against() -> None:
    data = evidence()
    top = float(np.quantile(data.ladder[-1].adu, 0.995))
    brighter = replace(data, saturation_adu=top)
    assert brighter.saturated == {data.ladder[-1].level}
    assert len(brighter.ladder) == len(data.ladder) - 1
    assert len(replace(brighter, full=data.saturated).ladder) == len(data.ladder)
    assert len(replace(data, full=brighter.saturated).ladder) == len(brighter.ladder)


def test_some_links_are_measured_as_among_all() -> None:
    given = evidence(4, count=3)
    rate = given.dark_rate * np.random.default_rng(5).exponential(1, SHAPE)
    rate[20::30, 15::30] = 5e3
    given = replace(given, dark_rate=rate)
    every, near = links(SHAPE), within(SHAPE)
    among, alone = (sources_of([given], lambda _, own=own: own) for own in (every, near))
    assert among is not None
    assert alone is not None
    some = among.of(near)
    assert some.links == alone.links
    for one, other in ((some.noise, alone.noise), (some.hot, alone.hot)):
        assert one is not None
        assert other is not None
        for key, value in vars(other).items():
            np.testing.assert_array_equal(vars(one)[key], value)
