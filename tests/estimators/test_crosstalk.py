"""The parts of the crosstalk's measurement, by themselves."""

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pixcal.estimators.crosstalk.covariance import BOTH, OF_RISE, TERMS, Products
from pixcal.estimators.crosstalk.equations import Equations
from pixcal.estimators.crosstalk.hot_pixels import HotPixels
from pixcal.estimators.crosstalk.kernel import best_period
from pixcal.estimators.crosstalk.links import PixelClasses, class_sums, couplings_of, links, periods
from pixcal.estimators.crosstalk.maps import Maps
from pixcal.estimators.crosstalk.sources import Sources
from pixcal.estimators.crosstalk.support import INDEPENDENT, sigmas_of, significant_links
from pixcal.estimators.fringe_fit.modes import solve_modes
from pixcal.estimators.maps.corrected import (
    corrected_offsets,
    offsets,
    phase_change,
    phase_sums,
    straight_modes,
)
from pixcal.kernels import crosstalk
from pixcal.kernels.crosstalk import Coupling, couple, couple_fringes
from pixcal.model.errors import InputError


def test_every_pair_of_pixels_within_reach_is_one_link():
    found = links((61, 67), 3)
    steps = set(itertools.product(range(-3, 4), range(-3, 4))) - {(0, 0)}
    assert {s for dy, dx in found for s in ((dy, dx), (-dy, -dx))} == steps
    assert len(found) == len(steps) / 2


def test_sums_of_classes_are_those_of_their_pixels():
    rng = np.random.default_rng(1)
    values, first = rng.random((2, 37, 41)), (5, 3)
    y, x = np.indices((37, 41))
    seen = []
    for classes, sums in class_sums(values, first):
        number = classes.of(y, x)
        for n in range(classes.count):
            np.testing.assert_allclose(sums[:, n], values[:, number == n].sum(-1))
        ((same, alone),) = class_sums(values, first, (classes.rows, classes.columns))
        assert same == classes
        np.testing.assert_allclose(sums, alone)
        seen.append((classes.rows, classes.columns))
    assert seen == periods((37, 41))
    assert (8, 1) in seen
    assert (1, 8) in seen
    assert (4, 4) in seen


@pytest.mark.parametrize("step", [(1, 0), (-2, 3), (5, -5)])
def test_a_partner_has_the_class_that_is_told(step):
    classes = PixelClasses(4, 3, (2, 1))
    y, x = np.indices((20, 20))
    here, there = classes.of(y, x), classes.of(y + step[0], x + step[1])
    couplings = couplings_of(classes, [step])
    for n in range(classes.count):
        gives, back = couplings[2 * n : 2 * n + 2]
        assert gives.row * classes.columns + gives.column == n
        assert set(there[here == n]) == {back.row * classes.columns + back.column}


def test_significance_is_that_of_the_best_of_many_looks():
    """The largest of N squares of normals; a million draws against the formula's quantiles."""

    def of(best, tests):
        return sigmas_of((best, tests))

    rng = np.random.default_rng(2)
    tests, drawn = 1000, []
    for _ in range(400):
        drawn.append(of(float((rng.standard_normal(350) ** 2).max()), tests))
    assert np.mean(drawn) == pytest.approx(0, abs=0.2)
    assert np.std(drawn) == pytest.approx(1, abs=0.15)
    # Far out the number of tests matters less and less, and nothing overflows.
    assert of(40.0**2, 10**5) == pytest.approx(39.8, abs=0.1)
    ladder = [of(x**2, 10**5) for x in np.linspace(3, 60, 400)]
    assert np.all(np.diff(ladder) > 0)


def test_significance_is_that_of_the_better_of_two_groups_of_looks():
    rng = np.random.default_rng(3)
    drawn = [
        sigmas_of(
            *(
                (float((rng.standard_normal(n) ** 2).max()), round(n / INDEPENDENT))
                for n in (700, 7)
            )
        )
        for _ in range(400)
    ]
    assert np.mean(drawn) == pytest.approx(0, abs=0.2)
    assert np.std(drawn) == pytest.approx(1, abs=0.15)


