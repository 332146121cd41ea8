"""Speed of ingest and fit against the barest scan of the same data: ``make bench``.

Writes a simulated acquisition (one set), then interleaves scans and fits of the same cube in one
run and prints their ratios: machines differ and drift, ratios less. The scan decodes every chunk
with the same reader and adds its samples up; the caches are warm.
"""

import argparse
import shutil
import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml

from pixcal.engine.run import Runtime
from pixcal.stages import fit, ingest, reduce, simulate
from pixcal.stages.reduced_set import ReducedSet

ROOT = Path(__file__).parents[1]


def seconds(work: Callable[[], object]) -> float:
    """Wall time of a call."""
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def scan(source: ReducedSet, threads: int) -> None:
    """Decode all chunks and add their samples, shared among threads."""

    def part(number: int) -> None:
        for tile in source.tiles()[number::threads]:
            for block in range(source.n_blocks):
                source.signal.read_chunk((block, *tile)).sum(dtype=np.uint32)

    workers = [threading.Thread(target=part, args=(n,)) for n in range(threads)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()


def configuration(folder: Path, size: int, frames: int) -> Path:
    """Bench of one set on a square window."""
    config = yaml.safe_load((ROOT / "configs" / "precision.yaml").read_text())
    config["detector"]["shape"] = [size, size]
    config["frames"]["fringes"][0]["count"] = frames
    config["frames"]["per_file"] = 1
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=512, help="pixels along each side")
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    gigabytes = 2e-9 * options.size**2 * options.frames
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        run = folder / "run"
        runtime = Runtime()
        simulate.run(
            configuration(folder, options.size, options.frames),
            folder / "acq",
            simulate.Config(),
            runtime,
        )
        took = seconds(lambda: ingest.run(folder / "acq", run, ingest.Config(), runtime))
        print(
            f"{gigabytes:.2f} GB of raw samples, {options.size} x {options.size} x {options.frames}"
        )
        print(f"ingest: {gigabytes / took:.2f} GB/s")
        took = seconds(lambda: reduce.run(run, reduce.Config(), runtime))
        print(f"reduce: {gigabytes / took:.2f} GB/s")
        source = ReducedSet(run / "reduce" / "reduced.zarr" / "vertical")

        def fitted(threads: int) -> float:
            for stage in ("sweep", "fit"):
                shutil.rmtree(run / stage, ignore_errors=True)
            return seconds(lambda: fit.run(run, fit.Config(), Runtime(workers=threads)))

        fitted(2)
        times: dict[tuple[str, int], list[float]] = {}
        for _ in range(options.repeat):
            for threads in (1, 2):
                times.setdefault(("scan", threads), []).append(
                    seconds(lambda n=threads: scan(source, n))
                )
                times.setdefault(("fit", threads), []).append(fitted(threads))
        for threads in (1, 2):
            scans, fits = times["scan", threads], times["fit", threads]
            ratios = [b / a for a, b in zip(scans, fits, strict=True)]
            print(
                f"{threads} threads: scan {gigabytes / statistics.median(scans):.2f} GB/s, "
                f"fit {gigabytes / statistics.median(fits):.2f} GB/s, "
                f"fit / scan {statistics.median(ratios):.2f} "
                f"({min(ratios):.2f} to {max(ratios):.2f})"
            )
        gain = [a / b for a, b in zip(times["fit", 1], times["fit", 2], strict=True)]
        print(f"fit, two threads against one: {statistics.median(gain):.2f} times as fast")


if __name__ == "__main__":
    main()
