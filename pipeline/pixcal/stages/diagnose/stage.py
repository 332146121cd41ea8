"""``pixcal diagnose``: where data and simulation differ, which effect causes it, what remains.

The frames are parted: on the first half effects are fitted, on the second they are tried. Both the
data and every simulation of them are reduced and fitted by the same stages.
"""

import hashlib
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pixcal.effects import known_effects, parse_effects
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.evidence import Evidence
from pixcal.estimators.gap import Reference, compare, expect_nominal, expect_with
from pixcal.model.bench import load_bench
from pixcal.model.config import quantity, to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, Estimate
from pixcal.stages.diagnose.look import Look, look_at, plain_part
from pixcal.stages.diagnose.result import by_domain, describe
from pixcal.stages.diagnose.search import CONFIRM, SCREEN, SURE, Candidate, Found, Search
from pixcal.stages.diagnose.trial import (
    Effects,
    Trials,
    estimate,
)
from pixcal.stages.diagnose.windows import whole_of
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

FORMAT = 4
REFERENCES = 16
"""Simulations of the nominal bench."""
LEARN_SEED = 900_000
CLEAR = 20.0
"""Standard deviations from which an effect whose estimate is slow is left to the battery."""


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
                f"--effects {name!r:.80}: unknown effect; known are {', '.join(known)}; one of "
                "your own is known with --own and its file"
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
        where = "--nominal" if base else f"{run_dir}: its nominal bench"
        raise InputError(f"{where}: {nominal}")
    reference = Reference.of(nominal)
    data = reference.on_scale(look.measured)

    def again(on: Effects, names: Sequence[str]) -> dict[str, float]:
        """Significance of candidates on the first frames taken again with some effects."""
        window = look.first
        try:
            evidence = window.evidence(window.learn, (*base, *on), LEARN_SEED, scratch)
        except InputError:
            return {}  # These frames do not tell what the effects look like.
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


def _places(look: Look, trials: Trials, base: Effects, found: Found) -> list[dict[str, Any]]:
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
        places.append({"window": plain_part(window.part), "domains": by_domain(nominal, final)})
    return places


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
    results = run_tasks(
        partial(estimate, evidence), list(kinds.values()), runtime.here, label=label
    )
    return dict(zip(kinds, results, strict=True))
