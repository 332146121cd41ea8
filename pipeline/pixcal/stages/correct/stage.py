"""The fit with a diagnosis: correct identified effects where possible.

The ordinary fit and its products stay unchanged. Effects on samples are corrected in a second sweep
of the cube; effects on maps are corrected on the maps of the sweep. The code of the fit then fits
the shapes of the fringes and combines the sets.
"""

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from pixcal import __version__
from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.acquisition import Acquisition
from pixcal.model.errors import InputError
from pixcal.model.options import Fit as Config
from pixcal.model.options import Sweep
from pixcal.simulation.effect import Effect
from pixcal.stages import fit
from pixcal.stages.correct.correct_maps import correct_sweep, sides_of
from pixcal.stages.correct.gain import MapsOfSets, excess, measure_gain, worsened
from pixcal.stages.correct.sweep_to_correct import RestoredSet, Swept
from pixcal.stages.correct.uncertainty import parameter_errors
from pixcal.stages.diagnose.diagnosis_input import ESTIMATE_BYTES, EVIDENCE_BYTES
from pixcal.stages.diagnose.windows import chosen_windows
from pixcal.stages.evidence import load_evidence
from pixcal.stages.fit.fringe_set import SetWithShape, describe, fit_set
from pixcal.stages.fit.maps import Totals, write_maps
from pixcal.stages.fit.stage import Header, header_of, publish_maps, published
from pixcal.stages.fit.sweep import load_run, sweep_set
from pixcal.stages.fitted_shape import nominal_vector
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.reduced_set import ReducedSet
from pixcal.stages.tiles import Part
from pixcal.stages.treatment import HYPERBOLIC, SUFFIX, Treatment, Treatments, treatments_of
from pixcal.storage.artefact import Build
from pixcal.storage.cube import create_group
from pixcal.storage.formats import STAGES
from pixcal.storage.lock import lock
from pixcal.storage.manifest import Manifest, read_json, write_json
from pixcal.storage.stage import make, require