def noise_shared(steps, alike, share=0.01, maps=None):
    """Products of residuals in which pixels some steps apart share noise, by some part of it."""
    shape = (24, 24)
    normal = np.zeros((len(steps), len(BOTH), *shape))
    normal[:, [0, 4]] = 1e4  # D with D, and D' with D'
    right = np.zeros((len(steps), len(TERMS), *shape))
    for n, step in enumerate(steps):
        right[n, :2] = 1e4 * share if step in alike else 0.0
    line = 1e6 * np.column_stack([np.eye(3), [1, 0, 0]])  # as much noise as the charge gives
    noise = Products(right, normal, line, 0.02, brightest=1.0)
    return Sources(noise, None, maps, steps, shape, (0, 0))


def test_noise_that_far_pixels_share_is_refused_at_once():
    steps = links((24, 24))
    near = tuple(s for s in steps if max(map(abs, s)) < 3)
    shared = noise_shared(steps, near)
    assert significant_links(shared)[0] == near
    assert best_period(shared.of(near)).count == 1
    with pytest.raises(InputError, match=r"^not decided: .* 48 of them beyond 2 pixels"):
        significant_links(noise_shared(steps, steps))


def test_less_is_enough_for_adjacent_pixels_that_couple_alike():
    """Chi-square of 15 for a link by itself, or 16 for those of both axes as one number."""
    steps = links((24, 24))

    def taken(alike, chi2):
        # Of the share there and back as one number: 2 × 576 pixels of weight 1e4.
        share = (chi2 / (2 * 576 * 1e4)) ** 0.5
        return list(significant_links(noise_shared(steps, alike, share))[0])

    assert taken([(0, 1)], 15.0) == [(0, 1)]
    assert taken([(0, 2)], 15.0) == []
    assert taken([(0, 1), (1, 0)], 8.0) == [(0, 1), (1, 0)]
    assert taken([(0, 1), (1, 0)], 5.0) == []


def test_a_period_that_only_the_visibility_shows_is_taken():
    maps = SimpleNamespace(pattern=lambda classes: 500.0 if classes.rows % 3 == 0 else 0.0)
    found = best_period(noise_shared(((1, 0),), [(1, 0)], maps=maps))
    assert (found.rows, found.columns) == (3, 1)


def striped(rng, period, depth):
    """Maps of fringes of 7.3 px whose contrast is lower in one row of each period."""
    shape = (61, 67)
    y, x = np.indices(shape)
    psi, lower = 2 * np.pi * x / 7.3, depth * (y % period == period - 1)
    alpha = 0.9 * (1 - lower + 2e-3 * rng.standard_normal(shape))
    theta = np.stack([np.ones(shape), alpha * np.sin(psi), alpha * np.cos(psi)])
    good = np.ones(shape, bool)
    one = SimpleNamespace(
        good=good,
        delta=np.zeros(shape),
        theta=theta,
        k=(2 * np.pi / 7.3, 0.0),
        origin=(0, 0),
        shot_factor=good,
    )
    return SimpleNamespace(good=good, fringes={"vertical": one})


def test_visibility_of_rows_has_the_chi_square_of_its_period():
    """Noise alone gives one a class; one row in three with 0.2 % less contrast gives more."""
    falls = []
    for depth in (0.0, 2e-3):
        gain = Maps.of(striped(np.random.default_rng(5), period=3, depth=depth)).pattern
        alone = gain(PixelClasses(1, 1, (0, 0)))
        falls.append([gain(PixelClasses(n, 1, (0, 0))) - alone for n in (2, 3, 5)])
    noise, with_pattern = falls
    assert max(noise) < 25
    # Pixels scatter by 0.2 % too: 2/9 a pixel, less what the pattern adds to the scatter.
    assert with_pattern[1] == pytest.approx(2 / 9 * 51 * 57, rel=0.3)
    assert max(with_pattern[0], with_pattern[2]) < 0.1 * with_pattern[1]


