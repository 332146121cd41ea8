"""The bound of a pixel: closed forms, quadrature, and the sweep's own bound of real frames."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pixcal.estimators.fringe_fit.fringes import FrameParameters
from pixcal.estimators.fringe_fit.sweep import phase_bound
from pixcal.estimators.fringe_fit.tile_fit import Tile
from pixcal.stages.budget.calibration import WeightErrors
from pixcal.stages.budget.information import (
    FrameSpread,
    phase_information,
    sampling_loss,
    unweighted_variance,
)

U = 2 * np.pi * (np.arange(20_000) + 0.5) / 20_000
LIGHT = st.floats(10, 1e5)
SHARE = st.floats(0.01, 1)
READ = st.floats(0.1, 1e4)


def slopes(phases):
    return np.stack([np.ones(len(phases)), np.sin(phases), np.cos(phases)], axis=1)


@given(LIGHT)
def test_full_contrast_without_read_noise_gives_the_mean_light(iota):
    assert phase_information(iota, iota, 0.0) == pytest.approx(iota, rel=1e-12)
    assert unweighted_variance(iota, iota, 0.0) == pytest.approx(2 / iota, rel=1e-12)


@given(LIGHT, READ)
def test_faint_contrast_is_equal_noise(iota, read):
    """Variance 2 noise / alpha²: weights do not matter any more."""
    alpha = 1e-4 * iota
    expected = alpha**2 / (2 * (iota + read))
    assert phase_information(iota, alpha, read) == pytest.approx(expected, rel=1e-6)
    assert 1 / unweighted_variance(iota, alpha, read) == pytest.approx(expected, rel=1e-6)


@given(LIGHT, SHARE, READ)
def test_the_closed_form_is_the_inverse_of_the_whole_matrix(iota, share, read):
    """Free level and contrast cost the phase nothing."""
    alpha = share * iota
    g = slopes(U)
    noise = iota + alpha * np.sin(U) + read
    information = g.T @ (g / noise[:, None]) / len(U)
    variance = np.linalg.inv(information)[2, 2] / alpha**2
    assert phase_information(iota, alpha, read) == pytest.approx(1 / variance, rel=1e-3)


@given(LIGHT, SHARE, READ)
def test_equal_weights_cost_more(iota, share, read):
    """The variance of least squares, by its sandwich."""
    alpha = share * iota
    j = alpha * np.cos(U)
    noise = iota + alpha * np.sin(U) + read
    sandwich = (j**2 * noise).sum() / (j**2).sum() ** 2 * len(U)
    assert unweighted_variance(iota, alpha, read) == pytest.approx(sandwich, rel=1e-6)
    assert sandwich * phase_information(iota, alpha, read) >= 1 - 1e-6


@pytest.mark.parametrize(("visibility", "ratio"), [(1.0, 1.33), (0.8, 1.11)])
def test_the_cost_of_equal_weights_is_that_of_the_physics_note(visibility, ratio):
    """Section 3: measured on simulated frames of 50 ke- with 16 e- read noise."""
    i, a = 25_000.0, 25_000.0 * visibility
    found = unweighted_variance(i, a, 256.0) * phase_information(i, a, 256.0)
    assert np.sqrt(found) == pytest.approx(ratio, abs=0.01)


def test_changes_from_frame_to_frame_are_averaged():
    rng = np.random.default_rng(3)
    n, visibility = 400_000, 0.9
    level = 1 + 0.1 * rng.normal(size=n)
    amplitude = level * np.clip(1 + 0.05 * rng.normal(size=n), 0, 1 / visibility)
    drawn = FrameSpread(level, amplitude, np.full(n, 1 / n))
    spread = FrameSpread.normal(0.1, 0.05, visibility)
    assert spread.weight.sum() == pytest.approx(1)
    for values in (phase_information, unweighted_variance):
        expected = values(20_000.0, 18_000.0, 256.0, drawn)
        assert values(20_000.0, 18_000.0, 256.0, spread) == pytest.approx(expected, rel=2e-3)
    steady = phase_information([1e4, 2e4], [5e3, 1e4], 100.0, FrameSpread.normal(0, 0, 1.0))
    np.testing.assert_allclose(steady, phase_information([1e4, 2e4], [5e3, 1e4], 100.0))


@pytest.mark.parametrize("visibility", [0.3, 0.95, 1.0])
def test_it_is_the_bound_that_the_fit_reports(visibility):
    """`phase_bound` of a tile with random phases, laser noise and vibration."""
    rng = np.random.default_rng(5)
    n, iota, read = 20_000, 21_000.0, 256.0
    level = 1 + 0.02 * rng.normal(size=n)
    amplitude = level * np.clip(1 + 0.03 * rng.normal(size=n), 0, 1 / visibility)
    phi = rng.uniform(0, 2 * np.pi, n)
    g = np.stack([level, amplitude * np.cos(phi), amplitude * np.sin(phi)], axis=1)
    shape = (3, 5)
    psi = rng.uniform(0, 2 * np.pi, shape)
    wave = visibility * iota
    theta = np.stack([np.full(shape, iota), wave * np.sin(psi), wave * np.cos(psi)])
    full = np.ones(shape, np.float32)
    tile = Tile((0, 3), (0, 5), full * np.float32(read), full, full > 0)
    bound = phase_bound(tile, theta, FrameParameters(g, np.zeros((n, 2)), (1.0, 2.0)))
    spread = FrameSpread.normal(0.02, 0.03, visibility)
    expected = phase_information(iota, wave, read, spread) * n
    # Random phases scatter the information of a pixel by about a percent.
    assert np.mean(bound**-2.0) == pytest.approx(float(expected), rel=0.01)


@pytest.mark.parametrize("steps", [3, 4, 5, 16, 101])
def test_a_few_phases_cost_frames(steps):
    light = 20_000.0, 18_000.0, 256.0
    median, worst = sampling_loss(*light, np.arange(5 * steps) * 2 * np.pi / steps)
    assert 1 - 1e-9 <= median <= worst
    if steps > 100:
        assert worst == pytest.approx(1, abs=1e-3)
    else:
        # By the whole matrix at one fringe phase: never better than the worst of all.
        psi = 0.7 + np.arange(steps) * 2 * np.pi / steps
        g = slopes(psi)
        noise = light[0] + light[1] * np.sin(psi) + light[2]
        one = np.linalg.inv(g.T @ (g / noise[:, None]) / steps)[2, 2] / light[1] ** 2
        assert one * phase_information(*light) <= worst * (1 + 1e-3)


@pytest.mark.parametrize("phases", [[0.0], [0.0, np.pi], [0.3, 1.0, 0.3, 1.0]])
def test_too_few_phases_determine_nothing(phases):
    assert sampling_loss(2e4, 1e4, 256.0, np.array(phases)) == (np.inf, np.inf)


@pytest.mark.parametrize("kind", ["offset", "scale"])
def test_what_wrong_weights_cost(kind):
    """Second order: the sandwich with weights that are off."""
    iota, alpha, read = 20_000.0, 19_500.0, 256.0
    light = iota + alpha * np.sin(U)
    noise, j = light + read, alpha * np.cos(U)
    errors = WeightErrors.of(iota, alpha, read)
    size, wrong = (20.0, noise + 20.0) if kind == "offset" else (0.05, noise + 0.05 * light)
    sandwich = (j**2 / wrong**2 * noise).sum() / (j**2 / wrong).sum() ** 2 * len(U)
    cost = sandwich * phase_information(iota, alpha, read) - 1
    assert getattr(errors, kind) * size**2 == pytest.approx(cost, rel=0.2)
    assert cost > 1e-6


def test_bias_and_flat_errors_leave_the_phase_alone():
    """A wrong bias goes to iota, a wrong flat scales iota and alpha: what the budget rests on."""
    rng = np.random.default_rng(9)
    phi = rng.uniform(0, 2 * np.pi, 300)
    theta = np.array([2e4, 1.2e4, 1.1e4])
    g = np.stack([np.ones(300), np.cos(phi), np.sin(phi)], axis=1)
    weight = 1 / (g @ theta + 256)
    data = g @ theta + rng.normal(size=300) / np.sqrt(weight)

    def phase(values):
        _, sine, cosine = np.linalg.solve(g.T @ (g * weight[:, None]), g.T @ (weight * values))
        return np.arctan2(sine, cosine)

    assert phase(data + 37.0) == pytest.approx(phase(data), abs=1e-12)
    assert phase(data / 1.03) == pytest.approx(phase(data), abs=1e-12)
