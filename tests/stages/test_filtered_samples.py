"""Samples that a camera filters: neighbours share noise, which is not that of lines."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import median_filter, uniform_filter1d
from test_ends_of_the_converter import Frames

from pixcal.stages.reduce.read_noise import Nearby

SHAPE = (96, 130)
NOISE = 12.0


def seen(samples: NDArray[Any]) -> Nearby:
    job: Any = SimpleNamespace(
        frames={"bias": Frames(np.rint(samples))},
        shape=SHAPE,
        quantum=1.0,
        read_series=SimpleNamespace(array="bias", frames=range(len(samples))),
    )
    found = Nearby.of(job, float((samples[1] - samples[0]).var()) / 2)
    assert found is not None
    return found


def frames(row: float = 0.0, column: float = 0.0, seed: int = 2) -> NDArray[Any]:
    rng = np.random.default_rng(seed)
    white = rng.normal(300, NOISE, (16, *SHAPE))
    white += row * rng.standard_normal((16, SHAPE[0], 1))
    return white + column * rng.standard_normal((16, 1, SHAPE[1]))


@pytest.mark.parametrize(("row", "column"), [(0, 0), (3, 0), (0, 4), (6, 6)])
def test_noise_of_lines_is_that_of_no_filter(row: float, column: float) -> None:
    found = seen(frames(row, column))
    assert not found.filtered
    assert max(map(abs, found.near.values())) < 0.05
    # A few hundred lines tell their variance to some per cent.
    for name, size in (("row", row), ("column", column)):
        assert 0.75 * size**2 <= found.lines[name] < 1.25 * size**2 + 0.02 * NOISE**2


@pytest.mark.parametrize("width", [17, 33, 50])
def test_levels_of_outputs_are_no_filter(width: int) -> None:
    """Outputs whose levels change from frame to frame, as in infrared arrays."""
    rng = np.random.default_rng(width)
    levels = rng.normal(0, NOISE, (16, 1, SHAPE[1] // width + 1))
    assert not seen(frames() + np.repeat(levels, width, axis=2)[..., : SHAPE[1]]).filtered


@pytest.mark.parametrize("seed", range(3))
def test_filters_make_no_noise_of_lines(seed: int) -> None:
    white = frames(seed=seed)
    for filtered, lines in (
        (median_filter(white, (1, 3, 3)), ("row", "column")),
        (uniform_filter1d(white, 3, axis=2), ("row",)),
        (uniform_filter1d(white, 3, axis=1), ("column",)),
    ):
        found = seen(filtered)
        assert found.filtered
        for name in ("row", "column"):
            assert (found.near[name] > 0.3) == (name in lines)
            assert found.lines[name] < 0.02 * NOISE**2


def test_weak_coupling_of_the_amplifier_is_no_filter() -> None:
    white = frames()
    assert not seen(white + 0.05 * np.roll(white, 1, axis=2)).filtered