def test_a_patch_of_low_contrast_is_no_period_of_columns():
    """It moves what is fitted as smooth and as fringes, of a period that is nearly that of 7 px."""
    maps = striped(np.random.default_rng(6), period=3, depth=0.0)
    theta = maps.fringes["vertical"].theta
    theta[1:, 20:33, 30:36] *= 0.5
    gain = Maps.of(maps).pattern
    assert max(gain(PixelClasses(1, n, (0, 0))) for n in range(1, 9)) < 25


def hot(value, charge=None, sigma=2e-4):
    """Hot pixels at the first class, with one link."""
    value = np.asarray(value, float)
    n = len(value)
    charge = np.full(n, 15.0) if charge is None else np.asarray(charge, float)
    shares = np.zeros((n, 1, 2))
    shares[:, 0, 0] = value
    sigmas = np.full((n, 1, 2), np.inf)
    sigmas[:, 0, 0] = sigma
    return HotPixels(4 * np.arange(n), np.zeros(n, int), charge, shares, sigmas)


def shown(pixels):
    return pixels.equations(PixelClasses(4, 1, (0, 0)), ((1, 0),))


def mean(equations):
    """Weight of the share that the first class gives, and its value at the mean charge."""
    weight = equations.normal[0, 0, 0]
    assert np.count_nonzero(weight) == 1
    return weight[0], equations.right[0, 0, 0] / weight[0]


def test_hot_pixels_that_agree_are_averaged():
    weight, value = mean(shown(hot([0.0302, 0.0298, 0.0300, 0.0304])))
    assert value == pytest.approx(0.0301)
    assert weight == pytest.approx(4 / 2e-4**2)


def test_a_warm_neighbour_among_several_is_left_out_and_of_two_neither_is_believed():
    weight, value = mean(shown(hot([0.0001, -0.0001, 0.05, 0.0002, 0.0])))
    assert abs(value) < 2e-4
    assert weight == pytest.approx(4 / 2e-4**2)
    weight, value = mean(shown(hot([0.0, 0.03])))
    assert value * np.sqrt(weight) < 2


def test_what_rises_with_the_charge_is_not_taken_for_a_share():
    """Brighter-fatter moves more of a brighter hot pixel: the share at small signals is none."""
    charge = np.linspace(8, 40, 12)
    for share in (0.0, 0.006):
        normal, right = shown(hot(share + 5e-5 * charge, charge, 1e-4)).shares(0.0)
        found, error = right[0, 0] / normal[0, 0, 0], normal[0, 0, 0] ** -0.5
        assert abs(found - share) < 2.5e-4
        assert 1e-5 < error < 3e-4


def test_a_rise_that_no_hot_pixel_shows_has_no_finite_error():
    none = np.zeros((1, 2))
    for charge, measured in ((None, False), ([10, 20], True)):
        share, rise, covariance = shown(hot([0.03, 0.03], charge)).rises(none, none)
        assert np.isfinite(share).all()
        assert np.isfinite(rise).all()
        assert not np.isnan(covariance).any()
        assert np.isinf(covariance[0, :, 1, 1]).tolist() == [not measured, True]


