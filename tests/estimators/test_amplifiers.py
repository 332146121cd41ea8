"""Steps of the gain between amplifiers, told from steps of the response."""

import numpy as np
import pytest

from pixcal.estimators.detector.amplifiers import differing_outputs, relative_gain

SHAPE = (70, 61)
GOOD = np.ones(SHAPE, bool)


def frames(ratio: float, of_gain: bool, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """A flat with a step at column 33, and noise ratios as many samples give them."""
    rng = np.random.default_rng(seed)
    right = np.arange(SHAPE[1]) >= 33
    flat = 1 + 0.01 * rng.standard_normal(SHAPE)
    noise = 1 + 0.04 * rng.standard_normal(SHAPE)
    flat /= np.where(right, ratio, 1.0)
    if of_gain:
        noise /= np.where(right, ratio, 1.0)
    return flat, noise


@pytest.mark.parametrize("ratio", [0.985, 1.02])
@pytest.mark.parametrize("turned", [False, True])
def test_a_step_of_flat_and_noise_is_one_of_the_gain(ratio: float, turned: bool) -> None:
    flat, noise = frames(ratio, of_gain=True)
    maps = (flat.T, noise.T, GOOD.T) if turned else (flat, noise, GOOD)
    found = relative_gain(*maps)
    found = found.T if turned else found
    steps = found[:, 33:].mean(axis=1) / found[:, :33].mean(axis=1)
    assert steps == pytest.approx(ratio, abs=0.001)
    assert np.log(found).mean() == pytest.approx(0, abs=1e-9)


def test_a_step_of_the_response_is_none_of_the_gain() -> None:
    assert (relative_gain(*frames(1.02, of_gain=False), GOOD) == 1).all()


def test_an_even_detector_has_one_gain() -> None:
    assert (relative_gain(*frames(1.0, of_gain=True), GOOD) == 1).all()


def camera(gains: np.ndarray, seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Response in ADU, with vignetting, and shot variance over light, of outputs of given gains."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in gains.shape), indexing="ij")
    light = (1 - 0.05 * (x**2 + y**2) + 0.02 * x) * (1 + 0.01 * rng.standard_normal(gains.shape))
    return light / gains, rng.chisquare(400, gains.shape) / 400 / gains


Y, X = np.indices((96, 150))
LAYOUTS = {
    "halves": (1.03 ** (X >= 70), ["columns up to 69", "columns from 70"]),
    "alternate": (1.03 ** (X % 2), ["even columns", "odd columns"]),
    "halves that differ in one half": (
        np.where(
            X >= 70, 1.03 * 0.98 ** np.where(Y >= 40, 1, -1), 1.005 ** np.where(Y >= 40, 1, -1)
        ),
        [
            f"rows {r}, columns {c}"
            for r in ("up to 39", "from 40")
            for c in ("up to 69", "from 70")
        ],
    ),
    "quadrants": (
        1.03 ** (X >= 70) * 0.98 ** (Y >= 40) * 1.005 ** ((X >= 70) & (Y >= 40)),
        [
            f"rows {r}, columns {c}"
            for r in ("up to 39", "from 40")
            for c in ("up to 69", "from 70")
        ],
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("seed", range(3))
def test_outputs_are_named_with_their_gains(layout: str, seed: int) -> None:
    gains, names = LAYOUTS[layout]
    found = differing_outputs(*camera(gains, seed), gains > 0)
    assert found is not None
    assert found.names == names
    true = gains / gains.mean()
    each = np.unique(true.round(9))
    order = np.argsort(found.gain)
    # The mean of noise over pixels is that of 1 / gain, which differs in the second order.
    assert (abs(found.gain[order] - each) < 4 * found.error[order] + 1e-3).all()
    assert (found.error < 0.01).all()
    np.testing.assert_allclose(found.of_pixel, true, rtol=3e-3)


@pytest.mark.parametrize("seed", range(5))
def test_light_mosaic_and_response_make_no_outputs(seed: int) -> None:
    flat, noise = camera(np.ones(X.shape), seed)
    assert differing_outputs(flat, noise, flat > 0) is None
    # A colour mosaic, and a step of the response of the pixels, as of a stitched sensor.
    for factor in (0.6 ** (X % 2 * (Y % 2)), 1.03 ** (X >= 70)):
        assert differing_outputs(flat * factor, noise, flat > 0) is None


@pytest.mark.parametrize("seed", range(5))
def test_halves_are_told_by_steps_of_seven_errors_of_their_noise(seed: int) -> None:
    """The error is that of the means of both halves: no lamp takes part of it."""
    gains = 1.0085 ** (X // 75)
    flat, noise = camera(gains, seed)
    error = np.sqrt(2 / 400) * 2 / np.sqrt(X.size)
    assert 0.0085 / error == pytest.approx(7, abs=0.3)
    found = differing_outputs(flat, noise, flat > 0)
    assert found is not None
    assert len(found.names) == 2
