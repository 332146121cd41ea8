"""Leave out each accepted cause in turn, and reject those that are redundant or doubtful."""

from collections.abc import Mapping

from pixcal.simulation.effect import Effect
from pixcal.stages.diagnose import rejection
from pixcal.stages.diagnose.benches import CONFIRM_SIMULATIONS, SCREEN_SIMULATIONS, Benches
from pixcal.stages.diagnose.candidates import Candidate, SearchResult
from pixcal.stages.diagnose.comparison import Trial
from pixcal.stages.diagnose.thresholds import MIN_LOGLIK_GAIN


class Pruning:
    """The last step of a search; fills in ``reason`` of the candidates that it rejects."""

    def __init__(self, benches: Benches, candidates: Mapping[str, Candidate]) -> None:
        self._benches, self._candidates = benches, candidates

    def of(
        self, effects: dict[str, Effect], current: Trial, alike: Mapping[str, tuple[str, ...]]
    ) -> SearchResult:
        """The causes that are kept, of those that were accepted, by name.

        current : the bench with all of them
        alike : by the name of a cause, the candidates that fit about as well
        """
        candidates, comparison = self._candidates, self._benches.comparison
        self._weigh_alone(effects)
        while True:
            without = self._each_left_out(effects)
            rejected = (
                rejection.redundant(comparison, current, without)
                or rejection.unhelpful(comparison, current, without, candidates)
                or rejection.doubtful(comparison, current, without, candidates)
            )
            if rejected is None:
                break
            name, reason = rejected
            rest = tuple(e for n, e in effects.items() if n != name)
            fewer = self._benches.confirmed(rest) if rest else comparison.nominal
            if isinstance(fewer, str):
                break
            _reject(name, reason, effects, candidates)
            current = fewer
        while (replayed := self._replaceable_by_replay(effects, current)) is not None:
            name, by, current = replayed
            _reject(name, rejection.explained_by_other_law(by), effects, candidates)
            effects |= {one: e for one in effects for e in current.effects if e.name == one}
            without = self._each_left_out(effects)
        self._weigh_alone(effects)
        alike = {n: tuple(a for a in alike[n] if a not in effects) for n in effects}
        return SearchResult(
            comparison.nominal,
            current,
            tuple(effects),
            without,
            candidates,
            {name: others for name, others in alike.items() if others},
            self._by_laws(effects),
        )

    def _weigh_alone(self, effects: Mapping[str, Effect]) -> None:
        """Simulate each cause alone as often as all causes: few show random effects poorly."""
        for name, effect in effects.items():
            alone = self._benches.confirmed((effect,))
            if not isinstance(alone, str):
                self._candidates[name].alone = alone

    def _replaceable_by_replay(
        self, effects: Mapping[str, Effect], current: Trial
    ) -> tuple[str, str, Trial] | None:
        """A cause made redundant by another of the same step and domains; the bench without it."""
        candidates = self._candidates
        for name in sorted(effects, key=lambda n: candidates[n].significance):
            old = effects[name]
            replays = {
                n: replay
                for n, e in effects.items()
                if n != name and e.acts_at == old.acts_at and set(e.domains) >= set(old.domains)
                if (replay := candidates[n].replay) is not None and replay != e
            }
            if not replays or self._benches.left < CONFIRM_SIMULATIONS:
                continue
            rest = tuple(replays.get(n, e) for n, e in effects.items() if n != name)
            trial = self._benches.confirmed(rest)
            if (
                isinstance(trial, Trial)
                and self._benches.comparison.gain_over(trial, current) < MIN_LOGLIK_GAIN
            ):
                return name, next(iter(replays)), trial
        return None

    def _by_laws(self, effects: Mapping[str, Effect]) -> dict[str, Trial]:
        """The bench with each effect alone, by its best-fitting law."""
        trials = {}
        for name, effect in effects.items():
            law = self._candidates[name].by_law(effect)
            if law is not None and law != effect:
                trial = self._benches.confirmed((law,), SCREEN_SIMULATIONS)
                if isinstance(trial, Trial):
                    trials[name] = trial
        return trials

    def _each_left_out(self, effects: Mapping[str, Effect]) -> dict[str, Trial]:
        """The bench with all effects but one, by its name."""
        benches = {
            name: tuple(e for n, e in effects.items() if n != name)
            for name in (effects if len(effects) > 1 else ())
        }
        # Simulate all in parallel; the next line finds the results.
        self._benches.simulate(
            list(benches.values()), CONFIRM_SIMULATIONS, "each cause left out", ()
        )
        return {name: self._benches.start(benches.get(name, ())) for name in effects}


def _reject(
    name: str, reason: str, effects: dict[str, Effect], candidates: Mapping[str, Candidate]
) -> None:
    """Reject a cause, and the candidates that were rejected as similar to it."""
    candidates[name].reason = reason
    for candidate in candidates.values():
        if candidate.reason == rejection.similar_to(name):
            candidate.reason = f"similar to {name}, which was rejected: {reason}"
    del effects[name]
