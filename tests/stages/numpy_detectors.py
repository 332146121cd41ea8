"""Cameras of a few lines of NumPy, independent of pixcal's own simulation, and their null tests."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from on_disk import evidence_on_disk

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.test_statistics import Key, measure
from pixcal.estimators.test_statistics.expectation import Reference, expect_nominal
from pixcal.estimators.test_statistics.gap import Difference, compare
from pixcal.model.acquisition import SCHEMA, Acquisition
from pixcal.model.config import parse
from pixcal.stages import reduce
from pixcal.stages.diagnose.frames import Split, split
from pixcal.stages.diagnose.measure_nominal import nominal_bench
from pixcal.stages.diagnose.nominal import NominalBench
from pixcal.stages.diagnose.parts import RawFrames, RunFrames, evidence_of
from pixcal.stages.diagnose.windows import whole_of
from pixcal.storage.manifest import read_json

F64 = NDArray[np.float64]
Frames = dict[str, NDArray[Any]]
Tables = dict[str, dict[str, list[Any]]]


@dataclass(frozen=True)
class Detector:
    """A camera, and what is recorded with it: flats are (exposure s, frames, lamp)."""

    gain: float = 2.0
    noise: float = 10.0
    bias: float = 100.4
    scatter: float = 0.0
    shape: tuple[int, int] = (96, 96)
    top: int = 65535
    step: int = 1
    dark: float = 5.0
    rate: float = 2e4
    prnu: float = 0.01
    unlit: int = 0  # columns that see no light
    flats: Sequence[tuple[float, int, float]] = ((0.1, 10, 1), (0.3, 10, 1), (0.6, 10, 1))
    response: Callable[[F64], F64] = lambda electrons: electrons
    real: bool = False  # real numbers, negative ones too, instead of codes

    def frames(self, seed: int, bias: int = 20, dark: int = 8) -> tuple[Frames, Tables]:
        """Bias, dark (1 s) and flat frames as a camera writes them."""
        rng = np.random.default_rng(seed)
        offset = self.bias + self.scatter * rng.standard_normal(self.shape)
        pixels = 1 + self.prnu * rng.standard_normal(self.shape)
        pixels[:, : self.unlit] = 0

        def frame(seconds: float, light: float) -> NDArray[Any]:
            charge = rng.poisson((self.dark + light * self.rate * pixels) * seconds).astype(float)
            noise = self.noise * rng.standard_normal(self.shape)
            adu = (self.response(charge) + noise) / self.gain + offset
            if self.real:
                return adu.astype(np.float32)
            codes = np.rint(adu / self.step) * self.step
            return np.clip(codes, 0, self.top).astype(np.uint16)

        plan = {"bias": [(0.0, bias, 0.0)], "dark": [(1.0, dark, 0.0)], "flat": self.flats}
        arrays, tables = {}, {}
        for kind, steps in plan.items():
            each = [(t, lamp) for t, count, lamp in steps for _ in range(count)]
            if not each:
                continue
            arrays[kind] = np.stack([frame(*one) for one in each])
            n = len(each)
            tables[kind] = {
                "file": [f"{kind}-{i}.fits" for i in range(n)],
                "plane": [0] * n,
                "mjd": [None] * n,
                "exptime_s": [t for t, _ in each],
                "temperature_c": [None] * n,
                "time_s": [float(i) for i in range(n)],
                "time_source": ["number"] * n,
            }
        return arrays, tables

    def described(self, **detector: float) -> Acquisition:
        """What its owner says of it."""
        plain = {
            "schema": SCHEMA,
            "detector": {"pitch_um": 5.0, "gain_e_per_adu": self.gain, "read_noise_e": self.noise}
            | detector,
            "optics": {"wavelength_nm": 632.8, "distance_mm": 400.0},
            "frames": {
                "bias": ["bias*"],
                "dark": ["dark*"],
                "flat": ["flat*"] if self.flats else [],
                "fringes": [],
            },
        }
        return parse(Acquisition, plain, "acquisition")


def reduced(detector: Detector, seed: int, folder: Path) -> tuple[Evidence, dict[str, Any]]:
    """Evidence of a recording, and its ``reduce.json``."""
    arrays, tables = detector.frames(seed)
    raw = RawFrames(detector.described(), arrays, tables, reduce.Config())
    evidence = evidence_on_disk(raw, folder)
    report: dict[str, Any] = read_json(folder / "reduce" / "reduce.json")
    return evidence, report


@dataclass(frozen=True)
class Nominal:
    """An acquisition, its nominal bench, and how far simulations of it are off."""

    evidence: Evidence
    bench: NominalBench
    split: Split
    differences: Mapping[Key, Difference]


def held_against_nominal(
    detector: Detector,
    seed: int,
    count: int = 12,
    full_flats: Sequence[int] = (),
    **declared: float,
) -> Nominal:
    """Measure the nominal bench of a recording, and hold its second half against simulations."""
    arrays, tables = detector.frames(seed)
    acquisition, part = detector.described(**declared), whole_of(detector.shape)
    own = split(tables, detector.shape[0] * detector.shape[1], full_flats)

    def look(raw: RawFrames) -> Evidence:
        return evidence_of(raw, part, detector.shape)

    dtypes = {name: array.dtype for name, array in arrays.items()}
    frames = RunFrames(acquisition, tables, dtypes, reduce.Config())
    halves = [
        look(frames.raw({name: array[half[name]] for name, array in arrays.items()}, half))
        for half in (own.learn, own.test)
    ]
    bench = nominal_bench(frames, halves, (own.learn, own.test), detector.shape)
    made = [measure(look(bench.simulate(own.test, (), 1000 * seed + n))) for n in range(count)]
    reference = Reference.of(made)
    data = reference.on_scale(measure(halves[1]))
    return Nominal(halves[0], bench, own, compare(data, expect_nominal(reference)))
