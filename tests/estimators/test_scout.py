"""The scout finds the frames; the sweep then reaches the bound."""

import tracemalloc

import numpy as np
import pytest

from pixcal.estimators.fringe_fit import scout as scouting
from pixcal.estimators.fringe_fit.fringes import FrameParameters, find_fringe_vector, smooth_phasor
from pixcal.estimators.fringe_fit.scout import Scout
from pixcal.estimators.fringe_fit.tile_fit import Coding, Tile, accumulate, phase_sigma, start_model
from pixcal.kernels.bilinear import solve_pixels
from pixcal.model.errors import InputError


def scout_of(bench, name="vertical"):
    bench.bias = np.full(bench.shape, 300.0)
    codes = bench.read_out(bench.electrons(name)[0])
    ny, nx = bench.shape
    full = np.ones(bench.shape, np.float32)
    tile = Tile((0, ny), (0, nx), full * np.float32(bench.read_noise**2 + 1 / 12), full, full > 0)
    k = np.array(bench.sets[name]) * 2 * np.pi * bench.pitch / (bench.wavelength * bench.distance)
    nominal = (1.05 * k[0], 1.05 * k[1])
    return Scout([tile], Coding(1.0, -300.0, 65535), nominal, ((ny - 1) / 2, (nx - 1) / 2)), codes


@pytest.mark.parametrize("interfringe", [2.7, 5.0, 9.0, 23.0])
def test_frames_are_found_whatever_the_interfringe(bench, interfringe):
    made = bench(interfringe=interfringe, laser_noise=0.02, visibility_noise=0.03)
    scout, codes = scout_of(made)
    frames = scout.prime([codes])
    b, a, phi, _ = made.scan("vertical")
    np.testing.assert_allclose(frames.B / frames.B.mean(), b / b.mean(), atol=1e-3)
    np.testing.assert_allclose(frames.A / frames.A.mean(), a / a.mean(), atol=3e-3)
    offset = np.angle(np.exp(1j * (frames.phi - phi)))
    turned = np.angle(np.exp(1j * (offset - offset[0])))
    # What the gauge leaves free (fringes of the true offsets) moves the phases by some 1e-4.
    assert turned.std() < 2e-3
    assert not scout.moving


def test_error_is_at_the_bound_with_everything_free(bench):
    made = bench(
        shape=(67, 83),
        frames=250,
        laser_noise=0.02,
        visibility_noise=0.05,
        vector_noise=1e-2,
        visibility=0.9,
    )
    scout, codes = scout_of(made)
    frames = scout.prime([codes])
    assert scout.moving
    tile = scout.tiles[0]
    model, _ = start_model(tile, [codes], scout.coding, frames, scout.k)
    sums = accumulate(tile, [codes], scout.coding, frames, model)
    step, covariance, chi2 = solve_pixels(sums)
    theta = model + step
    error = np.angle((theta[2] + 1j * theta[1]) * np.exp(-1j * made.psi("vertical")))
    k = made.wave_number("vertical")
    error = made.without_modes(np.angle(np.exp(1j * (error - error[30, 40]))) / k, "vertical")
    sigma = phase_sigma(theta, covariance) / k
    # 5561 pixels: rms known to 1 %.
    assert error.std() / made.bound("vertical") < 1.03
    assert 0.97 < (error / sigma).std() < 1.03
    assert np.median(chi2) / (made.frames - 3) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("motion", [0.0, 2e-4, 1e-2])
def test_turns_left_out_would_change_nothing_that_noise_does_not_hide(bench, monkeypatch, motion):
    found, turns = {}, {}
    refine = Scout._refine
    for settled in (scouting.CONVERGED, 0.0):
        monkeypatch.setattr(scouting, "CONVERGED", settled)
        taken = []
        monkeypatch.setattr(Scout, "_refine", lambda *a, n=taken: n.append(1) or refine(*a))
        scout, codes = scout_of(bench(shape=(67, 83), frames=250, vector_noise=motion))
        frames = scout.prime([codes])
        found[settled], turns[settled] = np.hstack([frames.g, frames.dk]), len(taken)
        _, _, normal = scout._frame_step(scout._samples([codes]), frames, scout.moving)
    few, all_of_them = found.values()
    size = 5 if scout.moving else 3
    change = (few - all_of_them)[:, :size]
    square = np.einsum("ti,tij,tj->", change, normal[:, :size, :size], change)
    assert square < (2 * max(found)) ** 2 * change.size
    fewer, most = turns.values()
    assert fewer <= most == (11 if scout.moving else 3)
    # At 0 three turns are needed, and at 1e-2 all eleven may be: between them some are not.
    assert fewer < most or motion != 2e-4


def test_motion_is_not_claimed_without_motion(bench):
    significances = []
    for seed in range(8):
        scout, codes = scout_of(bench(frames=60, seed=seed))
        scout.prime([codes])
        significances.append(scout.moving_significance)
        assert not scout.moving
    assert np.mean(significances) == pytest.approx(1.0, abs=0.15)


def test_solving_later_frames_agrees_with_solving_all(bench):
    made = bench(frames=200, laser_noise=0.02)
    scout, codes = scout_of(made)
    frames = scout.prime([codes])
    again = scout.solve([codes[150:]])
    np.testing.assert_allclose(again.g, frames.g[150:], atol=2e-5)


