"""Simulate the nominal bench of a diagnosis, and search for causes of the gap."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from pixcal.engine.run import Runtime
from pixcal.estimators.test_statistics import Key
from pixcal.estimators.test_statistics.expectation import Reference, expect_nominal, expect_with
from pixcal.estimators.test_statistics.gap import Difference, compare, flagged
from pixcal.model.arrays import F64
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Estimate
from pixcal.stages.diagnose.benches import CONFIRM_SIMULATIONS, SCREEN_SIMULATIONS, affordable
from pixcal.stages.diagnose.candidates import SearchResult
from pixcal.stages.diagnose.comparison import by_domain
from pixcal.stages.diagnose.diagnosis_input import DiagnosisInput
from pixcal.stages.diagnose.parts import evidence_of
from pixcal.stages.diagnose.result import Description
from pixcal.stages.diagnose.search import Search
from pixcal.stages.diagnose.trial import (
    Curves,
    Effects,
    Signature,
    Trials,
    detect,
    each_of,
    estimate,
)
from pixcal.stages.diagnose.windows import whole_of

REFERENCES = 16  # simulations of the nominal bench
LEARN_SEED = 900_000


def run_search(inputs: DiagnosisInput, scratch: Path) -> tuple[Description, list[dict[str, Any]]]:
    """Simulate the nominal bench, and search for causes among the candidates.

    Also the deviations of each window (`_places`).
    ``scratch``: keeps simulations to resume. Raises InputError if the nominal bench cannot be
    simulated.
    """
    effects = inputs.effects
    quick = tuple(s for s in effects.signatures if effects.kinds[s.name].quick)

    def simulated(signatures: tuple[Signature, ...]) -> tuple[Trials, Reference, dict[Key, F64]]:
        """Null distribution from the nominal bench, and the curves of the data on its scales."""
        known, exact = effects.estimates, SCREEN_SIMULATIONS
        trials = Trials(inputs.windows, scratch, inputs.runtime, signatures, known, exact)
        (nominal,) = trials.curves([effects.base], REFERENCES, "nominal bench")
        if isinstance(nominal, str):
            raise InputError(nominal)
        reference = Reference.of(nominal)
        return trials, reference, reference.on_scale(inputs.measured)

    trials, reference, data = simulated(quick)
    if needs_slow(effects.signatures, quick, compare(data, expect_nominal(reference))):
        trials, reference, data = simulated(effects.signatures)
    services, most = _SearchServices(inputs, trials), affordable(trials.samples)
    search = Search(reference, data, services.simulate, services.again, most, services.measure)
    result = search.run(effects.candidates)
    described = Description(result, data, inputs.measured, reference, inputs.facts)
    return described, _places(inputs, trials, result)


@dataclass(frozen=True)
class _SearchServices:
    """Services for a search: simulations, and estimates on simulations of the fitted frames."""

    inputs: DiagnosisInput
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
        with_base = [(*self.inputs.effects.base, *bench) for bench in benches]
        return self.trials.curves(with_base, seeds, label, beside)

    def again(self, on: Effects, names: Sequence[str]) -> dict[str, float]:
        """Significance of candidates on simulations of the fitted frames with given effects."""
        answer = self.answers.pop((on, tuple(names)), None)
        return self._estimated(on, names, self.inputs.few) if answer is None else answer

    def measure(self, name: str, without: Effects) -> Estimate | None:
        """Estimate of an effect on the fitted frames less what other effects change in them."""
        window, kind = self.inputs.first, self.inputs.effects.kinds[name]
        try:
            raw = window.bench.without(self.inputs.learn(), window.learn, without)
            evidence = replace(evidence_of(raw, window.part, window.whole), full=window.full)
        except InputError:
            return None
        asked = partial(estimate, evidence)
        answer = each_of({name: kind}, asked, self.inputs.few, "estimate again")[name]
        return answer if isinstance(answer, Estimate) and not answer.refused else None

    def _estimated(self, on: Effects, names: Sequence[str], few: Runtime) -> dict[str, float]:
        window, effects = self.inputs.first, self.inputs.effects
        known = effects.estimates
        laws = {c.replay: known[n].effect for n, c in effects.candidates.items() if c.replay}
        try:
            by_law = tuple(laws.get(effect, effect) for effect in on)
            evidence = window.evidence(window.learn, (*effects.base, *by_law), LEARN_SEED)
        except InputError:
            return {}  # These frames cannot show how the effects appear.
        asked = {n: known[n].again or effects.kinds[n] for n in names}
        sizes = each_of(asked, partial(detect, evidence), few, "estimate again")
        return {name: size for name, size in sizes.items() if size is not None}


def _places(inputs: DiagnosisInput, trials: Trials, result: SearchResult) -> list[dict[str, Any]]:
    """Deviations of each window alone; empty if one window covers the detector."""
    base = inputs.effects.base
    if len(inputs.windows) == 1 and inputs.windows[0].part == whole_of(inputs.windows[0].whole):
        return []
    places = []
    for number, window in enumerate(inputs.windows):
        reference = Reference.of(trials.of_window(number, base, REFERENCES))
        data = reference.on_scale(inputs.each[number])
        nominal = compare(data, expect_nominal(reference))
        final = nominal
        if result.accepted:
            bench = (*base, *result.final.effects)
            final = compare(
                data, expect_with(reference, trials.of_window(number, bench, CONFIRM_SIMULATIONS))
            )
        places.append({"window": to_plain(window.part), "domains": by_domain(nominal, final)})
    return places


def needs_slow(
    signatures: Sequence[Signature],
    quick: Sequence[Signature],
    differences: Mapping[Key, Difference],
) -> bool:
    """Whether slow estimates must be statistics too: no quick one differs."""
    return len(quick) < len(signatures) and not flagged(differences)
