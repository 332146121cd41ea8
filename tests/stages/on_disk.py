"""A run directory of frames in memory, by the stages, as if they had been ingested."""

from pathlib import Path

from pixcal.engine.run import Runtime
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.config import to_plain
from pixcal.stages import fit, reduce
from pixcal.stages.diagnose.parts import RawFrames
from pixcal.stages.evidence import load_evidence
from pixcal.storage.artefact import build
from pixcal.storage.cube import create_array
from pixcal.storage.manifest import write_json


def evidence_on_disk(raw: RawFrames, folder: Path) -> Evidence:
    """Reduce and fit frames in a run directory, and load what they tell."""
    runtime = Runtime(cluster="sync")
    with build(folder, "ingest", 1, {}, {}) as made:
        facts = {}
        for name, frames in raw.arrays.items():
            writer = create_array(made.cubes / "raw.zarr" / name, frames.shape, frames.dtype)
            writer.write((0, 0, 0), frames)
            writer.finish()
            facts[name] = {"shape": frames.shape, "dtype": frames.dtype.name, "files": 1}
        write_json(made.folder / "acquisition.json", to_plain(raw.acquisition))
        write_json(made.folder / "frames.json", raw.tables)
        made.summary.update(arrays=facts, warnings=[])
    reduce.run(folder, raw.reduction, runtime)
    if raw.acquisition.frames.fringes:
        fit.run(folder, fit.Config(model="paraxial"), runtime)
    return load_evidence(folder)
