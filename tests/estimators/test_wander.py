"""Phases beside a ramp: as they were, without a modulator's error, and harmonics only by chance."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pixcal.estimators.wander import Wander, wander_of

STEP, COUNT, NOISE = 0.861, 400, 1e-4


def part(phase: Any, numbers: Any, seed: int = 0) -> Any:
    """What the fit of some frames finds: phases with noise, and a zero of their own."""
    rng = np.random.default_rng([seed, int(numbers[0])])
    phi = STEP * numbers + phase[numbers] + NOISE * rng.standard_normal(len(numbers)) + 1.3
    covariance = np.zeros((len(numbers), 5, 5))
    covariance[:, 1, 1] = covariance[:, 2, 2] = NOISE**2
    free = np.stack([np.ones_like(phi), np.cos(phi), np.sin(phi), 0 * phi, 0 * phi], axis=1)
    wrapped = np.angle(np.exp(1j * phi))
    return SimpleNamespace(phi=wrapped, free=free, free_covariance=covariance)


HALVES = (np.arange(170), np.arange(190, COUNT))


def found(phase: Any, seed: int = 0) -> Wander:
    return wander_of([part(phase, n, seed) for n in HALVES], HALVES, COUNT, STEP)


def harmonic(phase: Any, numbers: Any, order: int = 1) -> complex:
    values = phase[numbers] - phase[numbers].mean()
    return complex(np.mean(values * np.exp(-1j * order * STEP * numbers)))


def test_a_wander_is_as_it_was_but_for_a_zero_of_each_part() -> None:
    walk = np.cumsum(0.05 * np.random.default_rng(1).standard_normal(COUNT))
    wander = found(walk)
    for numbers in HALVES:
        apart = wander.rest[numbers] - walk[numbers]
        assert np.std(apart) < 0.06 * np.std(walk[numbers])
    assert not wander.rest[171:189].any()


def test_a_modulators_error_is_not_in_it() -> None:
    frames = np.arange(COUNT)
    error = 0.02 * np.sin(STEP * frames) + 0.01 * np.sin(2 * STEP * frames)
    wander = found(error)
    assert np.abs(wander.rest).max() < 10 * NOISE
    drawn = wander.drawn(STEP * frames, np.random.default_rng(2))
    assert abs(harmonic(drawn, HALVES[0])) < 1e-4


def test_steps_that_are_even_do_not_wander() -> None:
    wander = found(np.zeros(COUNT))
    assert np.std(wander.rest) < NOISE


@pytest.mark.parametrize("order", [1, 2])
def test_harmonics_are_drawn_as_large_as_chance_makes_them(order: int) -> None:
    """Of white noise, the amplitude of a harmonic has the variance over the number of frames."""
    sigma, sizes, kept = 0.05, [], []
    for seed in range(60):
        rng = np.random.default_rng([3, seed])
        wander = found(sigma * rng.standard_normal(COUNT), seed)
        drawn = wander.drawn(STEP * np.arange(COUNT), rng)
        sizes.append(abs(harmonic(drawn, HALVES[0], order)) ** 2)
        kept.append(abs(harmonic(wander.rest, HALVES[0], order)) ** 2)
    expected = sigma**2 * np.mean([1 / len(n) for n in HALVES])
    assert np.mean(sizes) == pytest.approx(expected, rel=0.45)
    assert np.mean(kept) < 1e-3 * expected


def test_without_a_ramp_there_is_nothing_to_leave() -> None:
    phase = np.random.default_rng(4).uniform(0, 6, COUNT)
    wander = wander_of([part(phase, n) for n in HALVES], HALVES, COUNT, 0.0)
    assert not wander.rest.any()
    assert not wander.drawn(np.zeros(COUNT), np.random.default_rng(5)).any()
