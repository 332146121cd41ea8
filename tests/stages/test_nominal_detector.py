"""Without fringes: the nominal bench of a plain camera makes frames like those of the camera."""

import pytest
from numpy_detectors import Detector, held_against_nominal

from pixcal.effects.quantisation import Quantisation
from pixcal.estimators.diagnosis.gap import flagged


@pytest.mark.quick(2)
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
