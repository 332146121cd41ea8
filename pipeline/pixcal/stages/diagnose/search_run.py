"""Analyse a reduced run, simulate its nominal bench, and search for causes of the gap."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.test_statistics import Key
from pixcal.estimators.test_statistics.expectation import Reference, expect_nominal, expect_with
from pixcal.estimators.test_statistics.gap import Difference, compare, flagged
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F64
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Again, Effect, Estimate
from pixcal.stages.diagnose.candidates import Candidate, SearchResult
from pixcal.stages.diagnose.diagnosis_input import DiagnosisInput, prepare_input
from pixcal.stages.diagnose.frames_used import FRINGES, MORE, FramesUsed
from pixcal.stages.diagnose.result import by_domain
from pixcal.stages.diagnose.search import (
    CONFIRM_SIMULATIONS,
    SCREEN_SIMULATIONS,
    Search,
    affordable,
)
from pixcal.stages.diagnose.trial import (
    OF_ESTIMATE,
    Curves,
    Effects,
    Signature,
    Trials,
    detect,
    estimate,
)
from pixcal.stages.diagnose.windows import whole_of

K = TypeVar("K")
R = TypeVar("R")

REFERENCES = 16  # simulations of the nominal bench
LEARN_SEED = 900_000
# significance of a slow estimate up to which it is a test statistic, and without fringes from which
MAX_SLOW_SIGNIFICANCE, MIN_DARK_SIGNIFICANCE = 20.0, 10.0
# significance over that of the strongest candidate below which a score test, which takes a fifth of
# a simulation, is none: the strongest effect is likely to produce it
MIN_RELATIVE_SIGNIFICANCE = 0.05


@dataclass(frozen=True)
class SearchRun:
    """A search and its inputs."""

    base: Effects  # effects that the nominal bench includes
    inputs: DiagnosisInput
    trials: Trials
    reference: Reference
    data: Mapping[Key, F64]  # curves of the data on the reference's scales
    search: Search
    found: SearchResult


def run_search(
    run_dir: Path, kinds: Mapping[str, type[Effect]], base: Effects, scratch: Path, runtime: Runtime
) -> SearchRun:
    """Analyse a reduced run, simulate its nominal bench, and search for causes among ``kinds``.

    ``base``: effects that the nominal bench includes. ``scratch``: keeps simulations to resume.
    """
    candidates: dict[str, Candidate] = {}
    signatures: tuple[Signature, ...] = ()

    def on_evidence(evidence: Evidence, unseen: Evidence, few: Runtime) -> tuple[Signature, ...]:
        nonlocal signatures
        candidates.update(_candidates(evidence, kinds, base, few))
        for candidate in candidates.values():
            candidate.replay = _replayed(candidate, unseen)
        signatures = marginal_candidates(candidates, kinds, fringes=bool(evidence.fringes))
        return signatures

    inputs = prepare_input(run_dir, runtime, on_evidence)
    for name, candidate in candidates.items():
        if candidate.estimate is None and not candidate.reason:
            candidate.needs = _needs(kinds[name], inputs.facts)
            candidate.reason = (
                f"cannot be estimated from these frames; record {' or '.join(candidate.needs)}"
            )
    estimates = {n: c.estimate for n, c in candidates.items() if c.estimate is not None}
    quick = tuple(s for s in signatures if kinds[s.name].quick)
    trials = Trials(inputs.windows, scratch, inputs.runtime, quick, estimates, SCREEN_SIMULATIONS)
    reference, data = _nominal(trials, inputs, base, run_dir)
    differences = compare(data, expect_nominal(reference))
    if needs_slow(signatures, quick, differences):
        trials = Trials(
            inputs.windows, scratch, inputs.runtime, signatures, estimates, SCREEN_SIMULATIONS
        )
        reference, data = _nominal(trials, inputs, base, run_dir)

    services = _SearchServices(inputs, base, kinds, candidates, trials)
    most = affordable(trials.samples)
    search = Search(reference, data, services.simulate, services.again, most)
    return SearchRun(base, inputs, trials, reference, data, search, search.run(candidates))


def _nominal(
    trials: Trials, inputs: DiagnosisInput, base: Effects, run_dir: Path
) -> tuple[Reference, dict[Key, F64]]:
    """Null distribution from the nominal bench, and the curves of the data on its scales."""
    (nominal,) = trials.curves([base], REFERENCES, "nominal bench")
    if isinstance(nominal, str):
        where = "--nominal" if base else f"{run_dir}: the nominal simulation failed"
        raise InputError(f"{where}: {nominal}")
    reference = Reference.of(nominal)
    return reference, reference.on_scale(inputs.measured)


@dataclass(frozen=True)
class _SearchServices:
    """Services for a search: simulations, and estimates on simulations of the fitted frames."""

    inputs: DiagnosisInput
    base: Effects
    kinds: Mapping[str, type[Effect]]
    candidates: Mapping[str, Candidate]
    trials: Trials
    # significances that were computed in parallel with simulations
    answers: dict[tuple[Effects, tuple[str, ...]], dict[str, float]] = field(default_factory=dict)

    def simulate(
        self, benches: Sequence[Effects], seeds: int, label: str, asked: Sequence[str]
    ) -> list[list[Curves] | str]:
        """Curves of benches; meanwhile, memory permitting, ``asked`` estimates on the first one."""

        def answer() -> None:
            one = Runtime(cluster="sync")
            self.answers[benches[0], tuple(asked)] = self._estimated(benches[0], asked, one)

        beside = answer if asked and self.inputs.room else None
        return self.trials.curves([(*self.base, *b) for b in benches], seeds, label, beside)

    def again(self, on: Effects, names: Sequence[str]) -> dict[str, float]:
        """Significance of candidates on simulations of the fitted frames with given effects."""
        answer = self.answers.pop((on, tuple(names)), None)
        return self._estimated(on, names, self.inputs.few) if answer is None else answer

    def _estimated(self, on: Effects, names: Sequence[str], few: Runtime) -> dict[str, float]:
        window, every = self.inputs.first, self.candidates.values()
        laws = {c.replay: c.estimate.effect for c in every if c.replay and c.estimate}
        try:
            by_law = tuple(laws.get(effect, effect) for effect in on)
            evidence = window.evidence(window.learn, (*self.base, *by_law), LEARN_SEED)
        except InputError:
            return {}  # These frames cannot show how the effects appear.
        asked = {n: _again(self.candidates[n]) or self.kinds[n] for n in names}
        found = _each_of(asked, partial(detect, evidence), few, "estimate again")
        return {name: size for name, size in found.items() if size is not None}


def places(made: SearchRun) -> list[dict[str, Any]]:
    """Deviations of each window alone; empty if one window covers the detector."""
    inputs, trials = made.inputs, made.trials
    if len(inputs.windows) == 1 and inputs.windows[0].part == whole_of(inputs.windows[0].whole):
        return []
    places = []
    for number, window in enumerate(inputs.windows):
        own = Reference.of(trials.of_window(number, made.base, REFERENCES))
        data = own.on_scale(inputs.each[number])
        nominal = compare(data, expect_nominal(own))
        final = nominal
        if made.found.accepted:
            bench = (*made.base, *made.found.final.effects)
            final = compare(
                data, expect_with(own, trials.of_window(number, bench, CONFIRM_SIMULATIONS))
            )
        places.append({"window": to_plain(window.part), "domains": by_domain(nominal, final)})
    return places


def _candidates(
    evidence: Evidence, kinds: Mapping[str, type[Effect]], base: Effects, runtime: Runtime
) -> dict[str, Candidate]:
    there = {effect.name for effect in base}
    tried = {name: kind for name, kind in kinds.items() if name not in there}
    found = _each_of(tried, partial(estimate, evidence), runtime, "estimate effects")
    candidates = {}
    for name, one in found.items():
        if isinstance(one, Estimate):
            candidates[name] = Candidate(name, one, one.refused)
        else:
            candidates[name] = Candidate(name, None, one or "")
    return candidates


def _needs(kind: type[Effect], facts: FramesUsed) -> tuple[str, ...]:
    """Frames needed to estimate an effect."""
    if not facts.sets and not kind.remedy:
        return (FRINGES,)
    missing = facts.missing_frames
    frames = tuple(words for name, words in missing.items() if name in kind.frames_needed)
    # Without fringes, any missing frames of a sensor may show the effect.
    return frames or (() if facts.sets else tuple(missing.values())) or (MORE,)


def _replayed(candidate: Candidate, unseen: Evidence) -> Effect | None:
    """The effect as measured, in full or frame by frame; None if its law is complete."""
    found = candidate.estimate
    if found is None or found.refused or found.significance < SIGNIFICANT:
        return None
    if found.in_full is not None:
        return found.in_full
    try:
        replay = found.effect.replayed(unseen)
    except (InputError, np.linalg.LinAlgError, ValueError, ArithmeticError):
        return None
    return None if replay is None or replay.is_null else replay


def _again(candidate: Candidate) -> Again | None:
    return None if candidate.estimate is None else candidate.estimate.again


def marginal_candidates(
    candidates: Mapping[str, Candidate], kinds: Mapping[str, type[Effect]], *, fringes: bool = True
) -> tuple[Signature, ...]:
    """Candidates significant in the fitted frames; a slow one only if it is the strongest.

    With fringes only if it is weak, as a strong one shows in other statistics; without them only if
    it is strong, as a weak one is slow to confirm.
    A score test that is faint beside the strongest candidate is left out.
    """
    seen = {n: c.estimate for n, c in candidates.items() if c.estimate is not None}
    most = max((e.significance for e in seen.values()), default=0.0)
    strongest = most < MAX_SLOW_SIGNIFICANCE if fringes else most > MIN_DARK_SIGNIFICANCE
    # Sorted by name, since the order of candidates must not affect the curves.
    return tuple(
        estimate.again or kinds[name]
        for name, estimate in sorted(seen.items())
        if estimate.significance >= SIGNIFICANT
        and (estimate.again is None or estimate.significance >= MIN_RELATIVE_SIGNIFICANCE * most)
        and (kinds[name].quick or (strongest and estimate.significance == most))
    )


def needs_slow(
    signatures: Sequence[Signature],
    quick: Sequence[Signature],
    differences: Mapping[Key, Difference],
) -> bool:
    """Whether slow estimates must be statistics too: no quick one differs."""
    return len(quick) < len(signatures) and not flagged(differences)


def _each_of(
    kinds: Mapping[str, K], ask: Callable[..., R], runtime: Runtime, label: str
) -> dict[str, R]:
    """Result of ``ask`` for each effect, by its name."""
    bound = replace(OF_ESTIMATE, memory=runtime.memory, excluded_bytes=runtime.excluded_bytes)
    asked = partial(ask, bound=bound)
    results = run_tasks(asked, list(kinds.values()), runtime.here, label=label)
    return dict(zip(kinds, results, strict=True))
