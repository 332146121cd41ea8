"""Frames in memory, reduced and fitted by what the stages stream over, without a file."""

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from pixcal.engine.run import Runtime
from pixcal.model.acquisition import Acquisition
from pixcal.model.config import to_plain
from pixcal.model.options import Sweep
from pixcal.stages import reduce
from pixcal.stages.fit.fringe_set import fit_sets
from pixcal.stages.fit.maps import write_offsets
from pixcal.stages.fit.sweep import sweep_sets
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.reduce.stage import reduce_frames
from pixcal.storage.cube import CHUNK
from pixcal.storage.manifest import write_json
from pixcal.storage.memory import MemoryArray, MemoryBuild, MemoryPath

HERE = Runtime(cluster="sync", quiet=True)
NO_BATCHES = Sweep(batch_frames=1 << 40)


def run_in_memory(
    acquisition: Acquisition,
    frames: Mapping[str, NDArray[Any]],
    tables: Mapping[str, Mapping[str, list[Any]]],
    reduction: reduce.Config,
    sweep: Sweep = NO_BATCHES,
) -> MemoryPath:
    """A run of frames that are at hand, with straight fringes, as a run directory.

    Of ``frames`` (t, y, x), ADU, by name of the array (``bias``, ``fringes/vertical``), and of what
    is known of each, as in ``frames.json``. Its arrays are those of the stages; by default nothing
    is fitted to batches of frames.
    """
    run = MemoryPath()
    for name, samples in frames.items():
        (run / "ingest" / "raw.zarr" / name).keep(MemoryArray(samples, CHUNK, 0, {}))
    write_json(run / "ingest" / "acquisition.json", to_plain(acquisition))
    write_json(run / "ingest" / "frames.json", tables)
    reduced = MemoryBuild(run / "reduce")
    found = reduce_frames(reduced, Ingested(run / "ingest"), reduction, HERE)
    write_json(run / "reduce" / "reduce.json", found.noise(reduction))
    if acquisition.frames.fringes:
        cubes = run / "reduce" / "reduced.zarr"
        facts = sweep_sets(MemoryBuild(run / "sweep"), cubes, acquisition, sweep, HERE)
        fitted = fit_sets(run / "sweep", cubes, facts, acquisition, "paraxial")
        write_offsets(run / "fit" / "fit.zarr", fitted)
        vectors = {f.name: dict(zip(("kx", "ky"), f.vector, strict=True)) for f in fitted}
        write_json(run / "fit" / "fit.json", {"sets": vectors})
    return run
