"""Search for the effects that close the gap: add one by one, then leave each out in turn.

A candidate is accepted if, with parameters fitted to other frames, it raises the likelihood of the
held-out frames by more than chance and complexity allow, and by more than any other. Its estimate
on a simulation with the accepted effects shows how much of its significance these produce
(docs/explanation/cause-search.md).
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pixcal.estimators.test_statistics import Key
from pixcal.estimators.test_statistics.expectation import Reference, signature_key
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F64
from pixcal.simulation.effect import Effect, Estimate
from pixcal.stages.diagnose import rejection, thresholds
from pixcal.stages.diagnose.benches import (
    CONFIRM_SIMULATIONS,
    SCREEN_SIMULATIONS,
    SIMULATIONS,
    Benches,
    Simulate,
)
from pixcal.stages.diagnose.candidates import (
    Addition,
    Additions,
    Candidate,
    SearchResult,
    likeliest,
)
from pixcal.stages.diagnose.comparison import Comparison
from pixcal.stages.diagnose.pruning import Pruning
from pixcal.stages.diagnose.trial import Effects

# share of the best gain above which a candidate is simulated more than once; the larger share if
# the best gain is so high that more simulations cannot reverse the order
PROMISING, PROMISING_IF_CLEAR, CLEAR = 0.25, 0.5, 40.0
# largest significance credited after one simulation: its scatter is unknown
MAX_SINGLE_SIMULATION_SIGMA = 3.0
MAX_CAUSES = 5  # most causes that are accepted
# significance in one simulation, sigma, up to which chance produces it, not the causes
BY_CHANCE = 2.5
TIE_MARGIN = 0.1  # relative difference from the best gain within which candidates are equal
Estimates = Callable[[Effects, Sequence[str]], Mapping[str, float]]
Measure = Callable[[str, Effects], Estimate | None]


class Search:
    """Greedy search over candidates.

    data : test statistics of the held-out frames, on the scales of the reference
    simulate : benches, seeds, label, candidates for the next `estimates` -> statistics
    estimates : effects, names -> significance of candidates on simulations of the fitted frames
    most : largest number of simulations
    measure : name, effects -> estimate of a candidate on the fitted frames less these effects
    """

    def __init__(
        self,
        reference: Reference,
        data: Mapping[Key, F64],
        simulate: Simulate,
        estimates: Estimates,
        most: int = SIMULATIONS,
        measure: Measure = lambda *_: None,
    ) -> None:
        self._estimates, self._measure = estimates, measure
        self.comparison = Comparison(reference, data)
        self._benches = Benches(self.comparison, simulate, most)
        self._current = self.comparison.nominal  # the bench with all causes accepted so far
        # fraction of each remaining candidate's significance that the causes do not produce
        self._shares: dict[str, float] = {}
        self._effects: dict[str, Effect] = {}  # causes by name, in the order of acceptance
        # by the name of a cause, the candidates that fit about as well
        self._alike: dict[str, tuple[str, ...]] = {}
        # all candidates, and those that may still be accepted
        self._candidates: Mapping[str, Candidate] = {}
        self._remaining: dict[str, Candidate] = {}

    def run(self, candidates: Mapping[str, Candidate]) -> SearchResult:
        """Search, and fill in ``reason`` of rejected candidates."""
        remaining = {n: c for n, c in candidates.items() if c.estimate and not c.reason}
        self._candidates, self._remaining = candidates, remaining
        self._shares = dict.fromkeys(remaining, 1.0)
        self._accept_all()
        if len(self._effects) < MAX_CAUSES and self._exchange():
            self._accept_all()
        if len(self._effects) == MAX_CAUSES:
            for candidate in remaining.values():
                candidate.reason = f"not tested: the search stops after {MAX_CAUSES} causes"
        return Pruning(self._benches, candidates).of(self._effects, self._current, self._alike)

    @property
    def _bench(self) -> Effects:
        return tuple(self._effects.values())

    def _accept_all(self) -> None:
        while len(self._effects) < MAX_CAUSES and self._accept_one():
            pass

    def _accept_one(self) -> bool:
        """Accept the candidate that the held-out frames favour most; False if they favour none."""
        remaining, candidates = self._remaining, self._candidates
        self._reject_insignificant()
        self._reject_undecided()
        if not remaining:
            return False
        laws, replays = self._tried()
        gains, effect, best = self._favoured(laws, replays)
        if effect is None or self._unexplainable(laws, replays):
            return False
        del remaining[best]
        confirmed = self._benches.confirmed((*self._bench, effect), asked=[*remaining])
        if isinstance(confirmed, str):
            candidates[best].reason = f"cannot be simulated: {confirmed}"
            return True
        self._current = confirmed
        self._effects[best] = effect
        candidates[best].share = self._shares[best]
        candidates[best].reason = ""
        enough = max(gains[best] - thresholds.MIN_LOGLIK_GAIN, thresholds.MIN_LOGLIK_GAIN)
        self._alike[best] = tuple(n for n, g in gains.items() if n != best and g > enough)
        self._leave_explained(best)
        return True

    def _unexplainable(self, laws: Additions, replays: Additions) -> bool:
        """Reject all candidates if most of the gap remains, with each alone and with all."""
        if self._effects:
            return False
        alone = [(one.name, one.trial) for one in (*laws.values(), *replays.values())]
        # One simulation was enough for candidates without promise.
        once = self._remaining.keys() - laws.keys() - replays.keys()
        alone += [
            (name, one) for name in sorted(once) if (one := self._remaining[name].alone) is not None
        ]
        start = self.comparison.nominal
        if any(rejection.settled(self.comparison, start, t, self._candidates[n]) for n, t in alone):
            return False
        closed = rejection.all_close_little(self.comparison, alone)
        if not closed or self._close_much_together(tuple(one.effect for one in laws.values())):
            return False
        for name, share in closed.items():
            candidate = self._candidates[name]
            candidate.reason = candidate.reason or rejection.possible_proxy(share, 1 - share)
        return True

    def _close_much_together(self, effects: Effects) -> bool:
        """Whether effects that close little alone compensate each other."""
        if len(effects) < 2:
            return False
        (curves,) = self._benches.simulate([effects], 1, "all candidates", ())
        if isinstance(curves, str):
            return False
        trial = self.comparison.trial(effects, curves)
        left = self.comparison.residual(trial, self.comparison.gap_of(trial))
        return left < 1 - thresholds.MIN_JOINT_GAP_CLOSED

    def _leave_explained(self, cause: str) -> None:
        """Leave out candidates whose significance comes mostly from the causes."""
        shares = self._shares = self._unexplained()
        for name in [n for n, share in shares.items() if share < 1 - thresholds.SIMILAR]:
            self._candidates[name].reason = rejection.similar_to(cause)
            del self._remaining[name], shares[name]

    def _exchange(self) -> bool:
        """If the data still differ, replace a cause by two other candidates."""
        remaining, candidates = self._remaining, self._candidates
        options = rejection.exchanges(self._effects, candidates)
        count = len(self._effects) + 1
        left = self._benches.left - CONFIRM_SIMULATIONS * (1 + count * (count + 1) // 2)
        if not self.comparison.differs(self._current):
            return False
        options += self._measured_apart()
        if not options or len(options) + 1 > left:
            return False
        benches = [tuple(one.effects.values()) for one in options]
        # Choose by one simulation of each, then by a few, before the choice is confirmed.
        for seeds, needed in ((1, 0.0), (SCREEN_SIMULATIONS, thresholds.MIN_LOGLIK_GAIN_WEAK)):
            tried = self._benches.simulate([self._bench, *benches], seeds, "exchanged", ())
            likely = [
                -np.inf if isinstance(c, str) else self.comparison.trial(b, c).log_likelihood
                for b, c in zip([self._bench, *benches], tried, strict=True)
            ]
            place = int(np.argmax(likely[1:]))
            if likely[1 + place] < likely[0] + needed:
                return False
            options, benches = (options[place],), [benches[place]]
        (best,) = options
        trial = self._benches.confirmed(tuple(best.effects.values()))
        if isinstance(trial, str) or trial.log_likelihood < (
            self._current.log_likelihood + thresholds.MIN_LOGLIK_GAIN_WEAK
        ):
            return False
        self._current, self._effects = trial, dict(best.effects)
        self._alike = {name: self._alike.get(name, ()) for name in self._effects}
        candidates[best.out].reason = best.reason
        for name, estimate in best.estimates.items():
            candidates[name].estimate, candidates[name].replay = estimate, estimate.in_full
        for name, one in candidates.items():
            if name in self._effects:
                one.reason = ""
            elif name != best.out and one.usable:
                remaining[name] = one
        for name in best.new:
            remaining.pop(name, None)
        self._leave_explained(" and ".join(best.new))
        return True

    def _measured_apart(self) -> tuple[rejection.Exchange, ...]:
        """Each cause with a candidate of its domains, both measured on frames without the other."""
        exchanges = []
        for out, other in rejection.entangled(self._effects, self._candidates):
            rest = {name: effect for name, effect in self._effects.items() if name != out}
            estimates: dict[str, Estimate] = {}
            beside = self._candidates[other].estimate
            for name in (out, other):
                if beside is not None:
                    beside = self._measure(name, (*rest.values(), beside.effect))
                if beside is None or beside.effect.is_null or beside.significance < SIGNIFICANT:
                    break
                estimates[name] = beside
            if len(estimates) < 2:
                continue
            effects = rest | {name: one.effect for name, one in estimates.items()}
            exchanges.append(rejection.Exchange(out, effects, (out, other), estimates))
        return tuple(exchanges)

    def _favoured(
        self, laws: Additions, replays: Additions
    ) -> tuple[dict[str, float], Effect | None, str]:
        """Gain of every candidate, and effect and name of the best with sufficient gain."""
        candidates = self._candidates
        # A replay replaces the law if it fits better.
        gains = {name: law.gain for name, law in laws.items()}
        enough = {n: g for n, g in gains.items() if g >= rejection.needed_gain(candidates[n])}
        if gains and not enough:
            # No law of any effect suffices, but an effect may have acted by another law.
            enough = {
                n: r.gain for n, r in replays.items() if r.gain >= thresholds.MIN_LOGLIK_GAIN_WEAK
            }
            gains |= enough
            laws |= {name: replays[name] for name in enough}
        # Where a replay seemed enough, candidates without promise were simulated once only.
        for name in (gains if enough else self._remaining).keys() - enough.keys():
            candidates[name].reason = rejection.gain_too_small(
                gains.get(name, 0.0), candidates[name]
            )
        if not enough:
            return gains, None, ""
        best = self._best(enough)
        effect = laws[best].effect
        if best in replays and self.comparison.replay_fits_better(
            replays[best].trial, laws[best].trial
        ):
            effect = replays[best].effect
        return gains, effect, best

    def _best(self, gains: dict[str, float]) -> str:
        """The candidate with the largest gain; among equals, one that is described by its law."""
        # A cause that maps confirm comes before those that may imitate it, or an unknown one.
        gains = {n: g for n, g in gains.items() if self._candidates[n].law_predicts} or gains
        # A curve measured at many levels can imitate another effect.
        most = max(gains.values())
        equals = {n: g for n, g in gains.items() if g >= (1 - TIE_MARGIN) * most}
        if len(equals) > 1:
            curves = [(n, law) for n in equals if (law := self._candidates[n].law) is not None]
            by_law = self._added(curves, SCREEN_SIMULATIONS, "laws", drop=False)
            equals |= {one.name: one.gain for one in by_law}
        return max(equals, key=lambda n: equals[n])

    def _reject_insignificant(self) -> None:
        """Leave out candidates whose significance does not exceed what the causes produce."""
        remaining, sizes = self._remaining, self._sizes()
        least = SIGNIFICANT
        if self.comparison.differs(self._current):
            strong = max(sizes.values(), default=0.0) >= SIGNIFICANT
            least = thresholds.MIN_SIGMA_IN_GAP if strong else thresholds.MIN_SIGMA_WEAK
        names = " and ".join(self._effects)
        verb = "are" if len(self._effects) > 1 else "is"
        beside = f" once {names} {verb} included" if names else ""
        for name, size in sizes.items():
            estimate = remaining[name].estimate
            assert estimate is not None
            if size < least or estimate.effect.is_null:
                remaining[name].reason = f"not significant{beside} ({size:z.1f} sigma)"
                del remaining[name]

    def _sizes(self) -> dict[str, float]:
        """Significance of the remaining candidates that the causes do not produce."""
        return {n: c.significance * self._shares.get(n, 1.0) for n, c in self._remaining.items()}

    def _reject_undecided(self) -> None:
        """Leave out the weakest candidates if simulations do not suffice for all."""
        remaining, sizes = self._remaining, self._sizes()
        count = len(self._effects) + 1
        weighed = (
            count * (2 * CONFIRM_SIMULATIONS + SCREEN_SIMULATIONS)
            + count * (count - 1) // 2 * CONFIRM_SIMULATIONS
        )
        left = self._benches.left - CONFIRM_SIMULATIONS - weighed
        for name in sorted(sizes, key=lambda n: -sizes[n]):
            candidate = remaining[name]
            left -= SCREEN_SIMULATIONS * (len(candidate.variants(self._shares.get(name, 1.0))) + 1)
            if left < 0:
                candidate.reason = (
                    f"not decided: too few of the search's {self._benches.most} simulations are "
                    "left"
                )
                del remaining[name]

    def _tried(self) -> tuple[Additions, Additions]:
        """Add each candidate to the causes: its likeliest variant by law, and its replay."""
        # A replay may imitate the law of another effect, so it is kept separate. One simulation of
        # each shows which variants are promising; the rest are simulated only if none of these
        # gains enough.
        remaining = self._remaining
        options = [
            (name, way)
            for name, one in remaining.items()
            for way in one.variants(self._shares.get(name, 1.0))
        ]
        once = self._added(options, 1, "candidates")
        if not self._effects:
            for name, addition in likeliest(once).items():
                remaining[name].alone = addition.trial
        best = max((one.gain for one in once), default=0.0)
        least = best * (PROMISING if best < CLEAR else PROMISING_IF_CLEAR)
        hopeful = {one.name for one in once if one.gain >= least}
        # A replay is compared with its best law, even if that law is not promising.
        laws = likeliest(o for o in once if o.effect != remaining[o.name].replay)
        promising = [
            one
            for one in once
            if one.gain >= least or (one.name in hopeful and one in laws.values())
        ]
        tried = self._added(
            [(o.name, o.effect) for o in promising], SCREEN_SIMULATIONS, "candidates"
        )
        if all(one.gain < rejection.needed_gain(remaining[one.name]) for one in tried):
            # Some may have been refused in the meantime, with other seeds.
            rest = [one for one in once if one not in promising and one.name in remaining]
            others = [(one.name, one.effect) for one in rest if one.gain > 0]
            tried += self._added(others, SCREEN_SIMULATIONS, "candidates")
            tried += [one for one in rest if one.gain <= 0 and one.name in remaining]
        replays = [o for o in tried if o.effect == remaining[o.name].replay]
        return likeliest(o for o in tried if o not in replays), likeliest(replays)

    def _added(
        self,
        options: Sequence[tuple[str, Effect]],
        simulations: int,
        label: str,
        *,
        drop: bool = True,
    ) -> list[Addition]:
        """Variants added to the causes, with their gains; ``drop`` those that were refused."""
        candidates = self._candidates
        beside = self._benches.start(self._bench, simulations)
        start = self.comparison.allowing_for_laws(beside, self._current)
        benches = [(*self._bench, effect) for _, effect in options]
        label = f"{label}, round {len(self._effects) + 1}"
        simulated = self._benches.simulate(benches, simulations, label, ())
        made: list[Addition] = []
        refused: dict[str, str] = {}
        for (name, effect), bench, curves in zip(options, benches, simulated, strict=True):
            if isinstance(curves, str):
                refused[name] = f"cannot be simulated: {curves}"
                continue
            sure = candidates[name].significance
            if simulations == 1:
                sure = min(sure, MAX_SINGLE_SIMULATION_SIGMA)
            trial = self.comparison.trial(bench, curves, sure, beside)
            trial = self.comparison.allowing_for_laws(trial, self._current)
            gain = trial.log_likelihood - start.log_likelihood
            if candidates[name].in_maps_alone:
                # Chance acts equally on all statistics of a pattern: together they are no less
                # likely than one of them.
                key = signature_key(effect.name, effect.domains[0])
                gain = min(gain, self.comparison.gain_where_differing(start, trial, key))
            made.append(Addition(name, effect, trial, gain))
        for name in refused.keys() - {one.name for one in made}:
            candidates[name].reason = refused[name]
            if drop:
                del self._remaining[name]
        return made

    def _unexplained(self) -> dict[str, float]:
        """Fraction of each remaining candidate's significance that the causes do not produce."""
        if not self._remaining:
            return {}
        made = self._estimates(self._bench, list(self._remaining))
        produced = {name: size for name, size in made.items() if size > BY_CHANCE}
        return {
            name: max(1 - produced.get(name, 0.0) / c.significance, 0.0)
            for name, c in self._remaining.items()
        }
