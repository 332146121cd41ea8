"""Speed of ingest, reduce and fit against the barest scan of the same data: ``make bench``.

Scans and fits of one cube are interleaved in one run and reported as ratios, which depend less on
the machine. The scan decodes every chunk with the fit's own reader and adds its samples; a second
one adds them with their weights, by the fit's own kernel, which is the least that a fit needs.
``--full`` is ``make bench-full``: the whole detector, 46 Mpix x 64 frames x 2 sets, and a band of
it with 10,000 frames.
"""

import argparse
import shutil
import statistics
import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from workload import Workload, memory

DETECTOR = (5456, 8320)
FRAMES_OF_A_NIGHT = 10_000
BAND = (128, 1024)
PIXELS_OF_THE_NEXT = 1e9
CAMERA_GB_S = 2e-9 * DETECTOR[0] * DETECTOR[1] * 7
"""What the camera delivers at 7 Hz."""
LIMIT_MIB = 2048

Cost = tuple[float, float]
"""Seconds for each pixel, and for each sample."""


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=1024, help="pixels along each side")
    parser.add_argument("--frames", type=int, default=4000)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--full", action="store_true", help="the whole detector (50 GB of disk)")
    parser.add_argument("--folder", type=Path, help="where the data go; default: a temporary one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as scratch:
        if options.full:
            full(Path(scratch))
            return
        shape = (options.size, options.size)
        work = Workload(Path(scratch) / "main", shape, options.frames)
        rates(work, options.repeat)
        curve(Path(scratch), work)


def rates(work: Workload, repeat: int) -> None:
    """Rates of the stages, and the ratio of fit to scan time."""
    gb = work.gigabytes
    work.simulate()
    print(f"{gb:.2f} GB of raw samples: {work.shape[1]} x {work.shape[0]} px, {work.frames} frames")
    print(f"ingest {gb / work.ingest():.2f} GB/s, reduce {gb / work.reduce():.2f} GB/s")
    work.fit(2)
    times: dict[tuple[str, str], list[float]] = {}

    def take(state: str, threads: int) -> None:
        weighted = partial(work.scan, weighted=True)
        for name, go in (("scan", work.scan), ("weighted", weighted), ("fit", work.fit)):
            if state == "cold":
                work.chill()
            times.setdefault((f"{state}, {threads} threads", name), []).append(go(threads))

    for _ in range(repeat):
        for state, threads in (("warm", 1), ("warm", 2), ("cold", 2)):
            take(state, threads)
    for case in dict.fromkeys(case for case, _ in times):
        scans, least, fits = (times[case, name] for name in ("scan", "weighted", "fit"))
        ratios = [b / a for a, b in zip(scans, fits, strict=True)]
        floors = [b / a for a, b in zip(scans, least, strict=True)]
        print(
            f"{case}: scan {gb / statistics.median(scans):.2f} GB/s, "
            f"fit {gb / statistics.median(fits):.2f} GB/s, "
            f"fit / scan {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}); "
            f"weighted / plain scan {statistics.median(floors):.2f}"
        )
    one, two = times["warm, 1 threads", "fit"], times["warm, 2 threads", "fit"]
    gains = [a / b for a, b in zip(one, two, strict=True)]
    print(
        f"two threads against one: fit {statistics.median(gains):.2f} times as fast; "
        f"the camera delivers {CAMERA_GB_S:.2f} GB/s"
    )


def curve(scratch: Path, largest: Workload) -> None:
    """Time of the fit against pixels and frames, extrapolated to a night by a plane."""
    found = [(largest.shape, largest.frames, largest.fit(2))]
    for size, frames in ((256, 2000), (512, 200), (512, 2000), (1024, 200), (1024, 1000)):
        work = Workload(scratch / f"{size}-{frames}", (size, size), frames)
        work.simulate()
        work.ingest()
        work.reduce()
        work.fit(2)
        found.append((work.shape, frames, min(work.fit(2) for _ in range(2))))
        shutil.rmtree(work.folder)
    print("fit, two threads, warm:      px   frames        s   ns a sample   of a plane")
    cost, fixed = plane(found)
    for (ny, nx), frames, took in sorted(found):
        n = ny * nx
        expected = fixed + n * (cost[0] + cost[1] * frames)
        print(
            f"{'':22}{n:9,d} {frames:8,d} {took:8.2f} {1e9 * took / n / frames:13.2f} "
            f"{took / expected:12.2f}"
        )
    extrapolate(cost, fixed)


def plane(found: list[tuple[tuple[int, int], int, float]]) -> tuple[Cost, float]:
    """Seconds a pixel, a sample, and in all: least squares of relative deviations."""
    pixels = np.array([ny * nx for (ny, nx), _, _ in found], float)
    frames = np.array([f for _, f, _ in found], float)
    took = np.array([t for _, _, t in found])
    design = np.stack([pixels, pixels * frames, np.ones(len(took))], axis=1) / took[:, None]
    scale = np.linalg.norm(design, axis=0)
    a, b, c = np.linalg.lstsq(design / scale, np.ones(len(took)), rcond=None)[0] / scale
    return (float(a), float(b)), float(c)


def extrapolate(cost: Cost, fixed: float) -> None:
    """Arithmetic from the plane to a night, and to the next detector."""
    pixels = DETECTOR[0] * DETECTOR[1]
    print(
        f"plane: {fixed:.2f} s + {1e9 * cost[0]:.0f} ns a pixel + {1e9 * cost[1]:.2f} ns a sample"
    )
    for name, n, workers in (
        (f"{pixels / 1e6:.0f} Mpix on this machine", pixels, 1),
        ("1 Gpix on 16 such machines", PIXELS_OF_THE_NEXT, 16),
    ):
        took = fixed + n * (cost[0] + cost[1] * FRAMES_OF_A_NIGHT) / workers
        recorded = FRAMES_OF_A_NIGHT / 7
        print(
            f"  {name}, {FRAMES_OF_A_NIGHT:,d} frames: {took / 60:.0f} min a set "
            f"(recorded at 7 Hz in {recorded / 60:.0f} min)"
        )
    print(
        "  if the disk feeds it: warm, it takes compressed chunks at "
        f"{2 / (1e9 * cost[1]) / 1.25:.1f} GB/s a machine; tiles are independent, the rest is not"
        " counted"
    )


def full(scratch: Path) -> None:
    """Time and memory of each stage: the whole detector, and a band of it for a whole night."""
    for shape, frames in ((DETECTOR, 64), (BAND, FRAMES_OF_A_NIGHT)):
        work = Workload(scratch / f"{frames}", shape, frames, sets=2)
        gb, pixels = work.gigabytes, shape[0] * shape[1]
        print(f"{shape[1]} x {shape[0]} px x {frames} frames x 2 sets: {gb:.1f} GB of raw samples")
        print(f"simulate {gb / work.simulate():.2f} GB/s")
        for stage in ("ingest", "reduce", "fit", "allan", "report"):
            used = memory(stage, work.run)
            print(
                f"{stage}: {gb / used['seconds']:.2f} GB/s, {used['seconds']:.0f} s; peak "
                f"{used['peak'] / 2**20:.0f} MiB, planned {used['planned'] / 2**20:.0f}, "
                f"limit {LIMIT_MIB}"
            )
            if stage == "reduce":
                work.forget_frames()
        scans = work.scan(2)
        again = work.fit(2)
        print(
            f"warm, 2 threads: scan {gb / scans:.2f} GB/s; fit {again:.0f} s, "
            f"{1e9 * again / pixels / 2:.0f} ns a pixel and set"
        )
        shutil.rmtree(work.folder)


if __name__ == "__main__":
    main()
