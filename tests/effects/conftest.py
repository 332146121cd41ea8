"""Small acquisitions with effects, simulated, reduced and fitted, as evidence."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
import yaml

import study
from pixcal.engine.run import Runtime
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.model.config import parse
from pixcal.stages import fit, ingest, reduce, simulate
from pixcal.stages.evidence import load_evidence

SYNC = Runtime(cluster="sync")

Change = dict[str, Any]


def plain_bench(changes: Change | None = None, effects: dict[str, Any] | None = None) -> Change:
    """A nominal bench (straight, steady, linear) of two sets; changes by dotted key."""
    bench: Change = study.bench(71) | {"effects": effects or {}}
    bench["detector"]["seed"] = 4600
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
