"""Simulated acquisitions and their runs in a folder: made once, resumed after an interruption.

The stages themselves skip what is up to date, so a scene has no bookkeeping of its own.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.run import Runtime
from pixcal.model.bench import Bench, load_bench
from pixcal.model.yaml_file import to_yaml
from pixcal.stages import allan, crests, fit, ingest, reduce, simulate
from pixcal.stages.fit.sweep import load_run
from pixcal.stages.fitted_shape import nominal_vector as declared_vector
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.manifest import read_json
from truth import Truth

F64 = NDArray[np.float64]
CONFIGS = Path(__file__).parents[2] / "configs" / "paper"


def resized(bench: Bench, *, side: int | None = None, frames: int | None = None) -> Bench:
    """A bench with a smaller square window in the same place of the chip, and fewer frames."""
    d, f = bench.detector, bench.frames
    shape = d.shape if side is None else (min(side, d.shape[0]), min(side, d.shape[1]))
    sets = tuple(s if frames is None else replace(s, count=min(frames, s.count)) for s in f.fringes)
    return replace(bench, detector=replace(d, shape=shape), frames=replace(f, fringes=sets))


@dataclass(frozen=True)
class Scene:
    """A simulated acquisition, its truth, and the runs made from it."""

    folder: Path  # its own
    bench: Bench
    runtime: Runtime

    @classmethod
    def simulate(cls, folder: Path, bench: Bench, runtime: Runtime) -> "Scene":
        """Simulate a bench into a folder, unless it is there."""
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / "bench.yaml"
        file.write_text(to_yaml(bench), encoding="utf-8")
        simulate.run(file, folder / "acq", simulate.Config(), runtime)
        return cls(folder, bench, runtime)

    def reduced(self, frames: int | None = None) -> Path:
        """A run with reduced cubes, of the first ``frames`` of each set or of all."""
        whole = all(frames in (None, s.count) for s in self.bench.frames.fringes)
        name = "run" if whole else f"run-{frames}"
        acquisition = self.folder / "acq" if frames is None or whole else self._cut(frames)
        run = self.folder / name
        ingest.run(acquisition, run, ingest.Config(overwrite=True), self.runtime)
        reduce.run(run, reduce.Config(), self.runtime)
        return run

    def _cut(self, frames: int) -> Path:
        """An acquisition of the first frames: links to the same files."""
        if frames % self.bench.frames.per_file:
            raise ValueError(f"{frames} frames are no whole number of files")
        source, cut = self.folder / "acq", self.folder / f"acq-{frames}"
        for kind in (p for p in source.iterdir() if p.is_dir()):
            (cut / kind.name).mkdir(parents=True, exist_ok=True)
            fringes = kind.name not in ("bias", "dark", "flat")
            files = sorted(kind.glob("*.fits"))
            wanted = files[: frames // self.bench.frames.per_file] if fringes else files
            for old in set((cut / kind.name).iterdir()):
                old.unlink()
            for file in wanted:
                (cut / kind.name / file.name).hardlink_to(file)
        (cut / "acquisition.yaml").write_bytes((source / "acquisition.yaml").read_bytes())
        return cut

    def fit(
        self, frames: int | None = None, model: str = "auto", batch_frames: int | None = None
    ) -> Path:
        """A run that is fitted."""
        run = self.reduced(frames)
        fit.run(run, fit.Config(model=model, batch_frames=batch_frames), self.runtime)
        return run

    def allan(self, batch_frames: int) -> dict[str, Any]:
        """``allan.json`` by set, from batches of so many frames."""
        run = self.fit(batch_frames=batch_frames)
        allan.run(run, allan.Config(), self.runtime)
        found: dict[str, Any] = read_json(run / "products" / "allan.json")["sets"]
        return found

    def crests(self, frames: int) -> Path:
        """A run whose crests and valleys were followed in so many frames."""
        run = self.reduced()
        crests.run(run, crests.Config(frames=frames), self.runtime)
        return run

    def truth(self, name: str) -> Truth:
        """Truth of a set."""
        return Truth.read(self.folder / "acq-truth", name)

    def truth_of_sets(self) -> dict[str, Any]:
        """``truth.json`` by set."""
        found: dict[str, Any] = read_json(self.folder / "acq-truth" / "truth.json")["sets"]
        return found


def read_set(run: Path, name: str, *arrays: str) -> tuple[F64, ...]:
    """Arrays of a set of ``RUN/fit``, as float64."""
    folder = run / "fit" / "fit.zarr" / name
    return tuple(ArrayReader(folder / array).read().astype(float) for array in arrays)


def facts(run: Path, name: str) -> dict[str, Any]:
    """The set's part of ``fit.json``."""
    found: dict[str, Any] = read_json(run / "products" / "fit.json")["sets"][name]
    return found


def nominal_vector(run: Path, name: str) -> tuple[float, float]:
    """Fringe vector (kx, ky) that the acquisition declares, rad/px."""
    return declared_vector(load_run(run), name)


@dataclass(frozen=True)
class Lab:
    """Where scenes are kept, and how large they are."""

    work: Path
    runtime: Runtime
    full: bool = False  # the paper's own sizes, rather than those of some minutes

    def bench(self, name: str) -> Bench:
        """A bench of ``configs/paper``."""
        return load_bench(CONFIGS / f"{name}.yaml")

    def sized(self, name: str, *, side: int | None = None, frames: int | None = None) -> Bench:
        """The same, reduced to a smaller size unless that of the paper is requested."""
        bench = self.bench(name)
        return bench if self.full else resized(bench, side=side, frames=frames)

    def scene(self, name: str, bench: Bench) -> Scene:
        """Simulate a bench, unless that has been done."""
        return Scene.simulate(self.work / name, bench, self.runtime)
