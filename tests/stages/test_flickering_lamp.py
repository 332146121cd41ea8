"""Bands of a lamp that flickers while rows are exposed: a look at a few rows tells where to ask."""

import numpy as np
import pytest

from pixcal.estimators.detector.pair_noise import LineNoise, flat_pair_sums, without_bands
from pixcal.model.arrays import F64
from pixcal.stages.reduce.flat_survey import FlatSurvey
from pixcal.storage.cube import CHUNK
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.memory import MemoryArray, MemoryPath

SHAPE, CHARGE = (8, 300, 256), 4000.0


def reader(samples: F64) -> ArrayReader:
    path = MemoryPath()
    path.keep(MemoryArray(np.rint(samples).astype(np.uint16), CHUNK, 0, {}))
    return ArrayReader(path)


def bands(depth: float, seed: int) -> tuple[bool, bool]:
    """Whether the look says there may be bands, and whether the photon transfer leaves some out."""
    rng = np.random.default_rng(seed)
    wave = np.sin(np.arange(SHAPE[1]) / 5 + rng.uniform(0, 2 * np.pi, (SHAPE[0], 1)))
    light = CHARGE * (1 + rng.normal(0, 0.003, (SHAPE[0], 1)) + depth * wave)
    flats = 500 + rng.poisson(light[..., None], SHAPE)
    arrays = {"bias": reader(rng.normal(500, 5, (2, *SHAPE[1:]))), "flat": reader(flats)}
    found = FlatSurvey.of(arrays).may_have_bands(arrays, [range(8)], 60000.0)
    lit = (flats - 500).astype(np.float32)
    whole, rest = flat_pair_sums(lit, lit.mean(axis=(1, 2)), 1.0, 5.0, 1.0, LineNoise())
    return found, without_bands(whole, rest) is rest


@pytest.mark.parametrize("seed", range(3))
def test_wherever_bands_count_a_look_finds_them(seed: int) -> None:
    noise = CHARGE**-0.5
    # From far below the noise of a sample to above it; the error of the noise is a tenth of it.
    found, count = np.transpose([bands(share * noise, seed) for share in (0.02, 0.05, 0.1, 1.0)])
    assert not (count & ~found).any()
    assert found[-1]
    assert count[-1]


def test_under_a_steady_lamp_there_is_nothing_to_find() -> None:
    assert sum(bands(0.0, seed)[0] for seed in range(10)) <= 2


def test_without_bands_flats_are_as_they_are() -> None:
    rng = np.random.default_rng(1)
    lit = rng.poisson(CHARGE, SHAPE).astype(np.float32)
    given = lit, lit.mean(axis=(1, 2)), 1.0, 5.0, 1.0, LineNoise()
    both, once = flat_pair_sums(*given), flat_pair_sums(*given, bands=False)
    assert np.array_equal(both[0], once[0])
    assert np.array_equal(once[0], once[1])
