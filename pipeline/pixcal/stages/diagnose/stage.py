"""``pixcal diagnose``: where data and simulation differ, which effect causes it, what remains.

The frames are parted: on the first half effects are fitted, on the second they are tried. Both the
data and every simulation of them are reduced and fitted by the same stages.
"""

import hashlib
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from pixcal.effects import known_effects, parse_effects
from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.evidence import Evidence
from pixcal.estimators.gap import Reference, compare, expect_nominal, expect_with
from pixcal.model.acquisition import Acquisition
from pixcal.model.bench import load_bench
from pixcal.model.config import parse, quantity, to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, Estimate
from pixcal.stages import reduce
from pixcal.stages.diagnose.deciding import missing_frames
from pixcal.stages.diagnose.measuring import nominal_bench
from pixcal.stages.diagnose.parts import Half, evidence_of, take
from pixcal.stages.diagnose.result import by_domain, describe
from pixcal.stages.diagnose.search import CONFIRM, SCREEN, SURE, Candidate, Found, Search
from pixcal.stages.diagnose.trial import (
    Curves,
    Effects,
    Trials,
    Window,
    averaged,
    estimate,
    looked_at,
)
from pixcal.stages.diagnose.windows import chosen_windows, split, whole_of
from pixcal.stages.evidence import Part
from pixcal.stages.reduce.ingested import Ingested
from pixcal.storage.artefact import (
    Manifest,
    artefact_key,
    build,
    lock,
    read_json,
    require,
    up_to_date,
    write_json,
)

FORMAT = 3
REFERENCES = 16
"""Simulations of the nominal bench."""
EVIDENCE_BYTES = 34
"""Evidence in memory and the run that it is made of, for each sample of all fringe sets (measured,
as the next two)."""
LOOK_BYTES = 50
"""What the statistics of one set need beside it, for each sample of the largest set."""
ESTIMATE_BYTES = 130
"""What the hungriest estimate, that of crosstalk, needs beside it."""
LEARN_SEED = 900_000
CLEAR = 20.0
"""Standard deviations from which an effect whose estimate is slow is left to the battery."""
FEWEST_FRAMES = 24
"""Fringe frames in each half."""


