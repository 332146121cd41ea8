"""Sums of the products of neighbours, against NumPy, whatever is summed together."""

from dataclasses import replace

import numpy as np
import pytest

from pixcal.estimators.crosstalk import covariance
from pixcal.estimators.crosstalk.covariance import NORMAL
from pixcal.estimators.crosstalk.residuals import Residuals

LINKS = ((0, 1), (1, -2), (2, 0))


def some(frames: int, seed: int) -> Residuals:
    rng = np.random.default_rng(seed)
    shape = (frames, 7, 21)
    one = rng.uniform(0.5, 1.5, shape).astype(np.float32)
    one[rng.random(shape) < 0.1] = 0
    charge = rng.uniform(0.5, 2, shape).astype(np.float32) * one
    e, modes = rng.standard_normal((2, *shape)).astype(np.float32)
    return Residuals(e * one, charge, charge, one, modes[None, ::16] * one[::16])


def shifted(values: np.ndarray, dy: int, dx: int) -> np.ndarray:
    """The partner of each pixel; zero beyond the window."""
    wide = np.pad(values, ((0, 0), (0, 2), (2, 2)))
    _, ny, nx = values.shape
    return wide[:, dy : dy + ny, 2 + dx : 2 + dx + nx]


def steady(frames: int, seed: int) -> Residuals:
    """Frames of one charge; samples are clipped in pixels of which no two are partners."""
    part = some(frames, seed)
    one = np.broadcast_to(part.one.max(axis=0), part.one.shape).copy()
    clipped = np.random.default_rng(seed).random(one.shape) < 0.3
    clipped[:, np.arange(7) % 4 != 0] = clipped[:, :, np.arange(21) % 4 != 0] = False
    one[clipped] = 0
    level = np.random.default_rng(seed).uniform(0.5, 2, one.shape[1:]).astype(np.float32)
    e, charge = part.e * (one > 0), level * one
    return Residuals(e, charge, charge, one, part.modes * (one[::16] > 0), steady=True)


def test_frames_of_one_charge_give_the_sums_of_any_frames() -> None:
    parts, links = [steady(20, 1), steady(2, 2), steady(35, 3)], np.array(LINKS)
    usual, quick = ([np.zeros((3, n, 7, 21), np.float32) for n in (5, 14)] for _ in range(2))
    covariance._add([replace(part, steady=False) for part in parts], links, *usual)
    covariance._add(parts, links, *quick)
    for one, other in zip(usual, quick, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-5, atol=1e-5 * np.abs(one).max())


@pytest.mark.parametrize("step", range(len(LINKS)))
def test_the_sums_are_those_of_the_terms(step: int) -> None:
    parts = [some(20, 1), some(35, 2)]
    right, normal = np.zeros((3, 5, 7, 21)), np.zeros((3, 14, 7, 21))
    links = np.array(LINKS)
    noise = [frames for p in parts for frames in ((p.e, p.charge, p.one), p.taken)]
    covariance._add_right_sums(*covariance._powers(noise, 2), links, right)
    terms = [(p.one, p.charge, p.one) for p in parts]
    covariance._add_normal_sums(*covariance._powers(terms, 4), links, normal)

    def formulae(charge: np.ndarray, one: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Weight of a product, and the terms D, D', 1, D D', D² + D'²."""
        own = np.divide(charge, one, out=np.zeros_like(charge), where=one > 0)
        other = shifted(own, *LINKS[step])
        each = [own, other, np.ones_like(own), own * other, own**2 + other**2]
        return one * shifted(one, *LINKS[step]), each

    expected = np.zeros((5, 7, 21))
    for e, charge, one in noise:
        weight, each = formulae(charge, one)
        product = e * shifted(e, *LINKS[step]) * weight
        expected += np.array([(product * term).sum(axis=0) for term in each])
    np.testing.assert_allclose(right[step], expected, rtol=1e-4, atol=1e-4)
    for (i, j), place in np.ndenumerate(NORMAL):
        own_sum = np.zeros((7, 21))
        for _, charge, one in terms:
            weight, each = formulae(charge, one)
            own_sum += (weight**2 * each[i] * each[j]).sum(axis=0)
        np.testing.assert_allclose(normal[step, place], own_sum, rtol=1e-4, atol=1e-4)


def test_short_sequences_are_gathered_and_long_ones_are_not() -> None:
    lengths = [50, 12, 300, 40, 60, 70]
    parts = [some(n, n) for n in lengths]
    gathered = [[len(p.e) for p in group] for group in covariance._gathered(parts)]
    assert gathered == [[50, 12], [300], [40, 60], [70]]
