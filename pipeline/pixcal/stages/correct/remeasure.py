"""Effects remeasured for the correction on all frames; the diagnosis fits half of them."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect
from pixcal.stages.diagnose.look import ESTIMATE_BYTES, EVIDENCE_BYTES
from pixcal.stages.diagnose.windows import chosen_windows
from pixcal.stages.evidence import Part, load_evidence
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.treatment import Treatment, Treatments

SAMPLES = 5_000_000  # of each fringe set that are in memory at a time


def remeasured(run_dir: Path, plan: Treatments, runtime: Runtime) -> Treatments:
    """The same treatments, with effects on maps remeasured on all frames where possible."""
    # Where the memory does not suffice, effects stay as the diagnosis found them.
    chosen = [
        t
        for t in plan.every
        if t.how == "corrected on maps"
        and t.origin == "diagnosis"
        and type(t.effect).measured_again is not Effect.measured_again
    ]
    if not chosen:
        return plan
    try:
        refined = {t.effect.name: _again(t, _parts(run_dir, runtime)) for t in chosen}
    except (InputError, FileNotFoundError, np.linalg.LinAlgError):
        # Frames are missing, or too large: what the diagnosis found is good, only less precise.
        return plan
    return Treatments(tuple(refined.get(t.effect.name, t) for t in plan.every))


def _again(treatment: Treatment, parts: Iterator[Evidence]) -> Treatment:
    estimate = treatment.effect.measured_again(parts)
    if estimate is None:
        return treatment
    covariance = estimate.details.get("covariance")
    return replace(
        treatment,
        effect=estimate.effect,
        errors=estimate.errors,
        why=f"{treatment.why}; {estimate.why}",
        covariance=None if covariance is None else np.asarray(covariance, float),
    )


def _parts(run_dir: Path, runtime: Runtime) -> Iterator[Evidence]:
    """Frames in turn, of the window that effects are fitted on."""
    ingested = Ingested(run_dir / "ingest")
    part: Part = chosen_windows(ingested.shape)[0]
    pixels = (part[0][1] - part[0][0]) * (part[1][1] - part[1][0])
    counts = [len(t["time_s"]) for name, t in ingested.tables.items() if "/" in name]
    if not counts:
        return
    frames = max(1, SAMPLES // pixels)
    number = min(4, -(-min(counts) // frames))
    samples = min(frames, min(counts)) * pixels
    held = EVIDENCE_BYTES * samples * len(counts)
    make_plan("remeasuring effects", ESTIMATE_BYTES * samples, held, runtime)
    ends = np.linspace(0, min(min(counts), number * frames), number + 1).astype(int)
    for first, last in pairwise(ends.tolist()):
        evidence = load_evidence(run_dir, part, slice(first, last))
        yield evidence if first == 0 else replace(evidence, stacks=())
        del evidence  # one at a time