def test_some_pixels_tell_frames_of_fringes_as_wide_as_even_steps_would_be(bench, monkeypatch):
    """A quarter of the pixels, and fringes of 4 px: every fourth has the same phase in all rows."""
    made = bench(shape=(60, 64), frames=120, interfringe=4.0)
    found = []
    for most in (scouting.MAX_PIXELS, 60 * 64 // 4):
        monkeypatch.setattr(scouting, "MAX_PIXELS", most)
        scout, codes = scout_of(made)
        scout.prime([codes])
        found.append(scout.solve([codes[80:]]).g)
    np.testing.assert_allclose(found[1], found[0], atol=2e-3)


def test_phase_ramp_instead_of_random_phases(bench):
    made = bench(frames=160, phase="ramp")
    scout, codes = scout_of(made)
    frames = scout.prime([codes])
    steps = np.angle(np.exp(1j * np.diff(frames.phi)))
    np.testing.assert_allclose(steps, 40 / 159, atol=5e-3)


def test_frames_without_fringes_are_refused(bench):
    scout, codes = scout_of(bench(visibility=1e-9))
    with pytest.raises(InputError, match="no fringes"):
        scout.prime([codes])


@pytest.mark.parametrize("interfringe", [36.0, 38.0, 42.0])
def test_too_few_fringes_for_honest_errors_are_refused(bench, interfringe):
    scout, codes = scout_of(bench(interfringe=interfringe))
    with pytest.raises(InputError, match=r"1\.[4-9] fringes across 67 x 61 px"):
        scout.prime([codes])


def test_one_phase_is_refused(bench):
    made = bench(frames=30)
    made.scan = lambda name: (np.ones(30), np.ones(30), np.zeros(30), np.zeros((30, 2)))
    scout, codes = scout_of(made)
    with pytest.raises(InputError, match=r"phase|fringes"):
        scout.prime([codes])


def test_too_few_frames_are_refused(bench):
    scout, codes = scout_of(bench(frames=5))
    with pytest.raises(InputError, match="5 frames"):
        scout.prime([codes])


def test_fringe_vector_to_a_fiftieth_of_a_turn_across_the_window():
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:61, :67]
    for k in ((1.2, 0.1), (-0.6, 0.7), (0.0, 2.4)):
        wave = np.cos(k[0] * x + k[1] * y + 1.0) + 0.3 * rng.normal(size=x.shape) + x / 30
        found = find_fringe_vector(wave[None], np.ones(x.shape, bool), (k[0] * 1.1, k[1] * 0.95))
        np.testing.assert_allclose(found, k, atol=2 * np.pi / 50 / 61)


def test_a_window_without_fringes_is_named_by_its_size():
    noise = np.random.default_rng(5).normal(size=(1, 61, 67))
    with pytest.raises(InputError, match=r"for the window of 67 x 61 px; check"):
        find_fringe_vector(noise, np.ones(noise.shape[1:], bool), (1.2, 0.1))


def test_smooth_phasor_keeps_a_curved_phase():
    y, x = np.mgrid[:61, :67] - np.array([30, 33])[:, None, None]
    psi = 1.2 * x + 0.1 * y + 2e-4 * x * x - 1e-4 * x * y
    truth = (0.8 + 1e-3 * x) * np.exp(1j * psi)
    noise = np.random.default_rng(1).normal(0, 0.02, (2, *x.shape))
    good = np.ones(x.shape, bool)
    noisy = truth + noise[0] + 1j * noise[1]
    noisy[5, 6] = 40.0
    found = smooth_phasor(noisy, good, (1.19, 0.11))
    smooth, k = found.map, found.k
    assert np.abs(smooth - truth).max() < 0.02
    np.testing.assert_allclose(k, (1.2, 0.1), atol=2e-3)


def test_frame_parameters_elsewhere():
    rng = np.random.default_rng(2)
    frames = FrameParameters(rng.normal(size=(7, 3)), rng.normal(size=(7, 2)) * 1e-2, (3.0, 4.0))
    np.testing.assert_allclose(frames.at(3.0, 4.0), frames.g)
    there = FrameParameters(frames.at(10.0, -5.0), frames.dk, (10.0, -5.0))
    np.testing.assert_allclose(there.at(3.0, 4.0), frames.g)
    np.testing.assert_allclose(there.A, frames.A)


def test_a_frame_without_samples_takes_nothing_from_the_others(bench):
    scout, codes = scout_of(bench(shape=(40, 47), frames=60, vector_noise=1e-2))
    codes[17] = 65535
    frames = scout.prime([codes])
    np.testing.assert_allclose(frames.g[17], 0, atol=1e-30)
    others = np.arange(60) != 17
    alone, _ = scout_of(bench(shape=(40, 47), frames=60, vector_noise=1e-2))
    wanted = alone.prime([codes[others]])
    assert scout.moving
    assert alone.moving
    np.testing.assert_allclose(frames.B[others] / frames.B[0], wanted.B / wanted.B[0], rtol=1e-4)
    again = scout.solve([codes[16:19]])
    assert np.isfinite(again.g).all()
    np.testing.assert_allclose(again.g[1], 0, atol=1e-30)


def test_the_first_look_does_not_hold_all_samples_as_floating_point(bench):
    """Codes are two bytes a sample; their floats, four, are made a part at a time."""
    scout, codes = scout_of(bench(shape=(128, 128), frames=60))
    many = np.tile(codes, (8, 1, 1))
    tracemalloc.start()
    scout._subspace([many])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.5 * many.nbytes


def test_a_smooth_phasor_of_two_good_rows(bench):
    y, x = np.mgrid[:64, :70]
    good = (y == 10) | (y == 11)
    phasor = np.where(good, 0.9 * np.exp(0.5j * x), 0)
    found = smooth_phasor(phasor, good, (0.5, 0.0))
    smooth, k = found.map, found.k
    np.testing.assert_allclose(smooth[good], phasor[good], atol=1e-6)
    assert k[0] == pytest.approx(0.5)
