"""``pixcal blind run``: ingest, reduce and diagnose every case, without the truth.

Its offset maps are fitted, and corrected for the diagnosed causes. Products are kept, large files
removed.
"""

import math
import shutil
import time
import traceback
from dataclasses import replace
from functools import partial
from pathlib import Path

from blind_examination.benches import LAYOUTS, MAX_SETS
from blind_examination.manifest import RUNS, read_manifest
from blind_examination.options import RunConfig
from pixcal.engine.plan import BASE_BYTES, make_plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.code import code_digest
from pixcal.model.errors import ClusterError, DamagedError, PlanError
from pixcal.stages import correct, diagnose, ingest, reduce
from pixcal.stages.diagnose.diagnosis_input import ESTIMATE_BYTES, EVIDENCE_BYTES
from pixcal.storage.manifest import read_json, write_json

PRODUCTS = "products"
DIAGNOSIS = Path(PRODUCTS) / "diagnosis.json"
FAILED = "failed.json"
# for a finished case: version of the code, duration, and reason if there are no maps
DONE = "done.json"
BEGUN = "begun.json"  # for a case in progress: version of the code
MIN_BYTES = 1 << 30  # of a case on a cluster, whose workers have their own limits
# artefacts that are removed once a case is diagnosed
LARGE = ("ingest", "reduce", "sweep", "fit", "corrected")


def run(folder: Path, config: RunConfig, runtime: Runtime) -> tuple[int, int]:
    """Diagnose the cases of a folder, except those diagnosed before; numbers of cases and failures.

    InputError if the folder has no examination, PlanError if a case does not fit the memory.
    """
    manifest = read_manifest(folder)
    pending = [
        (name, left_out)
        for name, left_out in zip(manifest.cases, manifest.without, strict=True)
        if config.again or not (folder / RUNS / name / DONE).is_file()
    ][: config.limit]
    over, each = share("diagnosing a case", manifest.size, len(pending), runtime)
    diagnose_case = partial(_case, folder, config, code_digest(), each)
    return len(pending), sum(run_tasks(diagnose_case, pending, over, label="diagnose"))


def share(what: str, size: str, cases: int, runtime: Runtime) -> tuple[Runtime, Runtime]:
    """Runtime for all cases, and for each, which has one core and a share of the memory.

    ``what``: name of the work, for messages. PlanError if not even one case fits the memory.
    """
    layout = LAYOUTS[size]
    half = math.prod(layout.shape) * -(-layout.frames // 2)
    need = half * (ESTIMATE_BYTES + MAX_SETS * EVIDENCE_BYTES)
    plan = make_plan(what, need, 0, runtime)
    over = runtime.with_workers(plan.workers)
    if runtime.remote:
        return over, Runtime("sync", memory=BASE_BYTES + max(need, MIN_BYTES))
    if min(cases, plan.workers) <= 1:
        return over, replace(runtime, quiet=True)
    memory = (runtime.memory - BASE_BYTES) // min(cases, plan.workers)
    # Each process has its own interpreter; threads share one.
    return over, Runtime("sync", memory=memory + BASE_BYTES * (runtime.cluster == "threads"))


def _case(
    folder: Path, config: RunConfig, code: str, runtime: Runtime, item: tuple[str, str]
) -> bool:
    """Diagnose a case; returns whether it failed.

    A failed diagnosis is a wrong answer, and does not end the examination.
    """
    name, left_out = item
    run_dir = folder / RUNS / name
    # Do not continue the work of another version: a case belongs to one version.
    if config.again or _begun_by(run_dir) != code:
        shutil.rmtree(run_dir, ignore_errors=True)
    run_dir.mkdir(parents=True, exist_ok=True)
    write_json(run_dir / BEGUN, {"code": code})
    start, without_maps = time.perf_counter(), ""
    try:
        ingest.run(folder / name, run_dir, ingest.Config(), runtime)
        reduce.run(run_dir, reduce.Config(), runtime)
        diagnose.run(run_dir, diagnose.Config(without=(left_out,)), runtime)
    except (ClusterError, PlanError, OSError, MemoryError):
        raise
    except Exception as error:
        facts = {"error": f"{type(error).__name__}: {error}", "where": traceback.format_exc()}
        write_json(run_dir / FAILED, facts)
        without_maps = "not diagnosed"
    diagnosed = time.perf_counter()
    if not (failed := bool(without_maps)):
        without_maps = _fit_maps(run_dir, runtime)
        for name in () if config.keep else LARGE:
            shutil.rmtree(run_dir / name, ignore_errors=True)
    seconds = {"diagnosis": diagnosed - start, "maps": time.perf_counter() - diagnosed}
    rounded = {what: round(value, 1) for what, value in seconds.items()}
    write_json(run_dir / DONE, {"code": code, "seconds": rounded, "no_maps": without_maps})
    return failed


def _begun_by(run_dir: Path) -> str | None:
    """Version of the code that began a case, if known."""
    try:
        return str(read_json(run_dir / BEGUN)["code"])
    except (DamagedError, FileNotFoundError, LookupError, TypeError):
        return None


def _fit_maps(run_dir: Path, runtime: Runtime) -> str:
    """Make the offset maps, as fitted and as corrected; returns the reason if there are none."""
    try:
        correct.run(run_dir, correct.Config(), runtime)
    except (ClusterError, PlanError, OSError, MemoryError):
        raise
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""