@pytest.mark.parametrize("per_ke", [0.0, 0.02])
def test_shares_and_their_rise_are_those_that_made_the_sums(per_ke):
    """Of noise, which rises with the sum of both shares, and of hot pixels, with each."""
    rng = np.random.default_rng(7)
    shares = rng.uniform(0, 0.02, (3, 2, 2))  # link, class, direction
    for of_rise, nuisance in ((OF_RISE, np.eye(2)), (np.eye(2), np.ones((1, 2)))):
        root = rng.standard_normal((3, 2, 4, 9))
        normal = np.moveaxis(root @ root.swapaxes(2, 3), 1, -1)
        free = np.array([3e-3, 0.0]) if len(nuisance) > 1 else np.zeros(2)
        every = np.concatenate([shares, per_ke * shares @ of_rise.T + free], axis=-1)
        right = np.einsum("ltuc,lcu->ltc", normal, every)
        made = Equations(normal, right, of_rise, nuisance, np.full(len(nuisance), 1e9))
        matrix, rest = made.shares(per_ke)
        np.testing.assert_allclose(
            np.linalg.solve(matrix, rest[..., None])[..., 0], shares.reshape(3, 4)
        )
        # The same of shares that were corrected but for their rise.
        known = np.einsum("ltuc,lcu->ltc", normal[:, :, :2], shares)
        left = Equations(normal, right - known, of_rise, nuisance, np.full(len(nuisance), 1e9))
        matrix, rest = left.risen(-per_ke * shares).shares(per_ke)
        np.testing.assert_allclose(rest, 0, atol=1e-9 * np.abs(right).max())


def test_offsets_follow_a_change_of_the_maps_less_its_modes():
    rng = np.random.default_rng(4)
    shape, k = (45, 52), (0.9, 0.3)
    y, x = np.indices(shape)
    delta = 0.002 * rng.standard_normal(shape)
    length = float(np.hypot(*k))
    psi = k[0] * x + k[1] * y + length * delta

    def maps(phase):
        return np.stack([np.full(shape, 2e4), 1.8e4 * np.sin(phase), 1.8e4 * np.cos(phase)])

    modes = straight_modes(maps(psi), k)
    spoilt = 0.02 * np.where(y % 4 == 1, 1.0, -0.5)
    before = maps(psi + spoilt)
    sigma = np.full(shape, 3e-4)
    delta[3, 7] = np.nan
    found = corrected_offsets(
        delta + spoilt / length, sigma, phase_change(before, maps(psi)), modes, length
    )
    good = np.isfinite(delta)
    assert np.array_equal(np.isfinite(found), good)
    free = np.linalg.lstsq(modes[:, good].T, delta[good], rcond=None)[0]
    np.testing.assert_allclose(found, delta - np.tensordot(free, modes, 1), atol=1e-7)


def test_offsets_of_pieces_are_those_of_the_whole():
    rng = np.random.default_rng(5)
    delta, change = rng.standard_normal((2, 31, 29))
    sigma = 1 + rng.random((31, 29))
    modes = rng.standard_normal((7, 31, 29))
    whole = corrected_offsets(delta, sigma, change, modes, 0.7)
    pieces = [np.s_[:13], np.s_[13:]]
    sums = [phase_sums(modes[:, p], delta[p], sigma[p], change[p], 0.7) for p in pieces]
    coefficients = solve_modes(*(sum(s) for s in zip(*sums, strict=True)))
    for p in pieces:
        part = offsets(modes[:, p], coefficients, delta[p], change[p], 0.7)
        np.testing.assert_allclose(part, whole[p], atol=1e-12)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_small_arrays_that_take_a_distance_at_once_are_no_other(
    monkeypatch: pytest.MonkeyPatch, kind: type[np.floating[Any]]
) -> None:
    rng = np.random.default_rng(4)
    couplings = [
        Coupling(dy, dx, rng.normal(0, 0.01), 3, row, 2, column)
        for dy, dx in ((0, 1), (-1, 0), (2, -2))
        for row in range(3)
        for column in range(2)
    ]
    couplings += [Coupling(0, 1, 0.003), Coupling(1, 1, 0.002, per_ke=1e-3)]
    signal, theta = rng.uniform(0, 3e4, (2, 3, 23, 31)).astype(kind)
    one = couple(signal, couplings, (5, 2)), couple_fringes(theta, couplings, (5, 2))
    monkeypatch.setattr(crosstalk, "MAP_PIXELS", 0)
    crosstalk._steps.cache_clear()
    each = couple(signal, couplings, (5, 2)), couple_fringes(theta, couplings, (5, 2))
    crosstalk._steps.cache_clear()
    assert all(np.array_equal(a, b) for a, b in zip(one, each, strict=True))