Json = dict[str, Any]
SAMPLES = 5_000_000  # samples of each fringe set in memory at a time


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Fit a run, and again with the effects of its diagnosis corrected: ``RUN/corrected``."""
    diagnosed = require(run_dir, "diagnose")
    fitted = fit.run(run_dir, config, runtime)
    models = {name: facts["model"] for name, facts in fitted.summary["sets"].items()}
    plan = treatments_of(run_dir, config.model, models, config.own)
    plain: Json = {
        "own": [hashlib.sha256(path.read_bytes()).hexdigest() for path in config.own],
        "effects": [t.plain for t in plan.every],
    }
    inputs = {"fit": fitted.key, "diagnose": diagnosed.key}
    with lock(run_dir):
        body = partial(_correct, run_dir, plan, runtime)
        there = partial(published, run_dir, "corrected", "correction.json", SUFFIX)
        publish = partial(_publish, run_dir)
        return make(
            run_dir, STAGES["corrected"], plain, inputs, body, publish=publish, published=there
        )


def attempt(run_dir: Path, config: Config, runtime: Runtime) -> str | None:
    """As `run`, but if correction is impossible, return the reason and remove stale maps."""
    try:
        run(run_dir, config, runtime)
    except (InputError, ArithmeticError, LookupError, MemoryError, ValueError) as error:
        publish_maps(run_dir, run_dir / "corrected" / "corrected.zarr", (), ([], []), SUFFIX)
        (run_dir / "products" / "correction.json").unlink(missing_ok=True)
        return str(error) or type(error).__name__
    return None


def _correct(run_dir: Path, plan: Treatments, runtime: Runtime, made: Build) -> None:
    before = read_json(run_dir / "fit" / "fit.json")
    plan = remeasured(run_dir, plan, runtime)
    result: Json = {
        "schema": "pixcal/correction/2",
        "pixcal": __version__,
        "input": before["input"],
        "verdict": read_json(run_dir / "diagnose" / "diagnosis.json")["verdict"],
        "effects": [t.plain for t in plan.every],
        "outputs": [],
        "sets": {},
        "pairs": [],
        "sets_chi2_reduced": None,
    }
    if plan.corrected or plan.curved:
        result |= _corrected_maps(run_dir, made, plan, runtime)
    write_json(made.folder / "correction.json", result)
    made.summary = {"outputs": result["outputs"], "corrected": list(plan.corrected)}


def _corrected_maps(run_dir: Path, made: Build, plan: Treatments, runtime: Runtime) -> Json:
    before, acquisition = read_json(run_dir / "fit" / "fit.json"), load_run(run_dir)
    for old in (made.scratch / "corrected", made.folder / "corrected.zarr"):
        shutil.rmtree(old, ignore_errors=True)
    create_group(made.scratch / "corrected")
    swept, facts = _swept_sets(run_dir, made, plan, acquisition, runtime)
    model = HYPERBOLIC if plan.curved else before["model"]
    fitted, left = [], {}
    sides = sides_of([*swept.values()])
    sets = {name: replace(closed, open_sides=sides) for name, closed in swept.items()}
    for name, opened in sets.items():
        left[name] = parameter_errors(opened, runtime)
        target = made.scratch / "corrected" / name
        correct_sweep(opened, target, runtime, name)
        fitted.append(fit_set(target, opened.source, facts[name], acquisition, model))
    group = made.folder / "corrected.zarr"
    totals = write_maps(group, fitted, runtime)
    axes = {name: tuple(before["sets"][name]["axis"]) for name in sets}
    maps = MapsOfSets(run_dir / "fit" / "fit.zarr", group, sets, axes)
    gain = measure_gain(maps, runtime)
    if worse := worsened(gain["sets"], gain["pairs"]):
        raise InputError(
            f"{run_dir}: correction refused: {worse}; use the maps as fitted, and record a "
            "second baseline along each axis to measure the effect better"
        )
    larger = {name: excess(facts) for name, facts in gain["sets"].items()}
    if max(larger.values()) > 1:
        fitted = [replace(f, excess=larger[f.name]) for f in fitted]
        totals = write_maps(group, fitted, runtime)
        gain = measure_gain(maps, runtime)
    return {
        "outputs": list(totals.outputs),
        "model": model,
        "open_sides": dict(zip(("top", "bottom", "left", "right"), sides, strict=True)),
        "sets": {
            f.name: _of_set(f, totals, gain["sets"][f.name], before["sets"][f.name], plan)
            | {"parameter_error_px": left[f.name], "sigma_enlarged": larger[f.name]}
            for f in fitted
        },
        "pairs": gain["pairs"],
        "sets_chi2_reduced": {"before": before["sets_chi2_reduced"], "after": totals.consistency},
    }


def _swept_sets(
    run_dir: Path, made: Build, plan: Treatments, acquisition: Acquisition, runtime: Runtime
) -> tuple[dict[str, Swept], Mapping[str, Json]]:
    """Sweeps to correct and their summaries: those of the fit, unless samples are corrected."""
    of_fit, ingested = require(run_dir, "sweep"), Ingested(run_dir / "ingest")
    reduced, calibration = (run_dir / "reduce" / f"{n}.zarr" for n in ("reduced", "calibration"))
    noise = float(read_json(run_dir / "reduce" / "reduce.json")["read_noise_e"]["used"])
    group = run_dir / "sweep" / "sweep.zarr"
    flat = calibration / "flat" if acquisition.frames.flat else None
    again, facts, sets = replace(made, folder=made.scratch), dict(of_fit.summary["sets"]), {}
    if plan.on_samples:
        create_group(made.scratch / "sweep.zarr")
    for name, of_set in read_json(run_dir / "fit" / "fit.json")["sets"].items():
        exptime_s = ingested.exposures.fringes[f"fringes/{name}"]
        folder = group / name
        if plan.on_samples:
            source = RestoredSet(reduced / name, plan.on_samples, calibration, exptime_s)
            nominal, config = nominal_vector(acquisition, name), Sweep(**of_fit.config)
            facts[name] = sweep_set(again, source, nominal, config, runtime)
            folder = made.scratch / "sweep.zarr" / name
        sets[name] = Swept(
            folder,
            ReducedSet(reduced / name),
            plan.on_maps,
            (float(of_set["kx"]), float(of_set["ky"])),
            flat,
            noise,
            plan.on_samples,
            group / name,
            float(np.median(exptime_s)),
        )
    return sets, facts


def _of_set(
    fitted: SetWithShape, totals: Totals, gain: Json, before: Json, plan: Treatments
) -> Json:
    """Entry of a set in ``correction.json``."""
    masked, sigma_px = totals.sets[fitted.name]
    by_effect = dict(
        zip((t.effect.name for t in plan.on_maps), gain.pop("change_by_effect"), strict=True)
    )
    on_samples = gain.pop("change_on_samples")
    if plan.on_samples:
        # Effects on samples are corrected together, in one sweep.
        by_effect[" and ".join(e.name for e in plan.on_samples)] = on_samples
    after = describe(fitted, masked, sigma_px)
    return gain | {
        "change_by_effect": by_effect,
        "sigma_median_px": {"before": before["sigma_median_px"], "after": sigma_px},
        "chi2_reduced": {"before": before["chi2_reduced"], "after": after["chi2_reduced"]},
        "fit": after,
    }


def _publish(run_dir: Path) -> None:
    """Write the products; only ``correction.json`` if there is nothing to correct."""
    folder = run_dir / "corrected"
    result = read_json(folder / "correction.json")
    header: Header = [], []
    if result["outputs"]:
        fits = {name: facts["fit"] for name, facts in result["sets"].items()}
        key = read_json(folder / "manifest.json")["key"]
        header = cards, history = header_of(run_dir, result | {"sets": fits}, key)
        freed = [e for e in result["effects"] if e["treatment"].startswith("corrected on")]
        cards.append(("NEFFECT", len(freed), "effects corrected"))
        for n, effect in enumerate(freed, start=1):
            cards.append((f"EFFECT{n}", effect["effect"], "effect corrected"))
            parameters = json.dumps(effect["parameters"])
            history.append(f"{effect['effect']}: {effect['treatment']}: {parameters}")
    publish_maps(run_dir, folder / "corrected.zarr", result["outputs"], header, SUFFIX)
    write_json(run_dir / "products" / "correction.json", result)


# Effects remeasured on all frames, because the diagnosis fits half of them


def remeasured(run_dir: Path, plan: Treatments, runtime: Runtime) -> Treatments:
    """The same treatments, with effects on maps remeasured on all frames where possible."""
    # If memory does not suffice, effects stay as the diagnosis measured them.
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
        # Frames are missing or too large: the diagnosis's values are valid, only less precise.
        return plan
    return Treatments(tuple(refined.get(t.effect.name, t) for t in plan.every))


def _again(treatment: Treatment, parts: Iterator[Evidence]) -> Treatment:
    estimate = treatment.effect.measured_again(parts)
    if estimate is None:
        return treatment
    return replace(
        treatment,
        effect=estimate.effect,
        errors=estimate.errors,
        why=f"{treatment.why}; {estimate.why}",
        covariance=estimate.covariance,
    )


def _parts(run_dir: Path, runtime: Runtime) -> Iterator[Evidence]:
    """Evidence of successive parts of the frames, in the window to which effects are fitted."""
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
