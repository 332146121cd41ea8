"""Light as beams: the sum over all pairs, and what follows from it."""

from dataclasses import replace

import numpy as np
import pytest

from pixcal.kernels.beams import FIXED, MODULATED, Beam, Light

SHAPE = (13, 17)
Y, X = np.indices(SHAPE, float)


def pair_sum(light: Light, phi: float) -> np.ndarray:
    """Intensity (y, x), by the sum over pairs of beams."""
    total = np.zeros(SHAPE) + light.incoherent
    for n, one in enumerate(light.beams):
        total += one.amplitude**2
        for other in light.beams[n + 1 :]:
            same = one.fibre == other.fibre
            gamma = 1.0 if same else light.coherence * (not (one.crossed or other.crossed))
            moved = phi * ((one.fibre == MODULATED) - (other.fibre == MODULATED))
            wave = np.cos(one.phase - other.phase + moved)
            total += 2 * gamma * one.amplitude * other.amplitude * wave
    return total


def some_light() -> Light:
    """Two unequal beams, ghosts of both, one of them crossed, and stray light."""
    a = Beam(90 * np.exp(-(((X - 3) / 20) ** 2)), 0.7 * X + 0.1 * Y, MODULATED)
    b = Beam(70 * np.exp(-(((Y - 9) / 25) ** 2)), 0.02 * X**2, FIXED)
    ghosts = [
        a.reflected(0.2, 0.4 * X - 0.3 * Y + 1),
        b.reflected(0.1, 0.2 * Y),
        a.reflected(0.15, 0.9 * Y - 2, crossed=True),
    ]
    stray = 300 * np.exp(-((X - Y) ** 2) / 50)
    return Light((a, b), coherence=0.8 + 0.01 * X).with_beams(ghosts).with_incoherent(stray)


@pytest.mark.parametrize("phi", [0.0, 1.3, -2.5])
def test_mean_and_fringes_are_the_sum_over_all_pairs(phi: float) -> None:
    light = some_light()
    found = light.mean + (light.phasor * np.exp(1j * phi)).real
    np.testing.assert_allclose(found, pair_sum(light, phi), rtol=1e-12)


def test_fringes_never_go_below_darkness() -> None:
    light = some_light()
    light = replace(light, beams=tuple(b for b in light.beams if not b.crossed))
    assert (light.mean >= np.abs(light.phasor)).all()


def test_two_beams_of_equal_power_make_given_maps() -> None:
    rng = np.random.default_rng(4)
    mean = rng.uniform(0, 2e4, SHAPE)
    phasor = mean * rng.uniform(0, 1, SHAPE) * np.exp(2j * np.pi * rng.random(SHAPE))
    mean[3, 4] = phasor[3, 4] = 0
    light = Light.of_fringes(mean, phasor)
    np.testing.assert_allclose(light.mean, mean, rtol=1e-12)
    np.testing.assert_allclose(light.phasor, phasor, rtol=1e-9)
    one, other = light.beams
    np.testing.assert_array_equal(one.amplitude, other.amplitude)


def test_a_mask_dims_everything_alike() -> None:
    light, mask = some_light(), np.random.default_rng(1).random(SHAPE)
    np.testing.assert_allclose(light.masked(mask).mean, mask * light.mean, rtol=1e-12)
    np.testing.assert_allclose(light.masked(mask).phasor, mask * light.phasor, rtol=1e-12)


def test_response_scales_what_is_collected() -> None:
    light, response = some_light(), np.random.default_rng(2).random(SHAPE).astype(np.float32)
    collected = light.collected(response)
    np.testing.assert_allclose(collected.iota, response * light.mean, rtol=1e-6)
    np.testing.assert_allclose(collected.phasor, response * light.phasor, rtol=1e-5, atol=1e-3)


def test_unequal_gaussian_beams_have_the_contrast_of_their_ratio() -> None:
    """V = gamma sech(u / 2), u the logarithm of the ratio of the intensities."""
    ratio = np.exp(0.1 * X - 0.05 * Y)
    light = Light((Beam(np.sqrt(1e4 * ratio), X, MODULATED), Beam(np.full(SHAPE, 100.0), 0.0)), 0.9)
    contrast = np.abs(light.phasor) / light.mean
    np.testing.assert_allclose(contrast, 0.9 / np.cosh(np.log(ratio) / 2), rtol=1e-12)
