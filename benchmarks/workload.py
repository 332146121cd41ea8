"""Acquisitions to measure speed on, and how time and memory are measured."""

import os
import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from pixcal.engine import plan
from pixcal.engine.run import Runtime
from pixcal.kernels.bilinear import GOES_ON, N_SUMS, sweep_batches
from pixcal.stages import allan, fit, ingest, reduce, report, simulate
from pixcal.stages.reduced_set import ReducedSet

ROOT = Path(__file__).parents[1]


def seconds(work: Callable[[], object]) -> float:
    """Wall time of a call."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def plain_sum(codes: NDArray[np.uint16]) -> None:
    """Add the samples of a chunk."""
    codes.sum(dtype=np.uint32)


def weighted_sums(source: ReducedSet) -> Callable[[NDArray[np.uint16]], None]:
    """What adds the samples of a chunk of a set to the sums of its pixels, as a fit does."""
    coding, phase, one = source.coding, 2.4 * np.arange(source.block), np.ones(source.block)
    g = np.column_stack([one, np.cos(phase), np.sin(phase)]).astype(np.float32)
    still = np.zeros((source.block, 2), np.float32)

    @cache
    def of_pixels(shape: tuple[int, int]) -> tuple[NDArray[Any], ...]:
        model = np.multiply.outer([2e4, 1.2e4, 1.2e4], np.ones(shape)).astype(np.float32)
        sums = np.zeros((2, shape[0], N_SUMS, shape[1]))
        of_batches = np.zeros((2, 0, *shape), np.float32)
        return model, np.full(shape, 256, np.float32), np.ones(shape, np.float32), sums, of_batches

    def add(codes: NDArray[np.uint16]) -> None:
        n, *shape = codes.shape
        *fixed, sums, of_batches = of_pixels((shape[0], shape[1]))
        sweep_batches(
            codes,
            *coding,
            g[:n],
            still[:n],
            0.0,
            0.0,
            *fixed,
            np.array([n]),
            np.array([GOES_ON]),
            *sums,
            *of_batches,
        )

    return add


@dataclass(frozen=True)
class Workload:
    """A simulated acquisition of one or two sets, and the run made from it."""

    folder: Path  # its own; holds ``acq`` and ``run``
    shape: tuple[int, int]  # rows and columns
    # frames, sets: frames of each set; one set or two, of crossed axes
    frames: int
    sets: int = 1

    @property
    def gigabytes(self) -> float:
        """Raw samples of the fringe frames, GB."""
        return 2e-9 * self.shape[0] * self.shape[1] * self.frames * self.sets

    @property
    def run(self) -> Path:
        """The run."""
        return self.folder / "run"

    @property
    def sources(self) -> list[ReducedSet]:
        """The reduced cubes."""
        return [
            ReducedSet(p)
            for p in sorted((self.run / "reduce" / "reduced.zarr").iterdir())
            if p.is_dir()
        ]

    def simulate(self) -> float:
        """Write the acquisition; seconds."""
        config = yaml.safe_load((ROOT / "configs" / "precision.yaml").read_text())
        config["detector"]["shape"] = list(self.shape)
        vertical = config["frames"]["fringes"][0] | {"count": self.frames}
        crossed = vertical | {"name": "horizontal", "baseline_mm": vertical["baseline_mm"][::-1]}
        config["frames"] |= {"fringes": [vertical, crossed][: self.sets], "per_file": 1}
        # Calibration frames are not what is measured.
        config["frames"] |= {"bias": 8, "flats": [{"exptime_s": 0.023, "count": 8}]}
        self.folder.mkdir(parents=True, exist_ok=True)
        bench = self.folder / "bench.yaml"
        bench.write_text(yaml.safe_dump(config))
        return seconds(
            lambda: simulate.run(bench, self.folder / "acq", simulate.Config(), Runtime())
        )

    def ingest(self) -> float:
        """Seconds."""
        return seconds(
            lambda: ingest.run(self.folder / "acq", self.run, ingest.Config(), Runtime())
        )

    def forget_frames(self) -> None:
        """Remove the acquisition: it was reduced."""
        shutil.rmtree(self.folder / "acq", ignore_errors=True)

    def reduce(self) -> float:
        """Seconds; the frames are removed afterwards."""
        took = seconds(lambda: reduce.run(self.run, reduce.Config(), Runtime()))
        self.forget_frames()
        return took

    def fit(self, threads: int) -> float:
        """Seconds of a fit from the start; results of an earlier one are removed first."""
        self.forget_fit()
        return seconds(lambda: fit.run(self.run, fit.Config(), Runtime(workers=threads)))

    def forget_fit(self) -> None:
        """Remove what the fit left."""
        for stage in ("sweep", "fit"):
            shutil.rmtree(self.run / stage, ignore_errors=True)

    def scan(self, threads: int, *, weighted: bool = False) -> float:
        """Seconds to decode all chunks and add their samples, shared among threads.

        The barest use of the fit's own reader. ``weighted``: add them as the fit does, each sample
        with its weight, by the fit's own kernel: the least that any fit needs.
        """

        def part(number: int) -> None:
            for source in self.sources:
                add = weighted_sums(source) if weighted else plain_sum
                for tile in source.tiles()[number::threads]:
                    for codes in source.blocks(tile):
                        add(codes)

        workers = [threading.Thread(target=part, args=(n,)) for n in range(threads)]

        def work() -> None:
            for worker in workers:
                worker.start()
            for worker in workers:
                worker.join()

        return seconds(work)

    def chill(self) -> None:
        """Drop the reduced cubes from the page cache."""
        os.sync()
        for source in self.sources:
            for file in (source.folder / "signal").rglob("*"):
                if file.is_file():
                    with file.open("rb") as handle:
                        os.posix_fadvise(handle.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def memory(stage: str, run: Path) -> dict[str, float]:
    """Peak memory of a stage in a separate process (bytes), the largest planned, and seconds."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_memory, stage, run).result()


def _memory(stage: str, run: Path) -> dict[str, float]:
    planned: list[int] = []
    of = plan.Plan.total.fget

    def noted(self: plan.Plan) -> int:
        planned.append(of(self))
        return planned[-1]

    plan.Plan.total = property(noted)
    if stage == "ingest":
        took = seconds(lambda: ingest.run(run.parent / "acq", run, ingest.Config(), Runtime()))
    else:
        module = {"reduce": reduce, "fit": fit, "allan": allan, "report": report}[stage]
        took = seconds(lambda: module.run(run, module.Config(), Runtime()))
    status = Path("/proc/self/status").read_text()
    peak = int(status.partition("VmHWM:")[2].split()[0]) * 1024
    # Plans that were too large for the memory allowed were made again with fewer workers.
    return {
        "planned": max(p for p in planned if p <= Runtime().memory),
        "peak": peak,
        "seconds": took,
    }
