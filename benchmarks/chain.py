"""From FITS files to maps and report, against a plain read and a plain write: ``make bench``.

The limits are measured in the same run as the stages: every FITS file read once, the samples of the
reduced cubes written once more by the same writer and flushed to the disk, and as many bytes copied
in memory. If two threads are not twice as fast, the ratios to these limits show the bottleneck.
"""

import argparse
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from pixcal.engine.run import Runtime
from pixcal.stages import allan, fit, ingest, reduce, report
from pixcal.storage.cube import create_array
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.lock import flushed_last
from workload import Workload, seconds

THREADS = 2
STAGES = ("ingest", "reduce", "fit", "allan", "flush", "report")
COPIED = np.ones(32 << 20, np.uint8)  # larger than what the processor keeps


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=1024, help="pixels along each side")
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--folder", type=Path, help="where the data go; default: a temporary one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as scratch:
        work = Workload(Path(scratch, "chain"), (options.size, options.size), options.frames, 2)
        work.simulate()
        compare(work)


def compare(work: Workload) -> None:
    """Times of the stages and of the limits, on one thread and on two."""
    every_stage(work, THREADS)  # kernels compiled, files in memory
    # The limits of two threads before the stages of two threads, whose cubes they write again.
    one = every_stage(work, 1) | limits(work, 1)
    two = every_stage(work, THREADS) | limits(work, THREADS)
    whole, gb = sum(two[stage] for stage in STAGES), work.gigabytes
    print(f"{gb:.2f} GB of raw samples, {work.shape[1]} x {work.shape[0]} px x {work.frames} x 2")
    print("             1 thread  2 threads  ratio  share")
    for name, took in two.items():
        share = f"{took / whole:6.0%}" if name in STAGES else " limit"
        print(f"{name:10} {one[name]:8.1f} s {took:8.1f} s {one[name] / took:6.2f} {share}")
    print(f"allan and report together: {(two['allan'] + two['report']) / whole:.0%}")
    ratio = whole / (two["read"] + two["write"])
    print(f"whole: {whole:.1f} s, {gb / whole:.2f} GB/s, {ratio:.1f} times plain read and write")
    beside = size(work.run) / size(work.folder / "acq")
    print(f"on disk beside the FITS files: {beside:.2f} times as much as they")


def limits(work: Workload, threads: int) -> dict[str, float]:
    """Seconds to read the files, to write the cubes' samples again, and to copy as many bytes."""
    files = sorted((work.folder / "acq").rglob("*.fits"))
    copies = [COPIED for _ in range(int(1e9 * work.gigabytes / COPIED.nbytes))]
    return {
        "read": seconds(lambda: share_out(read_file, files, threads)),
        "write": write_again(work, threads),
        "copy": seconds(lambda: share_out(np.copy, copies, threads)),
    }


def every_stage(work: Workload, threads: int) -> dict[str, float]:
    """Seconds of each stage from the start."""
    if work.run.exists():
        # Not removed: the kernel would be busy with that for as long as the next stages run.
        work.run.rename(tempfile.mkdtemp(dir=work.folder))
    os.sync()
    here, acquisition = Runtime(workers=threads), work.folder / "acq"
    found = {}
    with ExitStack() as stack:
        # As `pixcal run` does.
        stack.enter_context(flushed_last(work.run))
        found["ingest"] = seconds(lambda: ingest.run(acquisition, work.run, ingest.Config(), here))
        for name, module in (("reduce", reduce), ("fit", fit), ("allan", allan)):
            found[name] = seconds(lambda module=module: module.run(work.run, module.Config(), here))  # type: ignore[misc]
        found["flush"] = seconds(stack.close)
    found["report"] = seconds(lambda: report.run(work.run, report.Config(), here))
    return found


def read_file(file: Path) -> None:
    """Read a file."""
    buffer = bytearray(4 << 20)
    with file.open("rb", buffering=0) as handle:
        while handle.readinto(buffer):
            pass


def write_again(work: Workload, threads: int) -> float:
    """Seconds to write the samples of the reduced cubes by the same writer; they are in memory."""
    took = 0.0
    for number, source in enumerate(work.sources):
        reader = ArrayReader(source.folder / "signal")
        columns = [source.ranges(tile) for tile in source.tiles()]
        target = work.folder / f"again-{number}"
        writer = create_array(target, reader.shape, reader.dtype)
        for n in range(0, len(columns), 16):
            blocks = [
                ((0, y[0], x[0]), reader.read((0, reader.shape[0]), y, x))
                for y, x in columns[n : n + 16]
            ]
            took += seconds(lambda: share_out(lambda at: writer.write(*at), blocks, threads))  # noqa: B023
        took += seconds(os.sync)
        shutil.rmtree(target)
    return took


def share_out(work: Callable[[Any], object], items: Sequence[Any], threads: int) -> None:
    """Apply a function to every item, in threads."""
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, items))


def size(folder: Path) -> int:
    """Bytes of the files below a folder."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


if __name__ == "__main__":
    main()
