"""Small acquisitions with effects, simulated, reduced and fitted, as evidence."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
import yaml

from pixcal.engine.run import Runtime
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.bench import SCHEMA, Bench
from pixcal.model.config import parse
from pixcal.stages import fit, ingest, reduce, simulate
from pixcal.stages.evidence import load_evidence

SYNC = Runtime(cluster="sync")

Change = dict[str, Any]


def plain_bench(changes: Change | None = None, effects: dict[str, Any] | None = None) -> Change:
    """A nominal bench (straight, steady, linear) of two sets; changes by dotted key."""
    bench: Change = {
        "schema": SCHEMA,
        "seed": 71,
        "detector": {
            "seed": 4600,
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
        },
        "optics": {
            "wavelength_nm": 632.8,
            "distance_mm": 400.0,
            "beam_radius_mm": 35.0,
            "visibility": 0.95,
        },
        "frames": {
            "exptime_s": 0.02,
            "period_s": 0.14,
            "per_file": 500,
            "bias": 60,
            "darks": [{"exptime_s": 0.5, "count": 20}],
            "flat_rate_e_s": 1.25e6,
            "flats": [
                {"exptime_s": 0.01, "count": 20},
                {"exptime_s": 0.02, "count": 20},
                {"exptime_s": 0.03, "count": 20},
            ],
            "fringes": [
                {"name": "vertical", "baseline_mm": [11.5, 0.0], "count": 300, "peak_e": 45000},
                {"name": "horizontal", "baseline_mm": [0.0, 6.4], "count": 300, "peak_e": 45000},
            ],
        },
        "effects": effects or {},
    }
    for place, value in (changes or {}).items():
        *path, key = place.split(".")
        section: Any = bench
        for step in path:
            section = section[int(step) if step.isdigit() else step]
        section[int(key) if isinstance(section, list) else key] = value
    return bench


@pytest.fixture(scope="session")
def make_effect_bench() -> Callable[..., Bench]:
    """Make a `Bench`: ``make_effect_bench({"optics.visibility": 0.5}, {"ipc": {}})``."""
    return lambda *a: parse(Bench, plain_bench(*a), "bench")


@pytest.fixture(scope="session")
def acquired(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Evidence]:
    """Simulate, reduce and fit: ``acquired(changes, effects)``; each made once."""
    runs: dict[str, Path] = {}

    # In memory each is large.
    @lru_cache(maxsize=4)
    def evidence(run: Path) -> Evidence:
        return load_evidence(run)

    def make(changes: Change | None = None, effects: dict[str, Any] | None = None) -> Evidence:
        text = yaml.safe_dump(plain_bench(changes, effects))
        if text not in runs:
            folder: Path = tmp_path_factory.mktemp("acquired")
            (folder / "bench.yaml").write_text(text)
            simulate.run(folder / "bench.yaml", folder / "acq", simulate.Config(), SYNC)
            ingest.run(folder / "acq", folder / "run", ingest.Config(), SYNC)
            reduce.run(folder / "run", reduce.Config(), SYNC)
            fit.run(folder / "run", fit.Config(), SYNC)
            runs[text] = folder / "run"
        return evidence(runs[text])

    return make
