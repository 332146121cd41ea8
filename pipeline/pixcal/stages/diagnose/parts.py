"""A part of an acquisition, as the camera wrote it, through the same stages as the whole.

The reality and every simulation of it are reduced and fitted by the same code: what differs between
them is not in how they were looked at.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.run import Runtime
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.acquisition import Acquisition
from pixcal.model.config import to_plain
from pixcal.stages import fit, reduce
from pixcal.stages.evidence import Part, load_evidence
from pixcal.stages.ingest.arrays import create, finish
from pixcal.stages.reduce.ingested import Ingested
from pixcal.storage.artefact import build, write_json

Frames = NDArray[Any]
Table = Mapping[str, list[Any]]


@dataclass(frozen=True)
class Half:
    """Some frames of every array of an acquisition.

    Attributes
    ----------
    frames : mapping
        Numbers of the frames (ascending) by name of the array, e.g. ``bias``, ``fringes/vertical``.
    """

    frames: Mapping[str, NDArray[np.intp]]


@dataclass(frozen=True)
class Raw:
    """Frames of a part of the window, in ADU.

    Attributes
    ----------
    acquisition : Acquisition
    arrays : mapping
        (t, y, x) by name of the array.
    tables : mapping
        What is known of each frame, in columns, as in ``frames.json``.
    reduction : reduce.Config
        How to reduce them.
    """

    acquisition: Acquisition
    arrays: Mapping[str, Frames]
    tables: Mapping[str, Table]
    reduction: reduce.Config

    @property
    def checksum(self) -> int:
        """Of all samples; however they are kept on the disk."""
        found = 0
        for name in sorted(self.arrays):
            found = crc32(np.ascontiguousarray(self.arrays[name]).data, found)
        return found


def groups(table: Table) -> list[NDArray[np.intp]]:
    """Numbers of the frames of each exposure time and lamp, in ascending order; unknown last."""
    exposures = np.array([np.inf if t is None else t for t in table["exptime_s"]], float)
    steps = np.array(table.get("step") or np.zeros(len(exposures)), int)
    pairs = sorted(set(zip(exposures.tolist(), steps.tolist(), strict=True)))
    return [np.flatnonzero((exposures == t) & (steps == step)) for t, step in pairs]


def take(
    ingested: Ingested,
    acquisition: Acquisition,
    half: Half,
    part: Part,
    reduction: reduce.Config,
) -> Raw:
    """Read a part of a run's frames."""
    arrays = {}
    for name, frames in half.frames.items():
        read = ingested.arrays[name].read((int(frames[0]), int(frames[-1]) + 1), *part)
        arrays[name] = read[frames - frames[0]]
    return Raw(acquisition, arrays, select(ingested.tables, half), reduction)


def select(tables: Mapping[str, Table], half: Half) -> dict[str, Table]:
    """Rows of the tables that belong to a half."""
    return {
        name: {key: [column[n] for n in frames] for key, column in tables[name].items()}
        for name, frames in half.frames.items()
    }


def evidence_of(raw: Raw, folder: Path, part: Part, window: tuple[int, int]) -> Evidence:
    """Reduce and fit a part, with straight fringes, and load what it tells.

    Parameters
    ----------
    raw : Raw
    folder : Path
        Empty; the run is made there.
    part : ((int, int), (int, int))
        Rows and columns of the window that the frames hold.
    window : (int, int)
        Rows and columns of the whole window.

    Raises
    ------
    InputError
        If the part cannot be reduced or fitted.
    """
    runtime = Runtime(cluster="sync")
    with build(folder, "ingest", 1, {}, {}) as made:
        facts = {}
        for name, frames in raw.arrays.items():
            writer = create(made.cubes, name, frames.shape, frames.dtype)
            writer.write((0, 0, 0), frames)
            facts[name] = finish(writer) | {"files": 1}
        write_json(made.folder / "acquisition.json", to_plain(raw.acquisition))
        write_json(made.folder / "frames.json", raw.tables)
        made.summary.update(arrays=facts, warnings=[])
    reduce.run(folder, raw.reduction, runtime)
    if raw.acquisition.frames.fringes:
        fit.run(folder, fit.Config(model="paraxial"), runtime, products=False)
    found = load_evidence(folder)
    origin = (part[0][0], part[1][0])
    return replace(
        found,
        origin=origin,
        fringes={
            name: replace(f, origin=origin, window=window) for name, f in found.fringes.items()
        },
    )
