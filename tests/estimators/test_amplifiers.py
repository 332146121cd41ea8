"""Steps of the gain between amplifiers, told from steps of the response."""

import numpy as np
import pytest

from pixcal.estimators.detector.amplifiers import relative_gain

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