@dataclass(frozen=True)
class Config:
    """Options of the diagnosis.

    Attributes
    ----------
    only, without : tuple of str
        Candidates: these alone, or all but these.
    own : tuple of Path
        Files that each hold an effect of the user's own.
    nominal : Path, optional
        Bench file whose effects the nominal bench has from the start.
    """

    only: tuple[str, ...] = quantity((), doc="candidates")
    without: tuple[str, ...] = quantity((), doc="not candidates")
    own: tuple[Path, ...] = ()
    nominal: Path | None = None


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Diagnose a reduced run: make ``RUN/diagnose`` and the product ``diagnosis.json``.

    Raises
    ------
    InputError
        If the run was not reduced, a name of an effect is unknown, or the frames cannot be fitted.
    """
    reduced = require(run_dir, "reduce", 1)
    known = known_effects(config.own)
    kinds = _kinds(config, known)
    base = _base(config.nominal, known)
    plain = {
        "effects": sorted(kinds),
        "own": [hashlib.sha256(path.read_bytes()).hexdigest() for path in config.own],
        "nominal": {e.name: to_plain(e) for e in base},
    }
    with lock(run_dir):
        inputs = {"reduce": reduced.key}
        key = artefact_key("diagnose", FORMAT, plain, inputs)
        done = up_to_date(run_dir, "diagnose", key)
        if done is None:
            with build(run_dir, "diagnose", FORMAT, plain, inputs) as made:
                scratch = made.folder / "scratch"
                scratch.mkdir(exist_ok=True)
                for unfinished in (p for p in scratch.iterdir() if p.is_dir()):
                    shutil.rmtree(unfinished, ignore_errors=True)
                diagnosis, curves = _diagnose(run_dir, kinds, base, scratch, runtime)
                shutil.rmtree(scratch, ignore_errors=True)
                write_json(made.folder / "diagnosis.json", diagnosis)
                write_json(made.folder / "curves.json", curves)
                made.summary.update(
                    verdict=diagnosis["verdict"],
                    causes=[cause["effect"] for cause in diagnosis["causes"]],
                )
        product = run_dir / "products" / "diagnosis.json"
        product.parent.mkdir(exist_ok=True)
        write_json(product, read_json(run_dir / "diagnose" / "diagnosis.json"))
        return require(run_dir, "diagnose", FORMAT)


def _kinds(config: Config, known: Mapping[str, type[Effect]]) -> dict[str, type[Effect]]:
    """The candidates by name."""
    for name in (*config.only, *config.without):
        if name not in known:
            raise InputError(
                f"--effects {name!r:.80}: unknown effect; known are {', '.join(known)}"
            )
        if name in config.only and name in config.without:
            raise InputError(
                f"--effects: {name} is a candidate and left out; write either '{name}' or '-{name}'"
            )
    kinds = {
        name: kind
        for name, kind in known.items()
        if (not config.only or name in config.only) and name not in config.without
    }
    if not kinds:
        raise InputError("--effects: every effect is left out; keep at least one as a candidate")
    return kinds


def _base(nominal: Path | None, known: Mapping[str, type[Effect]]) -> Effects:
    """Effects that the nominal bench has from the start."""
    if nominal is None:
        return ()
    bench = load_bench(nominal)
    found = list(parse_effects(bench.effects, str(nominal), known))
    if bench.optics.fringes == "exact":
        found.append(parse_effects({"hyperbolic_fringes": {}}, str(nominal))[0])
    return tuple(found)


def _diagnose(
    run_dir: Path,
    kinds: Mapping[str, type[Effect]],
    base: Effects,
    scratch: Path,
    runtime: Runtime,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    candidates: dict[str, Candidate] = {}
    signatures: tuple[type[Effect], ...] = ()

    def learnt(evidence: Evidence, few: Runtime) -> tuple[type[Effect], ...]:
        nonlocal signatures
        candidates.update(_candidates(evidence, kinds, base, few))
        signatures = weakly_seen(candidates, kinds)
        return signatures

    look = look_at(run_dir, scratch, runtime, learnt)
    estimates = {n: c.estimate for n, c in candidates.items() if c.estimate is not None}
    trials = Trials(look.windows, scratch, look.runtime, signatures, estimates, SCREEN)
    (nominal,) = trials.curves([base], REFERENCES, "nominal bench")
    if isinstance(nominal, str):
        raise InputError(f"--nominal: {nominal}")
    reference = Reference.of(nominal)
    data = reference.on_scale(look.measured)

    def again(on: Effects, names: Sequence[str]) -> dict[str, float]:
        """Significance of candidates on the first frames taken again with some effects."""
        window = look.first
        evidence = window.evidence(window.learn, (*base, *on), LEARN_SEED, scratch)
        found = _estimates(evidence, {n: kinds[n] for n in names}, look.few, "estimate again")
        return {n: e.significance for n, e in found.items() if isinstance(e, Estimate)}

    search = Search(
        reference,
        data,
        lambda benches, seeds, label: trials.curves(
            [(*base, *bench) for bench in benches], seeds, label
        ),
        again,
    )
    found = search.run(candidates)
    return describe(
        found, data, look.measured, reference, look.facts, _places(look, trials, base, found)
    )


def _places(look: "Look", trials: Trials, base: Effects, found: Found) -> list[dict[str, Any]]:
    """How far each window is off by itself, unless one is all there is."""
    if len(look.windows) == 1 and look.windows[0].part == whole_of(look.windows[0].whole):
        return []
    places = []
    for number, window in enumerate(look.windows):
        own = Reference.of(trials.of_window(number, base, REFERENCES))
        data = own.on_scale(look.each[number])
        nominal = compare(data, expect_nominal(own))
        final = nominal
        if found.taken:
            bench = (*base, *found.final.effects)
            final = compare(data, expect_with(own, trials.of_window(number, bench, CONFIRM)))
        places.append({"window": _plain_part(window.part), "domains": by_domain(nominal, final)})
    return places


@dataclass(frozen=True)
class Look:
    """What is looked at.

    Attributes
    ----------
    first : Window
        That effects are fitted on.
    windows : tuple of Window
        That they are tried on.
    each : tuple of mapping
        Curves of the test frames of each window.
    measured : mapping
        Their mean.
    facts : dict
        What is told of it.
    runtime, few : Runtime
        With as many workers as fit the memory: of simulations, and of estimates.
    """

    first: Window
    windows: tuple[Window, ...]
    each: tuple[Curves, ...]
    measured: Curves
    facts: dict[str, Any]
    runtime: Runtime
    few: Runtime


def look_at(
    run_dir: Path,
    scratch: Path,
    runtime: Runtime,
    learnt: Callable[[Evidence, Runtime], Sequence[type[Effect]]] = lambda *_: (),
) -> Look:
    """Take the parts of a reduced run that are looked at, and measure their nominal bench.

    Parameters
    ----------
    run_dir, scratch : Path
    runtime : Runtime
    learnt : callable
        Is given the evidence that effects are fitted on, and how to run estimates in the memory
        that there is; tells whose estimates are statistics too.

    Raises
    ------
    InputError
        If there are too few frames, or a part cannot be fitted.
    """
    ingested = Ingested(run_dir / "ingest")
    file = run_dir / "ingest" / "acquisition.json"
    acquisition = parse(Acquisition, read_json(file), str(file))
    reduction = _reduction(run_dir)
    shape = ingested.shape
    first, parts = chosen_windows(shape)
    pixels = (first[0][1] - first[0][0]) * (first[1][1] - first[1][0])
    own = split(ingested.tables, pixels)
    _enough(own.test)
    largest, evidence = _samples(own.test, pixels)
    need = EVIDENCE_BYTES * evidence + LOOK_BYTES * largest
    estimates = ESTIMATE_BYTES * largest
    for_estimates = make_plan("diagnose", estimates, EVIDENCE_BYTES * evidence, runtime)
    plan = make_plan("diagnose", need, 0, runtime)
    few = runtime.with_workers(for_estimates.workers)
    runtime = runtime.with_workers(plan.workers)
    dtypes = {name: array.dtype for name, array in ingested.arrays.items()}
    windows: list[Window] = []
    measured: list[Curves] = []
    signatures: tuple[type[Effect], ...] = ()
    seed: int | None = None
    for part in dict.fromkeys((first, *parts)):
        halves: list[Evidence] = []
        for half in (own.learn, own.test):
            folder = scratch / f"data-{len(windows)}-{len(halves)}"
            raw = take(ingested, acquisition, half, part, reduction)
            seed = raw.checksum if seed is None else seed
            try:
                halves.append(evidence_of(raw, folder, part, shape))
            except InputError as error:
                which = ("first", "second")[len(halves)]
                reason = str(error).replace(f"{folder}: ", "")
                raise InputError(f"{run_dir}: the {which} half of its frames: {reason}") from error
            shutil.rmtree(folder)
        if not windows:
            signatures = tuple(learnt(halves[0], few))
        bench = nominal_bench(
            acquisition, ingested.tables, halves, (own.learn, own.test), reduction, dtypes
        )
        assert seed is not None
        windows.append(Window(part, bench, own.learn, own.test, shape, seed))
        if part in parts:
            measured.append(looked_at(halves[1], signatures))
    return Look(
        windows[0],
        tuple(w for w in windows if w.part in parts),
        tuple(measured),
        averaged(measured),
        {
            "shape": list(shape),
            "fitted_on": {"window": _plain_part(first), "frames": _plain_half(own.learn)},
            "tried_on": {
                "windows": [_plain_part(p) for p in parts],
                "frames": _plain_half(own.test),
            },
            "kinds": [kind for kind in ("bias", "dark", "flat") if kind in ingested.tables],
            "sets": {s.name: list(s.baseline_mm) for s in acquisition.frames.fringes},
            "missing_frames": missing_frames(
                acquisition, ingested.tables, [s.step for s in windows[0].bench.measured.sets]
            ),
        },
        runtime,
        few,
    )


def _samples(half: Half, pixels: int) -> tuple[int, int]:
    """Samples of a window: of the largest fringe set, and of all; without fringes of all frames."""
    counts = [len(frames) for name, frames in half.frames.items() if "/" in name]
    counts = counts or [sum(map(len, half.frames.values()))]
    return pixels * max(counts), pixels * sum(counts)


def _enough(half: Half) -> None:
    for name, frames in half.frames.items():
        if "/" in name and len(frames) < FEWEST_FRAMES:
            raise InputError(
                f"{name}: half of its frames are {len(frames)}; diagnose needs {FEWEST_FRAMES} in "
                "each half, for effects are fitted on one and tried on the other"
            )


def _plain_part(part: Part) -> list[list[int]]:
    return [list(part[0]), list(part[1])]


def _plain_half(half: Half) -> dict[str, list[int]]:
    return {
        name: [int(frames[0]), int(frames[-1]), len(frames)] for name, frames in half.frames.items()
    }


def _reduction(run_dir: Path) -> reduce.Config:
    plain = dict(require(run_dir, "reduce", 1).config)
    known = {k: v for k, v in plain.items() if k in reduce.Config.__dataclass_fields__}
    return parse(reduce.Config, known, str(run_dir / "reduce" / "manifest.json"))


def _candidates(
    evidence: Evidence, kinds: Mapping[str, type[Effect]], base: Effects, runtime: Runtime
) -> dict[str, Candidate]:
    there = {effect.name for effect in base}
    tried = {name: kind for name, kind in kinds.items() if name not in there}
    found = _estimates(evidence, tried, runtime, "estimate effects")
    candidates = {}
    for name, one in found.items():
        if isinstance(one, Estimate):
            candidates[name] = Candidate(name, one)
        else:
            reason = one or "the acquisition holds no frames that could tell"
            candidates[name] = Candidate(name, None, reason)
    return candidates


def weakly_seen(
    candidates: Mapping[str, Candidate], kinds: Mapping[str, type[Effect]]
) -> tuple[type[Effect], ...]:
    """Candidates that the frames they were fitted on show; slow ones if the battery may not."""
    # By name: the order of candidates is none of curves.
    return tuple(
        kinds[name]
        for name, candidate in sorted(candidates.items())
        if candidate.estimate is not None
        and candidate.estimate.significance >= SURE
        and (kinds[name].quick or candidate.estimate.significance < CLEAR)
    )


def _estimates(
    evidence: Evidence, kinds: Mapping[str, type[Effect]], runtime: Runtime, label: str
) -> dict[str, Estimate | str | None]:
    # Here, for the evidence is too large to be sent about.
    here = runtime if runtime.cluster == "sync" else replace(runtime, cluster="threads")
    results = run_tasks(partial(estimate, evidence), list(kinds.values()), here, label=label)
    return dict(zip(kinds, results, strict=True))
