"""Levels of outputs: edges and sizes are found, and other noise is not taken for them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from all_frames import frames_of
from dark_frames import in_the_dark

from pixcal.effects.bias_drift import BiasDrift
from pixcal.effects.cosmic_hits import CosmicHits
from pixcal.effects.output_jitter import OutputJitter, find_outputs, output_numbers
from pixcal.effects.row_noise import RowNoise
from pixcal.effects.telegraph_noise import TelegraphNoise
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Effect
from pixcal.simulation.recording import recordings

SHAPE = (160, 96)
GOOD = np.ones(SHAPE, np.bool_)


def test_an_output_moves_as_a_whole_and_by_itself(make_effect_bench: Callable[..., Bench]) -> None:
    bench = make_effect_bench()
    bias = next(r for r in recordings(bench) if r.kind == "bias")
    change = frames_of(bench, bias, [OutputJitter(5.0, 0.0, (20,), (32,))]).astype(float)
    change -= frames_of(bench, bias)
    parts = [
        change[:, y, x] for y in (slice(20), slice(20, None)) for x in (slice(32), slice(32, None))
    ]
    levels = np.array([part.mean(axis=(1, 2)) for part in parts])
    for part, level in zip(parts, levels, strict=True):
        # Rounding, twice.
        assert (part - level[:, None, None]).std() == pytest.approx(np.sqrt(1 / 6), rel=0.1)
    assert levels.std() == pytest.approx(5.0, rel=4 / np.sqrt(2 * levels.size))
    off = np.corrcoef(levels)[np.triu_indices(4, 1)]
    assert np.abs(off).max() < 4 / np.sqrt(levels.shape[1])


@pytest.mark.parametrize(
    ("rms", "rows", "columns"), [(3.0, (24,), (32,)), (2.0, (), (20, 44)), (12.0, (40,), ())]
)
def test_edges_and_sizes_are_found(
    acquired: Callable[..., Evidence],
    make_effect_bench: Callable[..., Bench],
    rms: float,
    rows: tuple[int, ...],
    columns: tuple[int, ...],
) -> None:
    effect = OutputJitter(rms, 0.0, rows, columns)
    found = OutputJitter.estimate(in_the_dark(acquired(), make_effect_bench(), effect))
    assert found is not None
    assert isinstance(found.effect, OutputJitter)
    assert found.significance > 5
    assert (found.effect.row_edges, found.effect.column_edges) == (rows, columns)
    assert found.effect.output_rms == pytest.approx(rms, abs=4 * found.errors["output_rms"])
    assert found.errors["output_rms"] < 0.2 * rms


@pytest.mark.parametrize(("jump", "walk"), [(0.5, 1.5), (3.0, 0.0), (1.0, 0.5)])
def test_jumps_and_walks_are_told_apart(jump: float, walk: float) -> None:
    pulls = []
    for seed in range(12):
        rng = np.random.default_rng([seed, int(10 * jump)])
        time = 2.0 * np.arange(60)
        level = jump * rng.standard_normal((60, 4))
        level += walk * np.cumsum(np.sqrt(2.0) * rng.standard_normal((60, 4)), axis=0)
        numbers = output_numbers((70,), (40,), np.arange(SHAPE[0]), np.arange(SHAPE[1]))
        frames = (6 * rng.standard_normal((60, *SHAPE)) + level[:, numbers]).astype(np.float32)
        found = find_outputs([frames - frames.mean(axis=0)], [time], GOOD)
        assert found is not None
        assert (found.row_edges, found.column_edges) == ((70,), (40,))
        pulls.append((np.array(found.size) - [jump**2, walk**2]) / found.error)
    mean = np.mean(pulls, axis=0)
    # Nothing below zero is found: where there is none, the mean lies above.
    assert np.abs(mean).max() < 4 / np.sqrt(12)
    assert np.std(pulls) < 1.6


def test_edges_are_counted_on_the_chip(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench]
) -> None:
    evidence = in_the_dark(acquired(), make_effect_bench(), OutputJitter(5.0, 0.0, (), (32,)))
    found = OutputJitter.estimate(replace(evidence, origin=(100, 200)))
    assert found is not None
    assert isinstance(found.effect, OutputJitter)
    assert found.effect.column_edges == (232,)


@pytest.mark.parametrize(
    "other",
    [
        RowNoise(8.0, 3.0, 5.0, 4.0, 3.0),
        BiasDrift(20.0, 100.0, 50.0, 30.0, 5.0),
        TelegraphNoise().scaled(3.0),
        CosmicHits().scaled(1e5),
    ],
    ids=lambda e: e.name,
)
def test_other_noise_is_not_taken_for_it(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench], other: Effect
) -> None:
    found = OutputJitter.detect(in_the_dark(acquired(), make_effect_bench(), other))
    assert found is not None
    assert found < 4


@pytest.mark.parametrize("axis", [0, 1])
def test_an_edge_of_the_noise_is_no_edge_of_the_level(axis: int) -> None:
    rng = np.random.default_rng(6)
    noise = np.expand_dims(np.where(np.arange(SHAPE[axis]) < SHAPE[axis] // 2, 1.0, 2.0), 1 - axis)
    for _ in range(5):
        frames = (noise * rng.standard_normal((200, *SHAPE))).astype(np.float32)
        found = find_outputs([frames - frames.mean(axis=0)], [np.arange(float(len(frames)))], GOOD)
        assert found is not None
        assert found.sigmas < 4


@pytest.mark.parametrize("count", [5, 30])
def test_significance_is_that_of_chance(count: int) -> None:
    rng = np.random.default_rng(7)
    sigmas = []
    for _ in range(40):
        frames = rng.standard_normal((count, *SHAPE)).astype(np.float32)
        found = find_outputs([frames - frames.mean(axis=0)], [np.arange(float(len(frames)))], GOOD)
        assert found is not None
        sigmas.append(found.sigmas)
    # Places near each other are not independent, so chance comes out lower.
    assert max(sigmas) < 3
    assert np.mean(sigmas) < 0.7


def test_outputs_are_numbered_along_rows() -> None:
    numbers = output_numbers((2,), (1, 3), np.arange(4), np.arange(4))
    np.testing.assert_array_equal(numbers[0], [0, 1, 1, 2])
    np.testing.assert_array_equal(numbers[3], [3, 4, 4, 5])


def test_few_frames_say_nothing() -> None:
    assert find_outputs([np.zeros((4, *SHAPE), np.float32)], [np.arange(4.0)], GOOD) is None
