"""A camera that subtracts its dark level keeps the shot noise of the dark signal."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from pixcal.engine.run import Runtime
from pixcal.estimators.detector.persistence import Persistence
from pixcal.stages import reduce
from pixcal.stages.evidence import load_evidence
from pixcal.stages.ingest import stage as ingest
from pixcal.stages.reduce.dark_current import LateRate
from pixcal.stages.reduce.subtracted import subtracted_dark

GAIN, READ, BIAS, DARK = 3.3, 2.6, 128.0, 300.0  # e-/ADU, ADU, ADU, e-/s
SHAPE = (121, 134)
YAML = """\
schema: pixcal/acquisition/1
detector: {pitch_um: 4.4, gain_e_per_adu: 3.3, read_noise_e: 8.6}
frames: {bias: ["bias*"], dark: ["dark*"], flat: ["flat*"]}
"""
LIT = 12000.0  # e-/s


def taken(
    folder: Path, clamped: bool, falls: float = 0.0, jitter: float = 0.0, declared: float = GAIN
) -> Path:
    """Bias, darks of two and flats of six exposure times.

    Charge ``falls`` after the first dark; the level of darks scatters by ``jitter`` (ADU).
    """
    rng = np.random.default_rng(3)
    folder.mkdir()
    (folder / "acquisition.yaml").write_text(
        YAML.replace("gain_e_per_adu: 3.3", f"gain_e_per_adu: {declared}")
    )
    groups = [("bias", 0.0, 0.0, 10), ("dark", 0.2, 0.0, 8), ("dark", 1.0, 0.0, 8)]
    groups += [("flat", t, LIT, 6) for t in (0.05, 0.12, 0.25, 0.4, 0.6, 0.8)]
    for kind, seconds, light, count in groups:
        for n in range(count):
            late = falls * (kind == "dark") * (n == 0)
            charge = rng.poisson((light + DARK) * seconds + late, SHAPE)
            level = charge / GAIN - clamped * DARK * seconds / GAIN + BIAS
            level = level + jitter * (kind == "dark") * rng.standard_normal()
            samples = np.rint(level + READ * rng.standard_normal(SHAPE)).astype("u2")
            header = fits.Header({"EXPTIME": seconds})
            fits.writeto(folder / f"{kind}_{seconds}_{n}.fits", samples, header)
    return folder


def reduced(folder: Path) -> dict[str, Any]:
    run = folder.parent / f"{folder.name} run"
    runtime = Runtime(cluster="sync", quiet=True)
    ingest.run(folder, run, ingest.Config(), runtime)
    reduce.run(run, reduce.Config(), runtime)
    found: dict[str, Any] = json.loads((run / "reduce/reduce.json").read_text())
    return found


@pytest.mark.parametrize("clamped", [True, False])
def test_dark_current_and_gain_are_those_of_the_noise(tmp_path: Path, clamped: bool) -> None:
    found = reduced(taken(tmp_path / "camera", clamped))
    assert any("camera subtracts it" in w for w in found["warnings"]) == clamped
    assert (found["subtracted_dark_e_s"] > 0) == clamped
    gain, noise = found["gain_e_per_adu"], found["read_noise_e"]
    # Without the dark signal in the level, it would be 2.5 % off.
    assert gain["error"] < 0.01 * GAIN
    assert gain["measured"] == pytest.approx(GAIN, abs=3 * gain["error"])
    assert noise["measured"] == pytest.approx(READ * GAIN, rel=0.02)
    current = found["figures_of_merit"]["dark_current"]
    assert current["value"] == pytest.approx(DARK, abs=4 * current["error"])


@pytest.mark.parametrize(("clamped", "sure"), [(True, True), (False, True), (False, False)])
def test_charge_of_light_is_taken_from_a_level_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clamped: bool, sure: bool
) -> None:
    """Only if it is sure; the noise of a camera that subtracts its level hardly shows it."""
    late = LateRate(100.0, 2.0, Persistence(0.01, 1e-4, 50.0, 1.0, True), sure)
    monkeypatch.setattr("pixcal.stages.reduce.dark_current.late_rate", lambda *_: late)
    found = reduced(taken(tmp_path / "camera", clamped))
    current = found["figures_of_merit"]["dark_current"]
    less = 0.0 if clamped or not sure else late.rate
    assert current["value"] == pytest.approx(DARK - less, abs=4 * current["error"])
    assert ("excludes 1e+02 e-/s" in current["note"]) == bool(less)
    assert (late.warning("e-/s") in found["warnings"]) == (not clamped)


def test_the_diagnosis_allows_for_its_noise(tmp_path: Path) -> None:
    folder = taken(tmp_path / "camera", clamped=True)
    run = folder.parent / "run"
    runtime = Runtime(cluster="sync", quiet=True)
    ingest.run(folder, run, ingest.Config(), runtime)
    reduce.run(run, reduce.Config(), runtime)
    evidence = load_evidence(run)
    own = np.median(evidence.dark_charge_rate)
    assert own == pytest.approx(DARK, rel=0.05)
    assert abs(np.median(evidence.dark_rate)) < 0.1 * DARK
    (dark,) = (s for s in evidence.of_kind("dark") if s.exptime_s == 1.0)
    rest, sigma = evidence.dark_noise(dark)
    assert np.nanmedian(np.abs(rest / sigma)) == pytest.approx(0.6745 * np.sqrt(7 / 8), rel=0.1)


@pytest.mark.parametrize("other", [{"falls": 500.0}, {"jitter": 2.5}, {"declared": 7.5}])
def test_changes_of_the_level_or_a_wrong_gain_are_no_subtracted_dark_signal(
    tmp_path: Path, other: dict[str, float]
) -> None:
    """A level that falls after flats, or jumps from frame to frame, is no noise of samples."""
    found = reduced(taken(tmp_path / "other", clamped=False, **other))
    assert found["subtracted_dark_e_s"] == 0


@pytest.mark.parametrize("level", [0.0, 0.3, 0.9, 1.0])
def test_the_noise_must_grow_by_more_than_the_level_explains(level: float) -> None:
    rng = np.random.default_rng(5)
    seconds = np.repeat([0.0, 1.0, 4.0], 8)
    means = BIAS + level * DARK / GAIN * seconds + 0.01 * rng.standard_normal(24)
    times = np.array([0.0, 1.0, 4.0])
    variance = READ**2 + DARK * times / GAIN**2
    error = variance * 0.003
    found = subtracted_dark((seconds, means), (times, variance, error), GAIN)
    if level > 0.5:
        assert found is None
        return
    assert found is not None
    value, off = found
    assert value == pytest.approx((1 - level) * DARK / GAIN, abs=2 * off)


def test_one_exposure_time_tells_nothing() -> None:
    times, means = np.zeros(4), np.full(4, BIAS)
    of_series = np.zeros(2), np.full(2, READ**2), np.full(2, 0.01)
    assert subtracted_dark((times, means), of_series, GAIN) is None
