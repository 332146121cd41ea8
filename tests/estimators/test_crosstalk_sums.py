"""Sums of the products of neighbours, against NumPy, whatever is summed together."""

from dataclasses import replace

import numpy as np
import pytest

from pixcal.estimators.crosstalk import covariance
from pixcal.estimators.crosstalk.covariance import BOTH, TERMS
from pixcal.estimators.crosstalk.residuals import Residuals

SHAPE = 7, 21
LINKS = ((0, 1), (1, -2), (2, 0))


def some(frames: int, seed: int) -> Residuals:
    """Frames, and a tenth as many modes; pixels without a fit, and samples without weight."""
    rng = np.random.default_rng(seed)
    good = rng.random(SHAPE) > 0.1
    weight = rng.uniform(0.5, 1.5, (frames, *SHAPE)).astype(np.float32)
    weight *= good & (rng.random(weight.shape) > 0.1)
    charge = rng.uniform(0.5, 2, weight.shape).astype(np.float32)
    frame = np.concatenate([np.arange(frames), np.arange(0, frames, 10)])
    e = rng.standard_normal((len(frame), *SHAPE)).astype(np.float32) * weight[frame]
    return Residuals(e, charge, weight, frame)


def expected(parts: list[tuple[np.ndarray, ...]], step: tuple[int, int]) -> list[np.ndarray]:
    """Sums of products (y, x) of values times the terms D, D', 1, (D² + D'²) / 2, and of each."""
    sums = [np.zeros((n, *SHAPE)) for n in (4, 10)]
    for value, charge in parts:
        whole = np.zeros((2, len(value), SHAPE[0] + 2, SHAPE[1] + 4))
        whole[:, :, :-2, 2:-2] = value, charge
        here = whole[:, :, :-2, 2:-2]
        dy, dx = step
        there = whole[:, :, dy : dy + SHAPE[0], 2 + dx : 2 + dx + SHAPE[1]]
        product, own, other = here[0] * there[0], here[1], there[1]
        terms = np.stack([own, other, np.ones_like(own), (own**2 + other**2) / 2])
        sums[0] += (product * terms).sum(axis=1)
        i, j = np.triu_indices(4)
        sums[1] += (product * terms[i] * terms[j]).sum(axis=1)
    return sums


@pytest.mark.parametrize("step", range(len(LINKS)))
def test_the_sums_are_those_of_the_terms(step: int) -> None:
    parts = [(p.e, p.charge[p.frame]) for p in (some(20, 1), some(35, 2))]
    for terms, sums in zip((TERMS, BOTH), expected(parts, LINKS[step]), strict=True):
        found = np.zeros((len(LINKS), len(terms), *SHAPE), np.float32)
        covariance._add(parts, terms, LINKS, found)
        np.testing.assert_allclose(found[step], sums, rtol=1e-4, atol=1e-4)


def test_one_frame_stands_for_all_of_one_charge_and_few_for_many() -> None:
    part = some(200, 3)
    steady = np.repeat(part.weight[:1], len(part.weight), axis=0)
    flat = replace(part, charge=part.charge[:1], weight=steady, frame=0 * part.frame)
    for one, frames, accuracy in ((part, 50, 0.2), (flat, 1, 1e-4)):
        value, charge = covariance._weights(one)
        assert len(value) == len(charge) == frames
        few = expected([(value, charge)], (0, 1))[1].sum(axis=(1, 2))
        every = np.broadcast_to(one.charge, one.weight.shape)
        whole = expected([(one.weight, every)], (0, 1))[1].sum(axis=(1, 2))
        np.testing.assert_allclose(few, whole, rtol=accuracy)


def test_short_sequences_are_gathered_and_long_ones_are_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    parts = [some(n, 1) for n in (50, 10, 300, 40, 60, 70)]
    monkeypatch.setattr(covariance, "_AT_ONCE", 100 * SHAPE[0] * SHAPE[1])
    gathered = [[len(part.weight) for part in group] for group in covariance._gathered(parts)]
    assert gathered == [[50, 10, 300], [40, 60], [70]]
