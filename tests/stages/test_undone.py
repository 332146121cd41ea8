"""Effects on samples, undone on maps: what the fit of some frames took up of them."""

import numpy as np
import pytest
from joint_fit import fit_jointly

from pixcal.effects.brighter_fatter import BrighterFatter
from pixcal.effects.nonlinearity import Nonlinearity
from pixcal.estimators.maps.corrected import phase_change
from pixcal.kernels.boundaries import REACH, moved_charge
from pixcal.simulation.effect import FringeMaps
from pixcal.stages.diagnose.fitted_set import FitOfFrames, corrected_on_samples

SHAPE = (23, 31)
BENT = Nonlinearity(-0.05, 0.02)


def acquisition(phi):
    y, x = np.indices(SHAPE, float)
    psi = 0.03 * y + 2 * np.pi / 9.3 * x
    theta = np.stack([np.full(SHAPE, 2e4), 1.8e4 * np.sin(psi), 1.8e4 * np.cos(psi)])
    g = np.stack([np.ones_like(phi), np.cos(phi), np.sin(phi)], axis=1)
    samples = BENT.response(np.einsum("ti,iyx->tyx", g, theta).astype(np.float32))
    return theta, fit_jointly(samples.astype(float), theta, g), psi


def third_harmonic(before, after, psi):
    """Of the phase's change against the fringe: no freedom of pixels and frames makes one."""
    change = phase_change(before, after)
    return np.mean((change - change.mean()) * np.exp(-3j * psi))


@pytest.mark.parametrize("law", ["random", "walk"])
def test_harmonics_that_few_phases_bring_into_the_maps_are_undone(law):
    rng = np.random.default_rng(6)
    phi = rng.uniform(0, 2 * np.pi, 20) if law == "random" else rng.normal(0, 0.4, 60).cumsum()
    truth, (theta, g), psi = acquisition(phi)
    maps = FringeMaps(theta, (2 * np.pi / 9.3, 0.03))
    moved = third_harmonic(truth, theta, psi)
    assert abs(moved) > 3e-4
    undone = corrected_on_samples(BENT, maps, FitOfFrames.of(maps, g))
    assert abs(third_harmonic(truth, undone.theta, psi)) < 0.1 * abs(moved)


def test_of_phases_spread_evenly_harmonics_take_no_part():
    truth, (theta, g), psi = acquisition(2 * np.pi * np.arange(60) / 60)
    maps = FringeMaps(theta, (2 * np.pi / 9.3, 0.03))
    fit, even = FitOfFrames.of(maps, g), corrected_on_samples(BENT, maps)
    np.testing.assert_allclose(corrected_on_samples(BENT, maps, fit).theta, even.theta, atol=2.0)
    assert abs(third_harmonic(truth, even.theta, psi)) < 1e-5


def test_of_a_change_of_the_light_the_maps_take_all():
    """A change that is itself a fringe: by the pixels where it is their own alone."""
    _, (theta, g), _ = acquisition(np.linspace(0, 5, 40))
    fit = FitOfFrames.of(FringeMaps(theta, (0.6, 0.0)), g)
    assert not fit.taken_up(np.zeros((12, *SHAPE))).any()
    even = 2 * np.pi * np.arange(12)[:, None, None] / 12
    one = np.zeros((12, *SHAPE))
    one[:, 5:6, 7:8] = 3 + 0.5 * np.cos(even) - 0.2 * np.sin(even)
    taken = fit.taken_up(one)
    np.testing.assert_allclose(taken[:, 5, 7], [3, 0.5, -0.2], atol=0.03)
    assert np.abs(np.delete(taken[:, 5], 7, axis=1)).max() < 0.03


def test_what_charge_moves_is_undone_up_to_the_edges_and_in_the_contrast():
    """Beyond them the fringes go on, where the effect acts and where it is undone."""
    effect, margin = BrighterFatter(6e-7, 0.7, 1.2), REACH + 2
    y, x = np.indices([n + 2 * margin for n in SHAPE], float)
    psi = 0.03 * y + 2 * np.pi / 9.3 * x
    theta = np.stack([np.full(psi.shape, 2e4), 1.8e4 * np.sin(psi), 1.8e4 * np.cos(psi)])
    phi = np.random.default_rng(8).uniform(0, 2 * np.pi, 80)
    g = np.stack([np.ones_like(phi), np.cos(phi), np.sin(phi)], axis=1)
    charge = np.einsum("ti,iyx->tyx", g, theta).astype(np.float32)
    moved = charge.astype(float) + moved_charge(charge, effect._shifts, effect.along_y)
    inside = (..., slice(margin, -margin), slice(margin, -margin))
    truth = theta[inside]
    found, g = fit_jointly(moved[inside], truth, g)
    maps = FringeMaps(found, (2 * np.pi / 9.3, 0.03))
    fit = FitOfFrames.of(maps, g)
    undone = corrected_on_samples(effect, maps, fit, beyond=True).theta
    harmonic, left = third_harmonic(truth, found, psi[inside]), phase_change(truth, undone)
    assert abs(harmonic) > 3e-5
    assert abs(third_harmonic(truth, undone, psi[inside])) < 0.1 * abs(harmonic)
    edges = np.concatenate([left[:, :2], left[:, -2:]], axis=1)
    assert (edges - left.mean()).std() < 3 * left[:, 3:-3].std()

    def contrast(maps):
        return float(np.mean(np.hypot(*maps[1:]) / maps[0]))

    loss = contrast(found) - contrast(truth)
    assert loss < -2e-3
    assert abs(contrast(undone) - contrast(truth)) < 0.1 * abs(loss)
    # A correction undoes it on frames, which end at the edges, and adds what this leaves out.
    closed = corrected_on_samples(effect, maps, fit).theta
    apart = phase_change(closed, undone)
    assert np.abs(apart[:, :3]).max() > 10 * np.abs(apart - np.median(apart))[:, 14:-14].max()
    samples = effect.undo_samples(moved[inside].astype(np.float32)).astype(float)
    as_corrected, _ = fit_jointly(samples, truth, g)
    same = phase_change(as_corrected, closed)
    assert np.abs(same - np.median(same)).max() < 0.1 * np.abs(apart).max()
