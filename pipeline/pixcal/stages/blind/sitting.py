"""``pixcal blind run``: every case is ingested, reduced and diagnosed; the truth is not needed."""

import shutil
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.errors import ClusterError
from pixcal.stages import diagnose, ingest, reduce
from pixcal.stages.blind.paper import RUNS, read_paper
from pixcal.storage.artefact import write_json

DIAGNOSIS = Path("products/diagnosis.json")
FAILED = "failed.json"
LARGE = ("ingest", "reduce", "sweep", "fit")
"""Artefacts that are removed once a case is diagnosed."""


@dataclass(frozen=True)
class RunConfig:
    """Options of the command.

    Attributes
    ----------
    again : bool
        Diagnose anew what was diagnosed.
    keep : bool
        Keep the runs whole, not the products alone.
    """

    again: bool = False
    keep: bool = False


def run(folder: Path, config: RunConfig, runtime: Runtime) -> tuple[int, int]:
    """Diagnose the cases of a folder; those that were diagnosed before are skipped.

    Returns
    -------
    (int, int)
        Cases that were diagnosed now, and those that could not be.

    Raises
    ------
    InputError
        If the folder holds no examination.
    """
    paper = read_paper(folder)
    pending = [
        (name, left_out)
        for name, left_out in zip(paper.cases, paper.without, strict=True)
        if config.again or not (folder / RUNS / name / DIAGNOSIS).is_file()
    ]
    each = _share(runtime, len(pending))
    failed = run_tasks(partial(_case, folder, config, each), pending, runtime, label="diagnose")
    return len(pending), sum(failed)


def _share(runtime: Runtime, cases: int) -> Runtime:
    """What a case gets: all for a single one, else one core, and memory in equal parts."""
    if cases <= 1:
        return replace(runtime, quiet=True)
    return Runtime("sync", memory=runtime.memory // min(runtime.n_workers, cases))


def _case(folder: Path, config: RunConfig, runtime: Runtime, item: tuple[str, str]) -> bool:
    """Diagnose a case; gives whether that failed.

    Whatever breaks the diagnosis is a case answered wrong, and no end of the examination.
    """
    name, left_out = item
    run_dir = folder / RUNS / name
    if config.again:
        shutil.rmtree(run_dir, ignore_errors=True)
    run_dir.mkdir(parents=True, exist_ok=True)
    try:
        ingest.run(folder / name, run_dir, ingest.Config(), runtime)
        reduce.run(run_dir, reduce.Config(), runtime)
        diagnose.run(run_dir, diagnose.Config(without=(left_out,)), runtime)
    except (ClusterError, OSError, MemoryError):
        raise
    except Exception as error:
        facts = {"error": f"{type(error).__name__}: {error}", "where": traceback.format_exc()}
        write_json(run_dir / FAILED, facts)
        return True
    (run_dir / FAILED).unlink(missing_ok=True)
    if not config.keep:
        _clear(run_dir, LARGE)
    return False


def _clear(run_dir: Path, names: Sequence[str]) -> None:
    for name in names:
        shutil.rmtree(run_dir / name, ignore_errors=True)
