"""Without fringes: the nominal bench of a plain camera makes frames like those of the camera."""

import numpy as np
import pytest
from numpy_detectors import Detector, held_against_nominal

from pixcal.effects.quantisation import Quantisation
from pixcal.effects.telegraph_noise import MeasuredPixels, TelegraphNoise
from pixcal.estimators.test_statistics.gap import flagged
from pixcal.model.errors import InputError


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "detector",
    [
        Detector(gain=10.0, noise=30.0, bias=29.4, top=1023, rate=9000.0),
        Detector(gain=10.0, noise=30.0, bias=200.5, rate=9000.0),
        Detector(gain=20.0, noise=10.0, bias=60.0, top=1023, rate=15000.0),
        Detector(gain=5.0, noise=3.0, bias=64.3, scatter=1.5, top=1023, rate=4000.0),
        Detector(gain=0.5, noise=3.0, bias=400.7, rate=8000.0),
        Detector(gain=0.2, noise=2.0, bias=1000.7, rate=8000.0, step=16),
    ],
    ids=lambda d: f"{d.gain:g} e-/ADU, {d.noise:g} e-, {d.bias:g} ADU",
)
def test_a_plain_camera_shows_no_gap(detector: Detector) -> None:
    found = held_against_nominal(detector, 1)
    assert found.evidence.amplifier_noise == pytest.approx(detector.noise, rel=0.012)
    assert flagged(found.differences) == set()
    seen = Quantisation.estimate(found.evidence)
    assert seen is None or seen.significance < 4


def test_frames_without_light_get_none() -> None:
    detector = Detector(gain=1.0, noise=8.0, dark=0.0)
    found = held_against_nominal(detector, 2, count=2)
    frames = found.bench.simulate(found.split.test, (), 5).arrays["bias"]
    assert frames.mean() == pytest.approx(detector.bias, abs=0.1)


def test_pixels_that_see_no_light_see_none_in_simulations() -> None:
    found = held_against_nominal(Detector(unlit=40), 7)
    assert not found.evidence.good[:, :40].any()
    assert flagged(found.differences) == set()


def test_eight_bits_may_saturate() -> None:
    """A level of saturation below any usual bias leaves a bench to simulate."""
    detector = Detector(gain=32.0, noise=22.0, bias=28.3, top=255, rate=9000.0)
    found = held_against_nominal(detector, 3, saturation_adu=255.0)
    assert flagged(found.differences) == set()


@pytest.mark.parametrize("count", [2, 12])
def test_levels_that_scatter_as_lamps_do_show_no_gap(count: int) -> None:
    """By a thousandth, whether or not the light of each frame is measured."""
    lamp = np.array([1.0, -0.8, 1.2, -1.0, 0.4, -0.8])
    times = (0.1, 0.2, 0.3, 0.45, 0.7, 0.9)
    flats = [(t, count, 1 + 1e-3 * own) for t, own in zip(times, lamp.tolist(), strict=True)]
    found = held_against_nominal(Detector(flats=flats), 6)
    assert flagged(found.differences) == set()


def test_flats_of_full_pixels_do_not_pull_the_light_of_the_others() -> None:
    """Levels that are not looked at are not known, and the line of the lamp is that of the rest."""
    flats = [(t, 2, 1.0) for t in (0.1, 0.2, 0.3, 0.4, 0.8, 0.9)]
    detector = Detector(flats=flats, response=lambda e: np.minimum(e, 10_000.0))
    found = held_against_nominal(detector, 4, count=2, full_flats=(8, 9, 10, 11))
    light = found.bench.simulate(found.split.test, (), 5).arrays["flat"].mean(axis=(1, 2))
    truth = detector.bias + 2e4 * np.repeat([0.1, 0.2, 0.3, 0.4], 2) / detector.gain
    assert light == pytest.approx(truth, rel=0.01)


def test_samples_below_zero_keep_their_noise() -> None:
    """Frames that a program freed of their bias are real numbers about zero."""
    detector = Detector(gain=1.0, noise=3.0, bias=0.0, real=True)
    found = held_against_nominal(detector, 5)
    frames = found.bench.simulate(found.split.test, (), 5).arrays["bias"]
    assert frames.mean() == pytest.approx(0.0, abs=0.1)
    assert np.diff(frames, axis=0).std() / np.sqrt(2) == pytest.approx(3.0, rel=0.02)
    assert flagged(found.differences) == set()


def test_real_numbers_that_whole_ones_cannot_stand_for_are_refused() -> None:
    detector = Detector(gain=6e4, noise=30.0, bias=0.01, real=True)
    with pytest.raises(InputError, match="multiply all frames"):
        held_against_nominal(detector, 6, count=1)


def test_noise_that_an_effect_replays_pixel_by_pixel_is_not_added_twice() -> None:
    rng, extra = np.random.default_rng(4), np.zeros((96, 96))
    extra[10:12, 10:50] = 30.0
    detector = Detector(response=lambda e: e + extra * rng.standard_normal(e.shape))
    found = held_against_nominal(detector, 3, count=2)
    rows, columns = (tuple(at.tolist()) for at in np.nonzero(extra))
    ones, half = (1.0,) * len(rows), (0.5,) * len(rows)
    own = MeasuredPixels((0, 96), (0, 96), 1.0, rows, columns, ones, half)
    jumps = TelegraphNoise(0.0, 1e-3, measured=(own,))
    for effects, expected in (((), np.hypot(10, 30)), ((jumps,), 10.0)):
        frames = found.bench.simulate(found.split.test, effects, 5).arrays["bias"]
        noise = np.sqrt(frames.var(axis=0, ddof=1)[rows, columns].mean())
        assert noise * detector.gain == pytest.approx(expected, rel=0.15)
