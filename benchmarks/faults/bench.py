"""A small acquisition, its results by undisturbed commands, and the comparison of runs."""

import hashlib
import json
import os
import random
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from faults.forks import pixcal

STAGES = ("ingest", "reduce", "fit")
SHAPE = (137, 150)
"""Four tiles of chunks, none of them whole."""

HOW_IT_RAN = frozenset({"chunks_read", "passes"})
"""Counts of readings, which are more when a run was cut short; in `tiles` as well."""
OF_A_MANIFEST = frozenset({"files", "seal", "acquisition"})
"""Digests of files that hold such counts, and where the FITS files are from there."""


@dataclass(frozen=True)
class Bench:
    """An acquisition and a run made from it without a fault."""

    folder: Path  # where runs may be made
    acquisition: Path
    reference: Path  # the undisturbed run: ingest, reduce, fit and allan
    seconds: dict[str, float]  # how long each command took
    seed: int = 0  # of all moments, files and bits

    def copy(self, name: str, *stages: str) -> Path:
        """A new run with some stages of the reference.

        They are hard links: replace files, do not write into them.
        """
        run = self.folder / name
        shutil.rmtree(run, ignore_errors=True)
        run.mkdir()
        for stage in stages:
            shutil.copytree(self.reference / stage, run / stage, copy_function=os.link)
        return run

    def before(self, stage: str, name: str) -> Path:
        """A new run with the stages that precede one."""
        return self.copy(name, *STAGES[: STAGES.index(stage)])

    def command(self, stage: str, run: Path) -> list[str]:
        """The command line that makes a stage."""
        return line(stage, self.acquisition, run)

    def rng(self, *names: str) -> random.Random:
        """Random numbers for one kind of fault."""
        return random.Random(" ".join([*names, str(self.seed)]))

    def assert_resumed(self, run: Path, stage: str) -> None:
        """Run a stage again to its end; it and all earlier stages must equal the reference."""
        pixcal(*self.command(stage, run)).succeeded()
        self.assert_same(run, *STAGES[: STAGES.index(stage) + 1])

    def assert_same(self, run: Path, *stages: str) -> None:
        """Assert that stages of a run are those of the reference, bit for bit."""
        found = differences(self.reference, run, *stages)
        assert found == [], found


def line(stage: str, acquisition: Path, run: Path) -> list[str]:
    """The command line that makes a stage."""
    if stage == "ingest":
        return ["ingest", str(acquisition), "--out", str(run)]
    return [stage, str(run)]


def make_bench(folder: Path, seed: int) -> Bench:
    """Simulate an acquisition and make the reference."""
    config = yaml.safe_load((Path(__file__).parents[2] / "tests" / "bench.yaml").read_text())
    config["detector"]["shape"] = list(SHAPE)
    file = folder / "bench.yaml"
    file.write_text(yaml.safe_dump(config))
    acquisition, run = folder / "acquisition", folder / "reference"
    pixcal("simulate", file, "--out", acquisition).succeeded()
    seconds = {}
    for stage in (*STAGES, "allan"):
        seconds[stage] = pixcal(*line(stage, acquisition, run)).succeeded().seconds
    return Bench(folder, acquisition, run, seconds, seed)


def differences(one: Path, other: Path, *stages: str) -> list[str]:
    """Files of some stages that are not the same in two runs; none may be left half-done."""
    parts = [*stages, *(["sweep", "products"] if "fit" in stages else [])]
    left = [f.name for f in other.glob(".partial/*") if f.name.rpartition("-")[0] in parts]
    assert not left, left
    found: list[str] = []
    for part in parts:
        a, b = dict(contents(one / part)), dict(contents(other / part))
        names = a.keys() | b.keys()
        if part == "products":
            names = {name for name in names if name.startswith(("delta", "fit"))}
        found += [f"{part}/{name}" for name in sorted(names) if a.get(name) != b.get(name)]
    return found


def contents(folder: Path) -> Iterator[tuple[str, str]]:
    """Name and digest of every file, but for counts of readings."""
    for file in sorted(f for f in folder.rglob("*") if f.is_file()):
        name = file.relative_to(folder).as_posix()
        if "/tiles/" in name and "sweep.zarr" in name:
            continue
        body = file.read_bytes()
        if file.suffix == ".json" and file.name != "zarr.json":
            left_out = HOW_IT_RAN | OF_A_MANIFEST if file.name == "manifest.json" else HOW_IT_RAN
            body = json.dumps(_without(json.loads(body), left_out), sort_keys=True).encode()
        yield name, hashlib.sha256(body).hexdigest()


def _without(data: Any, keys: frozenset[str]) -> Any:
    if isinstance(data, dict):
        return {k: _without(v, keys) for k, v in data.items() if k not in keys}
    return [_without(v, keys) for v in data] if isinstance(data, list) else data
