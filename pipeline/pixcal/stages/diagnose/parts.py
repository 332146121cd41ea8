"""Reduce and fit a part of an acquisition by the same stages as the whole.

The same code reduces and fits the data and every simulation, so the processing causes no
difference between them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.run import Runtime
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.frame_order import runs
from pixcal.model.acquisition import Acquisition
from pixcal.model.arrays import Indices
from pixcal.model.config import to_plain
from pixcal.model.options import Sweep
from pixcal.stages import evidence, reduce
from pixcal.stages.fit.fringe_set import fit_sets
from pixcal.stages.fit.maps import write_offsets
from pixcal.stages.fit.sweep import sweep_sets
from pixcal.stages.reduce.black_cut_off import Black
from pixcal.stages.reduce.ingested import Ingested, begin_mjd
from pixcal.stages.reduce.stage import reduce_frames
from pixcal.stages.tiles import Part
from pixcal.storage.cube import CHUNK
from pixcal.storage.header_values import DAY_S
from pixcal.storage.manifest import write_json
from pixcal.storage.memory import MemoryArray, MemoryBuild, MemoryPath

Frames = NDArray[Any]
Table = Mapping[str, list[Any]]
# a subset of frames: their numbers (t,), ascending, by the name of the array, such as
# ``bias`` or ``fringes/vertical``
FrameSubset = Mapping[str, Indices]
SERIAL_RUNTIME = Runtime(cluster="sync", quiet=True)
NO_BATCHES = Sweep(batch_frames=1 << 40)


@dataclass(frozen=True)
class RawFrames:
    """Frames of a part of the window, in ADU."""

    acquisition: Acquisition
    arrays: Mapping[str, Frames]  # (t, y, x) by name of the array
    tables: Mapping[str, Table]  # properties of each frame, in columns, as in ``frames.json``
    reduction: reduce.Config  # how to reduce them
    black: Black | None = None  # known of the camera from the whole run

    @property
    def checksum(self) -> int:
        """Checksum of all samples, independent of how they are stored."""
        crc = 0
        for name in sorted(self.arrays):
            crc = crc32(np.ascontiguousarray(self.arrays[name]).data, crc)
        return crc


@dataclass(frozen=True)
class RunFrames:
    """The frames of a run without their samples."""

    acquisition: Acquisition
    tables: Mapping[str, Table]  # properties of all frames, as in ``frames.json``
    dtypes: Mapping[str, np.dtype[Any]]  # of the samples of each array
    reduction: reduce.Config  # how to reduce them
    black: Black | None = None  # known of the camera

    def raw(self, arrays: Mapping[str, Frames], half: FrameSubset) -> RawFrames:
        """Some of the frames, with their samples."""
        tables = select(self.tables, half)
        return RawFrames(self.acquisition, arrays, tables, self.reduction, self.black)


def take(ingested: Ingested, frames: RunFrames, half: FrameSubset, part: Part) -> RawFrames:
    """Read a part of a run's frames."""
    arrays = {}
    for name, numbers in half.items():
        array = ingested.arrays[name]
        arrays[name] = np.concatenate([array.read(run, *part) for run in runs(numbers)])
    return frames.raw(arrays, half)


def select(tables: Mapping[str, Table], half: FrameSubset) -> dict[str, Table]:
    """Rows of the tables that belong to a half, with the numbers of the frames."""
    chosen: dict[str, Table] = {}
    for name, frames in half.items():
        rows = {key: [column[n] for n in frames] for key, column in tables[name].items()}
        # In a cube, only the first plane may have a time stamp.
        if len(frames) and all(mjd is None for mjd in rows["mjd"]):
            begin = begin_mjd(tables[name]) + rows["time_s"][0] / DAY_S
            rows["mjd"][0] = float(begin) if np.isfinite(begin) else None
        chosen[name] = rows | {"frame": frames.tolist()}
    return chosen


def evidence_of(raw: RawFrames, part: Part, window: tuple[int, int]) -> Evidence:
    """Reduce and fit a part of a window, with straight fringes."""
    return evidence.evidence_of(
        run_in_memory(raw), black=raw.black, within=((part[0][0], part[1][0]), window)
    )


def run_in_memory(raw: RawFrames, sweep: Sweep = NO_BATCHES) -> MemoryPath:
    """A run directory of some frames, with straight fringes and by default without batches."""
    run, acquisition = MemoryPath(), raw.acquisition
    for name, samples in raw.arrays.items():
        (run / "ingest" / "raw.zarr" / name).keep(MemoryArray(samples, CHUNK, 0, {}))
    write_json(run / "ingest" / "acquisition.json", to_plain(acquisition))
    write_json(run / "ingest" / "frames.json", raw.tables)
    ingested = Ingested(run / "ingest", raw.black)
    reduction = reduce_frames(MemoryBuild(run / "reduce"), ingested, raw.reduction, SERIAL_RUNTIME)
    write_json(run / "reduce" / "reduce.json", reduction.noise(raw.reduction))
    if acquisition.frames.fringes:
        cubes = run / "reduce" / "reduced.zarr"
        facts = sweep_sets(MemoryBuild(run / "sweep"), cubes, acquisition, sweep, SERIAL_RUNTIME)
        fitted = fit_sets(run / "sweep", cubes, facts, acquisition, "paraxial")
        write_offsets(run / "fit" / "fit.zarr", fitted)
        vectors = {f.name: dict(zip(("kx", "ky"), f.vector, strict=True)) for f in fitted}
        write_json(run / "fit" / "fit.json", {"sets": vectors})
    return run
