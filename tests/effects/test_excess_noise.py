"""Excess noise: the variance and skewness of multiplied electrons; told from a wrong gain."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from all_frames import frames_of
from numpy_detectors import Detector

from pixcal.effects.excess_noise import ExcessNoise
from pixcal.effects.gain_error import GainError
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.simulation.recording import recordings
from pixcal.stages import reduce
from pixcal.stages.diagnose.parts import RawFrames, evidence_of
from pixcal.stages.diagnose.windows import whole_of
from pixcal.stages.reduce.black_cut_off import Black


@pytest.mark.parametrize("excess", [0.5, 1.0])
def test_noise_of_light_grows_and_nothing_else(
    make_effect_bench: Callable[..., Bench], excess: float
) -> None:
    bench = make_effect_bench({"detector.shape": [41, 53]})
    flat = [r for r in recordings(bench) if r.kind == "flat"][-1]
    bias = next(r for r in recordings(bench) if r.kind == "bias")
    means, variances = [], []
    for effects in ((), (ExcessNoise(excess),)):
        lit, dark = (frames_of(bench, r, effects).astype(float) for r in (flat, bias))
        means.append(lit.mean())
        variances.append(lit.var(axis=0, ddof=1).mean() - dark.var(axis=0, ddof=1).mean())
    assert means[1] == pytest.approx(means[0], rel=1e-3)
    rel = 5 * np.sqrt(4 / (19 * 41 * 53))
    assert variances[1] / variances[0] == pytest.approx(1 + excess, rel=rel)


def test_few_electrons_are_skewed_as_a_sum_of_exponentials(
    make_effect_bench: Callable[..., Bench],
) -> None:
    """Skewness of n exponential variates: 2 / sqrt(n)."""
    bench = make_effect_bench({"detector.shape": [200, 300]})

    class OneShot:
        def __init__(self) -> None:
            self.bench = bench

        def normals(self, _: str) -> np.ndarray:
            rng = np.random.default_rng(2)
            return rng.standard_normal(bench.detector.shape).astype(np.float32)

    for electrons in (1.0, 4.0, 100.0):
        signal = np.full(bench.detector.shape, electrons, np.float32)
        found = ExcessNoise(1.0).signal(signal, OneShot()).astype(float)  # type: ignore[arg-type]
        rest = found - electrons
        assert rest.mean() == pytest.approx(0, abs=0.02 * np.sqrt(electrons))
        assert rest.var() == pytest.approx(electrons, rel=0.03)
        skewness = (rest**3).mean() / rest.std() ** 3
        assert skewness == pytest.approx(2 / np.sqrt(electrons), abs=0.1)


@pytest.mark.parametrize(("factor", "named"), [(1.0, False), (2.0, True)])
def test_the_third_moment_decides_what_the_noise_is(
    acquired: Callable[..., Evidence], factor: float, named: bool
) -> None:
    """Flats whose noise is twice that expected, of multiplied electrons or of a wrong gain."""
    right = replace(acquired(), fringes={})
    twice = replace(right, gain=2 * right.gain, read_noise=2 * right.read_noise)
    evidence = replace(twice, excess_noise_factor=factor)
    noise, gain = ExcessNoise.estimate(evidence), GainError.estimate(evidence)
    assert noise is not None
    assert gain is not None
    assert (noise.significance > 5) == named
    assert (gain.significance > 5) != named
    if named:
        assert noise.effect.excess == pytest.approx(1, abs=4 * noise.errors["excess"])  # type: ignore[attr-defined]


def test_halves_of_the_frames_know_what_the_whole_run_shows() -> None:
    """Four flats of a level tell the third moment, two of each half do not."""
    seen = {}
    for factor in (1.0, 2.0):
        black = Black({}, excess_noise_factor=factor)
        detector = Detector(flats=((0.1, 2, 1), (0.3, 2, 1)))
        frames, tables = detector.frames(3)
        raw = RawFrames(detector.described(), frames, tables, reduce.Config(), black)
        whole = whole_of(detector.shape)
        seen[factor] = evidence_of(raw, whole, detector.shape).excess_noise_factor
    assert seen == {1.0: 1.0, 2.0: 2.0}
