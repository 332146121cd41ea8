"""Samples that pile up at the lowest and the highest code, told from noise that ends there."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pixcal.model.errors import InputError
from pixcal.stages.diagnose.description import _top
from pixcal.stages.reduce.black_cut_off import CutOff, cut_offs
from pixcal.stages.reduce.flat_survey import FlatSurvey

SHAPE = (8, 61, 409)


class Frames:
    """Frames in memory."""

    def __init__(self, samples: NDArray[Any]) -> None:
        self.samples = samples
        self.shape = samples.shape
        self.dtype = samples.dtype

    def read(self, *spans: tuple[int, int]) -> NDArray[Any]:
        """Part of the samples."""
        return self.samples[tuple(slice(*span) for span in spans)]


def frames(noise: float, level: float, lowest: int, step: int = 1) -> NDArray[Any]:
    """Samples of a camera that ends at a code."""
    analogue = np.random.default_rng(5).normal(level, noise, SHAPE)
    return np.maximum(step * np.rint(analogue / step), lowest).astype(np.uint16)


@pytest.mark.parametrize("step", [1, 16])
@pytest.mark.parametrize("lowest", [0, 4, 64])
@pytest.mark.parametrize("above", [-0.5, 0.3, 2.0, 2.8])
@pytest.mark.parametrize("noise", [2.5, 30.0])
def test_lowest_code_and_noise_are_found(
    noise: float, above: float, lowest: int, step: int
) -> None:
    samples = frames(step * noise, step * (lowest + above * noise), step * lowest, step)
    found = CutOff.of(Frames(samples), step)
    assert found is not None
    assert found.code == step * lowest
    assert found.share == (samples == step * lowest).mean()
    assert found.noise == pytest.approx(step * noise, rel=0.35)


@pytest.mark.parametrize("noise", [0.0, 0.2, 0.5, 1.0, 1.2, 1.6, 2.5, 8.0, 200.0])
@pytest.mark.parametrize("level", [1000.0, 1000.3, 1000.5])
def test_noise_above_the_lowest_code_is_whole(noise: float, level: float) -> None:
    assert CutOff.of(Frames(frames(noise, level, 0)), 1.0) is None


def test_dark_signal_that_differs_upwards_has_no_cut_off_where_bias_frames_go_below() -> None:
    rng = np.random.default_rng(8)
    dark = 8.1 + 2.5 * rng.gamma(4, 1 / 4, SHAPE[1:]) + 0.4 * rng.standard_normal(SHAPE)
    arrays = {"dark": Frames(np.rint(dark).astype(np.uint16))}
    assert cut_offs(arrays, 1.0)  # the darks alone cannot tell
    assert not cut_offs({**arrays, "bias": Frames(frames(0.4, 8.1, 0))}, 1.0)
    ended = {"bias": Frames(frames(0.9, 8.5, 8)), "dark": Frames(frames(0.9, 9.0, 8))}
    assert [one.code for one in cut_offs(ended, 1.0).values()] == [8, 8]


@pytest.mark.parametrize("lowest", [1, 4, 64])
@pytest.mark.parametrize("above", [0.2, 0.6, 1.3, 2.0])
@pytest.mark.parametrize("noise", [0.9, 1.2, 1.5])
def test_noise_of_about_a_step_has_an_edge(noise: float, above: float, lowest: int) -> None:
    samples = frames(noise, lowest + above * noise, lowest)
    found = CutOff.of(Frames(samples), 1.0)
    assert found is not None
    assert found.code == lowest


@pytest.mark.parametrize("lowest", [4.1, 31.75, 63.6])
@pytest.mark.parametrize(
    ("noise", "above"), [(1.2, 0.0), (1.2, 1.0), (8.0, 0.0), (8.0, 1.0), (8.0, 2.0)]
)
def test_a_pile_may_lie_on_two_codes(lowest: float, above: float, noise: float) -> None:
    rng = np.random.default_rng(3)
    cut = np.maximum(rng.normal(lowest + above * noise, noise, SHAPE), lowest)
    samples = np.rint(cut + rng.uniform(-0.5, 0.5, SHAPE)).astype(np.uint16)
    found = CutOff.of(Frames(samples), 1.0)
    assert found is not None
    assert abs(found.code - lowest) <= 0.6


@pytest.mark.parametrize("lowest", [11.81, 31.75, 63.85])
@pytest.mark.parametrize(
    ("noise", "pattern", "above"),
    [(0.51, 0.69, 1.6), (0.66, 0.15, 1.5), (1.1, 0.12, 1.5), (3.0, 5.8, 4.5), (3.6, 5.2, 4.5)],
)
def test_a_pile_of_few_samples_may_lie_on_two_codes(
    noise: float, pattern: float, above: float, lowest: float
) -> None:
    """The lower code holds a tenth of the pile, so that codes below the pile are not empty."""
    rng = np.random.default_rng(3)
    levels = lowest + above * noise + pattern * rng.standard_normal(SHAPE[1:])
    cut = np.maximum(rng.normal(levels, noise, SHAPE), lowest)
    samples = np.rint(cut + rng.uniform(-0.5, 0.5, SHAPE)).astype(np.uint16)
    found = CutOff.of(Frames(samples), 1.0)
    assert found is not None
    assert found.code in (np.floor(lowest), np.ceil(lowest))


def test_broken_columns_are_no_lowest_code() -> None:
    samples = frames(3.0, 100.0, 0)
    samples[:, :, 17] = 80
    samples[:, 5] = 0
    samples[:, :, 300] = 99
    assert CutOff.of(Frames(samples), 1.0) is None


def test_a_dead_column_does_not_hide_the_lowest_code() -> None:
    samples = frames(8.0, 64 + 12.0, 64)
    samples[:, :, 17], samples[:, 3] = 12, 70
    found = CutOff.of(Frames(samples), 1.0)
    assert found is not None
    assert found.code == 64


@pytest.mark.parametrize("noise", [0.2, 0.3, 0.5, 2.0])
def test_warm_pixels_of_a_quiet_camera_are_no_cut_off(noise: float) -> None:
    rng = np.random.default_rng(4)
    warm = rng.exponential(1.5, SHAPE[1:]) * (rng.random(SHAPE[1:]) < 0.1)
    samples = np.rint(rng.normal(10 + warm, noise, SHAPE)).astype(np.uint16)
    assert CutOff.of(Frames(samples), 1.0) is None


def test_a_ramp_of_a_quiet_camera_is_no_cut_off() -> None:
    ramp = np.linspace(40, 50, SHAPE[2])
    samples = np.rint(np.random.default_rng(4).normal(ramp, 0.3, SHAPE)).astype(np.uint16)
    assert CutOff.of(Frames(samples), 1.0) is None


@pytest.mark.parametrize("shape", [(32, 32), (64, 64), (64, 128)])
@pytest.mark.parametrize("noise", [0.8, 1.2, 1.5, 2.0, 3.0])
def test_small_windows_raise_no_alarm(noise: float, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng([int(10 * noise), *shape])
    for level in np.linspace(100, 101, 40):
        samples = np.rint(rng.normal(level, noise, (2, *shape))).astype(np.uint16)
        assert CutOff.of(Frames(samples), 1.0) is None


def flats(noise: float, well: float, scatter: float) -> NDArray[Any]:
    """Flats of a ladder that may end in full wells, whose codes scatter."""
    rng = np.random.default_rng(8)
    levels = np.repeat(np.linspace(300, 3600, 7), 2)[:, None, None]
    shot = levels + noise * np.sqrt(levels / 3000) * rng.standard_normal((14, *SHAPE[1:]))
    return np.rint(np.minimum(shot, well) + scatter * rng.uniform(-1, 1, shot.shape))


@pytest.mark.parametrize("step", [1, 16])
@pytest.mark.parametrize(("scatter", "well"), [(0.0, 3277.0), (0.5, 3277.03), (0.5, 3277.4)])
def test_full_wells_may_be_read_as_one_of_two_codes(scatter: float, well: float, step: int) -> None:
    samples = (step * flats(20.0, well, scatter)).astype(np.uint16)
    assert FlatSurvey.of({"flat": Frames(samples)}).saturation == step * 3277


@pytest.mark.parametrize("noise", [0.2, 0.5, 1.0, 20.0])
def test_the_highest_codes_of_flats_that_are_not_full_are_no_saturation(noise: float) -> None:
    samples = flats(noise, 1e5, 0.0).astype(np.uint16)
    assert FlatSurvey.of({"flat": Frames(samples)}).saturation is None


@pytest.mark.parametrize("level", [32700.0, 45000.0, 60000.0])
def test_only_unsigned_samples_read_as_signed_are_negative_by_light(level: float) -> None:
    rng = np.random.default_rng(3)
    unlit, *lit = (rng.normal(mean, 200, SHAPE).astype(np.uint16) for mean in (900, 9000, level))
    taken = {"bias": unlit, "flat": np.concatenate(lit)}
    for first, kind in ((None, np.uint16), (SHAPE[0], np.int16)):
        read = {name: Frames(samples.astype(kind)) for name, samples in taken.items()}
        assert FlatSurvey.of(read).wrapped == first
    # Frames less their dark level are negative too, as are those less half of the range.
    for lit_too, dark in ((taken["flat"] // 2, 900), (taken["flat"], 32768)):
        moved = {"bias": Frames((unlit - dark * 1.0).astype(np.int16))}
        moved["flat"] = Frames((lit_too - dark * 1.0).astype(np.int16))
        assert FlatSurvey.of(moved).wrapped is None


@pytest.mark.parametrize("noise", [0.9, 1.2, 1.5, 2.0, 2.5, 4.0])
@pytest.mark.parametrize("level", [124.0, 126.0, 127.3, 127.5])
@pytest.mark.parametrize("count", [2, 4, 8])
def test_codes_of_unequal_width_are_no_cut_off(noise: float, level: float, count: int) -> None:
    """As of a camera that averages frames and rounds halves to even codes."""
    rng = np.random.default_rng([int(10 * noise), count])
    mean = sum(np.rint(rng.normal(level, noise, SHAPE)) for _ in range(count)) / count
    assert CutOff.of(Frames(np.rint(mean).astype(np.uint16)), 1.0) is None


@pytest.mark.parametrize("declared", [None, 65535.0])
def test_crests_beyond_the_end_of_16_bits_are_cut_off_in_simulations_too(
    declared: float | None,
) -> None:
    flat = np.ones((5, 7), np.float32)
    bright: Any = [SimpleNamespace(light=33_000 * flat, contrast=0.97 * flat)]
    evidence: Any = SimpleNamespace(gain=1.0, bias=1000 * flat)
    acquisition: Any = SimpleNamespace(detector=SimpleNamespace(saturation_adu=declared))
    top = _top(acquisition, evidence, bright, {"a": np.dtype(np.uint16)})
    assert top == 65535
    if declared is None:
        with pytest.raises(InputError, match="16-bit converter"):
            _top(acquisition, evidence, bright, {"a": np.dtype(np.float32)})
