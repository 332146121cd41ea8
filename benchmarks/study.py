"""A study of many acquisitions of one bench, which resumes after an interruption."""

import json
import tempfile
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

import pixcal
from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.bench import SCHEMA

Result = dict[str, Any]


def bench(seed: int) -> dict[str, Any]:
    """Two sets of 300 frames on 61 x 67 pixels, with bias, darks and three levels of flats."""
    detector = {
        "seed": seed + 1,
        "shape": [61, 67],
        "pitch_um": 4.4,
        "gain_e_per_adu": 1.0,
        "read_noise_e": 16.0,
        "bias_adu": 500,
        "bias_pixel_rms_adu": 4.0,
        "dark_e_s": 24.0,
        "prnu_rms": 0.01,
        "delta_rms_px": 2.0e-3,
        "hot_fraction": 0.004,
        "hot_rate_e_s": 3.0e4,
    }
    fringes = [
        {"name": name, "baseline_mm": baseline, "count": 300, "peak_e": 45000}
        for name, baseline in (("vertical", [11.5, 0.0]), ("horizontal", [0.0, 6.4]))
    ]
    frames = {
        "exptime_s": 0.02,
        "period_s": 0.14,
        "per_file": 500,
        "bias": 60,
        "darks": [{"exptime_s": 0.5, "count": 20}],
        "flat_rate_e_s": 1.25e6,
        "flats": [{"exptime_s": 0.01 * n, "count": 20} for n in (1, 2, 3)],
        "fringes": fringes,
    }
    optics = {
        "wavelength_nm": 632.8,
        "distance_mm": 400.0,
        "beam_radius_mm": 35.0,
        "visibility": 0.95,
    }
    return {
        "schema": SCHEMA,
        "seed": seed,
        "detector": detector,
        "optics": optics,
        "frames": frames,
    }


@contextmanager
def reduced(plain: Mapping[str, Any]) -> Iterator[Path]:
    """A temporary run directory with an acquisition of a bench, ingested and reduced."""
    with tempfile.TemporaryDirectory() as folder:
        file, acquisition, run = (Path(folder, n) for n in ("bench.yaml", "acq", "run"))
        file.write_text(yaml.safe_dump(plain), encoding="utf-8")
        pixcal.simulate(file, acquisition)
        pixcal.ingest(acquisition, run)
        pixcal.reduce(run)
        yield run


def run_study(
    examine: Callable[[Any], Result],
    cases: Sequence[Hashable],
    case_of: Callable[[Result], Hashable],
    out: Path,
) -> list[Result]:
    """Results of all cases, kept in ``out`` as lines of JSON; those there are not repeated."""
    out.parent.mkdir(parents=True, exist_ok=True)
    out.touch()
    results = [json.loads(line) for line in out.read_text("utf-8").splitlines()]
    known = set(map(case_of, results))
    pending = [case for case in cases if case not in known]
    with out.open("a", encoding="utf-8") as lines:

        def keep(_: int, result: Result) -> None:
            results.append(result)
            print(json.dumps(result), file=lines, flush=True)

        runtime = Runtime(cluster="processes", quiet=False)
        run_tasks(examine, pending, runtime, label="acquisitions", done=keep)
    return results
