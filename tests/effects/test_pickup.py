"""Tones in the noise: frequencies and sizes are found, and other noise is not taken for them."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.signal
from all_frames import frames_of
from dark_frames import in_the_dark

from pixcal.effects.bias_drift import BiasDrift
from pixcal.effects.output_jitter import OutputJitter
from pixcal.effects.pickup import Pickup
from pixcal.effects.row_noise import RowNoise
from pixcal.effects.telegraph_noise import TelegraphNoise
from pixcal.estimators.diagnosis.evidence import Evidence, Stack
from pixcal.model.arrays import F64
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect
from pixcal.simulation.recording import recordings


def test_a_tone_is_a_wave_of_another_phase_in_each_frame(
    make_effect_bench: Callable[..., Bench],
) -> None:
    bench = make_effect_bench()
    bias = next(r for r in recordings(bench) if r.kind == "bias")
    change = frames_of(bench, bias, [Pickup((40.0,), (0.21,), (-0.13,))]).astype(float)
    change -= frames_of(bench, bias)
    change *= bench.detector.gain_e_per_adu
    _, ny, nx = change.shape
    y, x = np.arange(ny)[:, None], np.arange(nx)
    wave = np.exp(-2j * np.pi * (0.21 * x - 0.13 * y))
    size = 2 * (change * wave).mean(axis=(1, 2))
    # Waves of half periods that do not fit the frame leave some hundredths.
    np.testing.assert_allclose(np.abs(size), 40 * np.sqrt(2), rtol=0.05)
    rest = change - (size[:, None, None] * wave.conj()).real
    assert rest.std() < 0.05 * 40
    assert np.abs(np.exp(1j * np.angle(size)).mean()) < 3 / np.sqrt(len(size))


@pytest.mark.parametrize(
    ("rms", "columns", "rows"),
    [
        ((3.0,), (0.297,), (0.125,)),
        ((5.0, 2.0), (0.242, 0.082), (-0.31, 0.083)),
        ((4.0, 3.0, 2.0), (0.297, 0.012, 0.5), (0.125, -0.45, 0.06)),
        ((1.5,), (0.0,), (0.089,)),
        ((4.0, 2.0), (0.001, 0.0), (-0.21, 0.36)),
        ((3.0, 2.0), (0.0, 0.0), (0.11, 0.22)),
        ((3.0, 2.0), (0.083, 0.27), (0.0, 0.02)),
    ],
)
def test_tones_are_found(
    acquired: Callable[..., Evidence],
    make_effect_bench: Callable[..., Bench],
    rms: tuple[float, ...],
    columns: tuple[float, ...],
    rows: tuple[float, ...],
) -> None:
    effect = Pickup(rms, columns, rows)
    bench = make_effect_bench()
    found = Pickup.estimate(in_the_dark(acquired(), bench, effect))
    assert found is not None
    assert isinstance(found.effect, Pickup)
    assert found.significance > 5
    assert len(found.effect.rms) == len(rms)
    for at, values in enumerate(zip(rms, columns, rows, strict=True)):
        size, x, y = values
        # Reversed, a wave without cycles along rows is the same.
        down = np.array(found.effect.rows) - y
        down = np.minimum(np.abs(down), np.abs(down + 2 * y)) if x < 2e-3 else down
        near = np.hypot(np.array(found.effect.columns) - x, down)
        n = int(near.argmin())
        assert near[n] < 2e-3, at
        assert found.effect.rms[n] == pytest.approx(size, abs=4 * found.errors[f"rms[{n}]"])
    assert found.size["value"] == pytest.approx(
        effect.read_variance(bench.detector) ** 0.5, rel=0.4
    )


def test_sizes_are_within_their_errors() -> None:
    rng = np.random.default_rng(5)
    shape, effect = (6, 90, 110), Pickup((1.5, 0.8), (0.31, 0.12), (-0.2, 0.33))
    y, x = np.arange(shape[1])[:, None], np.arange(shape[2])
    pulls = []
    for _ in range(60):
        frames = 5 * rng.standard_normal(shape)
        for a, fx, fy in zip(effect.rms, effect.columns, effect.rows, strict=True):
            phase = rng.uniform(0, 2 * np.pi, (shape[0], 1, 1))
            frames += 2**0.5 * a * np.cos(2 * np.pi * (fx * x + fy * y) + phase)
        found = Pickup.estimate(_evidence(frames))
        assert found is not None
        pulls.append((found.effect.rms[0] - 1.5) / found.errors["rms[0]"])
    assert np.mean(pulls) == pytest.approx(0, abs=0.6)
    assert 0.6 < np.std(pulls) < 1.5


def test_a_weak_tone_is_one() -> None:
    rng = np.random.default_rng(7)
    shape = (6, 128, 150)
    y, x = np.arange(shape[1])[:, None], np.arange(shape[2])
    for _ in range(8):
        phase = rng.uniform(0, 2 * np.pi, (shape[0], 1, 1))
        wave = np.cos(2 * np.pi * (0.31 * x - 0.2 * y) + phase)
        found = Pickup.estimate(_evidence(5 * rng.standard_normal(shape) + 0.22 * wave))
        assert found is not None
        assert len(found.effect.rms) == 1


def test_a_tone_whose_phase_wanders_from_row_to_row_is_found() -> None:
    """As in a real camera, whose clocks are not locked to it: one frequency along the rows."""
    rng = np.random.default_rng(7)
    shape = (4, 256, 200)
    y, x = np.arange(shape[1]), np.arange(shape[2])
    phase = 0.2 * rng.standard_normal(shape[:2]).cumsum(axis=1) + rng.uniform(0, 6, (shape[0], 1))
    wave = np.cos(2 * np.pi * (0.2965 * x + 0.125 * y[:, None]) + phase[..., None])
    found = Pickup.estimate(_evidence(5 * rng.standard_normal(shape) + 3 * 2**0.5 * wave))
    assert found is not None
    assert found.significance > 20
    assert len(found.effect.rms) > 10
    assert found.size["value"] == pytest.approx(3, rel=0.35)


def _coupled(frames: F64) -> F64:
    """Neighbours share noise."""
    return frames + 0.2 * np.roll(frames, 1, axis=2) + 0.2 * np.roll(frames, 1, axis=1)


def _of_a_slow_amplifier(frames: F64) -> F64:
    """Each pixel keeps half of the noise of the one before."""
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -0.5], frames, axis=2))


def _flicker(frames: F64) -> F64:
    """1/f noise in the order of the pixels."""
    size = frames[0].size
    spectrum = np.fft.rfft(frames.reshape(len(frames), -1), axis=1)
    spectrum /= np.sqrt(np.maximum(np.arange(spectrum.shape[1]) / size, 1e-4))
    return np.fft.irfft(spectrum, size, axis=1).reshape(frames.shape)


def _unequal(frames: F64) -> F64:
    """Some frames are much noisier."""
    return frames * np.where(np.arange(len(frames)) < 2, 3.5, 1.0)[:, None, None]


def _of_outputs(frames: F64) -> F64:
    """The levels of quadrants part by half of the noise."""
    levels = 0.5 * np.random.default_rng(1).standard_normal((len(frames), 2, 2))
    ny, nx = frames.shape[1] // 2, frames.shape[2] // 2
    return frames + np.kron(levels, np.ones((1, ny, nx)))


def _common_to_outputs(frames: F64) -> F64:
    """Four outputs, read at the same time, share as much noise as each has of its own."""
    first = np.random.default_rng(2).standard_normal((*frames.shape[:2], frames.shape[2] // 4))
    shared = np.tile(first, (1, 1, 5))[..., : frames.shape[2]]
    return frames + shared


@pytest.mark.parametrize(
    "change", [_coupled, _of_a_slow_amplifier, _flicker, _unequal, _of_outputs, _common_to_outputs]
)
@pytest.mark.parametrize("shape", [(8, 128, 128), (4, 256, 190), (12, 64, 300)])
def test_noise_that_is_not_white_is_no_tone(
    change: Callable[[F64], F64], shape: tuple[int, int, int]
) -> None:
    rng, found = np.random.default_rng(9), []
    for _ in range(12):
        sigmas = Pickup.detect(_evidence(5 * change(rng.standard_normal(shape))))
        assert sigmas is not None
        found.append(sigmas)
    assert max(found) < 4
    assert np.mean(found) < 1.5


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("shape", [(2, 192, 100), (8, 128, 90), (16, 311, 80)])
@pytest.mark.parametrize("axis", [1, 2])
def test_noise_of_lines_of_any_smooth_spectrum_is_no_tone(
    axis: int, exponent: float, shape: tuple[int, int, int]
) -> None:
    rng, found = np.random.default_rng(3), []
    spectrum = np.maximum(np.arange(shape[1] // 2 + 1), 1) ** (-exponent / 2)
    for _ in range(20):
        rows = np.fft.irfft(np.fft.rfft(rng.standard_normal(shape[:2])) * spectrum, shape[1])
        rows *= 10 / rows.std()
        frames = 5 * rng.standard_normal(shape) + rows[..., None]
        sigmas = Pickup.detect(_evidence(frames if axis == 1 else frames.swapaxes(1, 2)))
        assert sigmas is not None
        found.append(sigmas)
    assert max(found) < 4


def test_frames_without_noise_tell_nothing() -> None:
    assert Pickup.detect(_evidence(np.zeros((4, 64, 64)))) is None
    assert Pickup.estimate(_evidence(np.random.default_rng(1).random((1, 64, 64)))) is None


@pytest.mark.parametrize(
    "other",
    [RowNoise(6.0, 3.0, 2.0, 4.0), BiasDrift(3.0), TelegraphNoise(), OutputJitter()],
    ids=lambda effect: effect.name,
)
def test_other_noise_is_no_tone(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench], other: Effect
) -> None:
    evidence = in_the_dark(acquired(), make_effect_bench(), other)
    found = Pickup.detect(evidence)
    assert found is not None
    assert found < 5


def test_each_tone_needs_its_frequencies() -> None:
    with pytest.raises(InputError, match="rms, columns and rows"):
        Pickup((1.0, 2.0), (0.1,), (0.2, 0.3))


def _evidence(frames: F64) -> Evidence:
    number, maps = np.arange(len(frames)), np.zeros(frames.shape[1:])
    stack = Stack("bias", 0.0, number, 1.0 * number, frames.astype(np.float32))
    return Evidence(
        {},
        (stack,),
        1.0,
        5.0,
        5.0,
        maps,
        maps,
        maps + 1,
        maps == 0,
        saturation_adu=65535,
        pitch_um=5.0,
        wavelength_nm=600.0,
        distance_mm=400.0,
    )
