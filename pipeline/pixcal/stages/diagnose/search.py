"""Which effects close the gap: added one by one on unseen data, then each left out again.

A candidate comes with parameters that were fitted to other frames. It is taken when it makes the
unseen data likelier by more than chance and complexity allow, and by more than any other; then the
search goes on with it in the bench. What an effect already taken brings about in the estimate of a
candidate is allowed for: the same estimate is made on a simulation with the effects taken.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.diagnosis.gap import (
    Expectation,
    Reference,
    compare,
    expect_nominal,
    expect_with,
    flagged,
    log_likelihood,
    remaining,
)
from pixcal.estimators.diagnosis.test_statistics import Key
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.simulation.effect import Effect, Estimate
from pixcal.stages.diagnose.shrinkage import LEAST, Trial, differing
from pixcal.stages.diagnose.trial import Curves, Effects

F64 = NDArray[np.float64]

HINTED = 1.5
"""Significance that an estimate needs where there is a gap, instead of `SIGNIFICANT`;"""
FAINT = 1.0
"""where no candidate is sure: of some that are only hinted at, the true one may be the faintest."""
MIN_LOGLIK_GAIN_WEAK = 12.0
"""By which an effect that the first frames only hint at must raise the log-likelihood of unseen
data; others by `LEAST`."""
SCREEN = 3
"""Simulations of a candidate; of what was taken, `CONFIRM`."""
CONFIRM = 8
MOST = 5
"""Effects that are taken."""
OPEN = 0.15
"""Share of the gap that is left where the cause is taken for unknown; then an effect that closes"""
LITTLE = 0.1
"""less than this share is not claimed, nor one that closes less than"""
BESIDE_OPEN = 0.25
"""this part of what stays open."""
EXPLAINED = 0.7
"""Share of a candidate's significance that another effect may bring about."""

LAW_ERROR = 0.25
"""Share of what an effect does that the world may do otherwise: a second cause needs evidence that
another law of the first one would not bring about."""

Simulate = Callable[[Sequence[Effects], int, str, Sequence[str]], Sequence[list[Curves] | str]]
Estimates = Callable[[Effects, Sequence[str]], Mapping[str, float]]


@dataclass
class Candidate:
    """What became of an effect in the search.

    Attributes
    ----------
    name : str
    estimate : Estimate, optional
    reason : str
        Why it was not taken; empty when it was.
    alone : Trial, optional
        With it alone in the bench.
    ways : int
        In how many ways it was tried, of which the likeliest was taken.
    share : float
        Of its significance, what the effects taken before it do not bring about.
    replay : Effect, optional
        The effect doing to each unseen frame what was measured there, whatever its law.
    """

    name: str
    estimate: Estimate | None
    reason: str = ""
    alone: Trial | None = None
    ways: int = 1
    share: float = 1.0
    replay: Effect | None = None

    def by_law(self, effect: Effect) -> Effect | None:
        """The effect as the best of its laws has it; None where it is its own law."""
        assert self.estimate is not None
        if effect == self.replay:
            return self.estimate.effect
        return self.estimate.by_law


@dataclass(frozen=True)
class Found:
    """Result of a search.

    Attributes
    ----------
    nominal, final : Trial
    taken : tuple of str
        In the order in which they were taken.
    without : mapping
        With all taken but one, by its name.
    candidates : mapping
    alike : mapping
        Effects that do about as well as one that was taken, by its name.
    by_law : mapping
        With one of those taken as the best of its laws has it, by its name; of effects that are
        their own law nothing.
    """

    nominal: Trial
    final: Trial
    taken: tuple[str, ...]
    without: Mapping[str, Trial]
    candidates: Mapping[str, Candidate]
    alike: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    by_law: Mapping[str, Trial] = field(default_factory=dict)


def looks_like(name: str) -> str:
    """Why an effect is not sought any more beside another that was taken."""
    return f"explained by {name}, which has a similar signature"


class Search:
    """Greedy search over candidates.

    Parameters
    ----------
    reference : Reference
    data : mapping
        Curves of the unseen data on the reference's scales.
    simulate : callable
        Curves of several benches: ``simulate(benches, seeds, label, asked)``; the candidates
        ``asked`` are those that `estimates` will be called with for the first bench.
    estimates : callable
        Significance that some candidates have on a simulation of the first frames with some
        effects: ``estimates(effects, names)``.
    """

    def __init__(
        self,
        reference: Reference,
        data: Mapping[Key, F64],
        simulate: Simulate,
        estimates: Estimates,
    ) -> None:
        self.reference, self.data = reference, data
        self._simulate, self._estimates = simulate, estimates
        self.nominal = self._trial((), expect_nominal(reference))

    def run(self, candidates: Mapping[str, Candidate]) -> Found:
        """Search; ``reason`` of the candidates is filled in."""
        open_ones = {n: c for n, c in candidates.items() if c.estimate and not c.reason}
        taken: list[str] = []
        effects: dict[str, Effect] = {}
        alike: dict[str, tuple[str, ...]] = {}
        current = self.nominal
        shares = dict.fromkeys(open_ones, 1.0)
        while len(taken) < MOST:
            self._drop_unseen(open_ones, shares, current)
            if not open_ones:
                break
            trials, replays = self._tried(effects, open_ones, shares, current)
            if not taken:
                for name, (trial, _) in trials.items():
                    candidates[name].alone = trial
            # Held against as many simulations as the candidates have: chance is the same in both.
            start = self._start(tuple(effects.values()), SCREEN)
            least = self._tolerant(start, current).log_likelihood
            gains = {n: t.log_likelihood - least for n, (t, _) in trials.items()}
            if not gains:
                break
            own = {n: g for n, g in gains.items() if g >= self._least(candidates[n])}
            if not own:
                # No law of any effect does; one of them may yet have acted by another law.
                again = {n: t.log_likelihood - least for n, (t, _) in replays.items()}
                own = {n: g for n, g in again.items() if g >= MIN_LOGLIK_GAIN_WEAK}
                gains |= own
                trials |= {n: replays[n] for n in own}
            for name in gains.keys() - own.keys():
                candidates[name].reason = self._too_little(gains[name])
            if not own:
                break
            best = max(own, key=lambda n: own[n])
            if best in replays and self._closer(replays[best][0], trials[best][0]):
                trials[best] = replays[best]
            del open_ones[best]
            confirmed = self._confirmed((*effects.values(), trials[best][1]), asked=[*open_ones])
            if isinstance(confirmed, str):
                candidates[best].reason = f"cannot be simulated: {confirmed}"
                continue
            current = confirmed
            effects[best] = trials[best][1]
            taken.append(best)
            candidates[best].share = shares[best]
            candidates[best].reason = ""
            # But for those that are taken beside it later.
            enough = max(gains[best] - LEAST, LEAST)
            alike[best] = tuple(n for n, g in gains.items() if n != best and g > enough)
            shares = self._unexplained(tuple(effects.values()), open_ones)
            for name in [n for n, share in shares.items() if share < 1 - EXPLAINED]:
                candidates[name].reason = looks_like(best)
                del open_ones[name], shares[name]
        if len(taken) == MOST:
            for candidate in open_ones.values():
                candidate.reason = f"not tested: the search stops after {MOST} causes"
        return self._ablated(taken, effects, current, candidates, alike)

    def _drop_unseen(
        self, open_ones: dict[str, Candidate], shares: Mapping[str, float], current: Trial
    ) -> None:
        """Leave those out that the first frames do not show, beyond what the effects taken do.

        Where something differs, also those are tried that could not be told from another effect.
        """
        sizes = {
            name: candidate.estimate.significance * shares.get(name, 1.0)
            for name, candidate in open_ones.items()
            if candidate.estimate is not None
        }
        least = SIGNIFICANT
        if flagged(compare(self.data, current.expected)):
            least = HINTED if max(sizes.values(), default=0.0) >= SIGNIFICANT else FAINT
        for name, size in sizes.items():
            candidate = open_ones[name]
            assert candidate.estimate is not None
            if size < least or candidate.estimate.effect.is_null:
                beside = f" in addition to {' and '.join(e.name for e in current.effects)}"
                candidate.reason = (
                    f"not significant ({size:.1f} sigma{beside if current.effects else ''})"
                )
                del open_ones[name]

    @staticmethod
    def _too_little(gain: float) -> str:
        """Why an effect that was tried is not taken."""
        if gain < LEAST:
            return "the held-out frames are not fitted better"
        return (
            f"the log-likelihood of the held-out frames rises by only {gain:.1f}; an effect of "
            f"weak significance needs {MIN_LOGLIK_GAIN_WEAK:g}"
        )

    @staticmethod
    def _least(candidate: Candidate) -> float:
        """By how much the unseen frames must become likelier with a candidate."""
        assert candidate.estimate is not None
        return LEAST if candidate.estimate.significance >= SIGNIFICANT else MIN_LOGLIK_GAIN_WEAK

    def held_against(self, effects: Effects, curves: list[Curves]) -> Trial:
        """A bench with some effects against the data, from its simulations."""
        return self._trial(effects, self._expected(curves))

    def _trial(self, effects: Effects, expected: Expectation) -> Trial:
        return Trial(effects, expected, log_likelihood(self.data, expected))

    def _tried(
        self,
        effects: Mapping[str, Effect],
        open_ones: dict[str, Candidate],
        shares: Mapping[str, float],
        current: Trial,
    ) -> tuple[dict[str, tuple[Trial, Effect]], dict[str, tuple[Trial, Effect]]]:
        """Each candidate added to the effects taken, in its likeliest way; and as replayed.

        As estimated, and without strengths that may be zero; as strong as that, and as what is left
        beside the effects taken. Log-likelihoods allow for other laws of the effects taken. A
        replay of single frames may imitate what another effect does by its law: it is apart.
        """
        options: list[tuple[str, Effect]] = []
        for name, candidate in open_ones.items():
            assert candidate.estimate is not None
            whole, sure = candidate.estimate.effect, candidate.estimate.sure
            ways = [whole, *([sure] if sure != whole else [])]
            if shares.get(name, 1.0) < 0.9:
                ways += [way.scaled(shares[name]) for way in ways]
            if candidate.replay is not None:
                ways.append(candidate.replay)
            candidate.ways = max(candidate.ways, len(ways))
            options += [(name, way) for way in ways]
        benches = [(*effects.values(), effect) for _, effect in options]
        simulated = self._simulate(benches, SCREEN, f"candidates, round {len(effects) + 1}", ())
        found: dict[str, tuple[Trial, Effect]] = {}
        replays: dict[str, tuple[Trial, Effect]] = {}
        refused: dict[str, str] = {}
        for (name, effect), bench, curves in zip(options, benches, simulated, strict=True):
            if isinstance(curves, str):
                refused[name] = f"cannot be simulated: {curves}"
                continue
            trial = self._trial(bench, self._expected(curves, open_ones[name]))
            trial = self._tolerant(trial, current)
            into = replays if effect == open_ones[name].replay else found
            if name not in into or trial.log_likelihood > into[name][0].log_likelihood:
                into[name] = trial, effect
        for name in refused.keys() - found.keys():
            open_ones.pop(name).reason = refused[name]
        return found, replays

    def _closer(self, replay: Trial, law: Trial) -> bool:
        """Whether a replay does better than the law: likelier, or less of the gap is left.

        A law that leaves single frames to chance allows for more, and may be as likely for that.
        """
        if replay.log_likelihood > law.log_likelihood:
            return True
        where = differing(self.nominal, replay, self.data) | differing(self.nominal, law, self.data)
        return self._left(replay, where) < self._left(law, where)

    def _left(self, trial: Trial, where: set[Key]) -> float:
        """Share of the gap that is left."""
        before = compare(self.data, self.nominal.expected)
        return remaining(before, compare(self.data, trial.expected), where).total

    def _tolerant(self, trial: Trial, taken: Trial) -> Trial:
        """A trial that allows for what other laws of the effects taken may do otherwise."""
        if not taken.effects:
            return trial
        nominal, variance = self.nominal.expected.mean, dict(trial.expected.variance)
        for key, mean in taken.expected.mean.items():
            variance[key] = variance[key] + (LAW_ERROR * (mean - nominal[key])) ** 2
        return self._trial(trial.effects, replace(trial.expected, variance=variance))

    def _expected(self, curves: list[Curves], candidate: Candidate | None = None) -> Expectation:
        error = 0.0
        if candidate is not None and candidate.estimate is not None:
            error = min(1.0, 1 / max(candidate.estimate.significance, 1.0))
        return expect_with(self.reference, curves, error)

    def _confirmed(
        self, effects: Effects, simulations: int = CONFIRM, asked: Sequence[str] = ()
    ) -> Trial | str:
        """A bench with some effects, or why it cannot be simulated."""
        (curves,) = self._simulate([effects], simulations, "confirm", asked)
        return curves if isinstance(curves, str) else self.held_against(effects, curves)

    def _start(self, effects: Effects, simulations: int = CONFIRM) -> Trial:
        """A bench with some effects; the nominal one where there are none, or it is refused.

        What has been simulated with more effects is hardly ever refused with fewer.
        """
        found = self._confirmed(effects, simulations) if effects else self.nominal
        return self.nominal if isinstance(found, str) else found

    def _unexplained(
        self, effects: Effects, open_ones: Mapping[str, Candidate]
    ) -> dict[str, float]:
        """Share of each candidate's significance that the effects taken do not bring about."""
        if not open_ones:
            return {}
        mimicked = self._estimates(effects, list(open_ones))
        shares = {}
        for name, candidate in open_ones.items():
            assert candidate.estimate is not None
            part = max(mimicked.get(name, 0.0), 0.0) / candidate.estimate.significance
            shares[name] = float(np.clip(1 - part, 0, 1))
        return shares

    def _ablated(
        self,
        taken: list[str],
        effects: dict[str, Effect],
        current: Trial,
        candidates: Mapping[str, Candidate],
        alike: Mapping[str, tuple[str, ...]],
    ) -> Found:
        """Leave each effect out again; drop those that are worth nothing beside the others."""
        while True:
            without = self._each_left_out(taken, effects)
            dropped = self._worthless(current, without) or self._doubtful(
                current, without, candidates
            )
            if dropped is None:
                break
            least, reason = dropped
            rest = tuple(e for n, e in effects.items() if n != least)
            fewer = self._confirmed(rest) if rest else self.nominal
            if isinstance(fewer, str):
                break
            candidates[least].reason = reason
            for candidate in candidates.values():
                if candidate.reason == looks_like(least):
                    candidate.reason = f"similar to {least}, which was rejected: {reason}"
            taken.remove(least)
            del effects[least]
            current = fewer
        for name in taken:
            # Of as many simulations as all together: three tell little of what is random.
            alone = self._confirmed((effects[name],))
            if not isinstance(alone, str):
                candidates[name].alone = alone
        return Found(
            self.nominal, current, tuple(taken), without, candidates,
            {n: near for n in taken if (near := tuple(a for a in alike[n] if a not in taken))},
            self._by_laws(effects, candidates),
        )  # fmt: skip

    def _by_laws(
        self, effects: Mapping[str, Effect], candidates: Mapping[str, Candidate]
    ) -> dict[str, Trial]:
        """Each effect alone as the best of its laws has it."""
        found = {}
        for name, effect in effects.items():
            law = candidates[name].by_law(effect)
            trial = None if law is None or law == effect else self._confirmed((law,), SCREEN)
            if isinstance(trial, Trial):
                found[name] = trial
        return found

    def _worthless(self, current: Trial, without: Mapping[str, Trial]) -> tuple[str, str] | None:
        """An effect without which the data are about as likely, and what to say of it."""
        worth = {
            n: self._tolerant(current, t).log_likelihood - self._tolerant(t, t).log_likelihood
            for n, t in without.items()
        }
        least = min(worth, key=lambda n: worth[n], default=None)
        if least is None or worth[least] >= LEAST:
            return None
        return least, "the other causes explain the data as well without it"

    def _doubtful(
        self,
        current: Trial,
        without: Mapping[str, Trial],
        candidates: Mapping[str, Candidate],
    ) -> tuple[str, str] | None:
        """An effect that closes little of the gap and may stand in for another.

        For an unknown one, if much of the gap stays open; for another law of those taken before
        it, if their law as it is brings about a good part of its significance, or if it has none.
        """
        where = differing(self.nominal, current, self.data)
        open_still = self._left(current, where)
        gains = {name: self._left(trial, where) - open_still for name, trial in without.items()}
        sizes = {n: e.significance for n in gains if (e := candidates[n].estimate) is not None}
        among = [
            n
            for n in gains
            if open_still > OPEN or candidates[n].share < 1 - LAW_ERROR or sizes[n] < SIGNIFICANT
        ]
        least = min(among, key=lambda n: gains[n], default=None)
        if least is None or gains[least] >= max(LITTLE, BESIDE_OPEN * open_still):
            return None
        closes = f"closes only {max(gains[least], 0):.1%} of the gap"
        if open_still > OPEN:
            return least, (
                f"{closes} while {open_still:.0%} stays unexplained; it may stand in for an "
                "unknown cause"
            )
        mimicked = f"the other causes bring about {1 - candidates[least].share:.0%} of its"
        why = (
            f"is not significant ({sizes[least]:.1f} sigma) in the frames that it was fitted to"
            if sizes[least] < SIGNIFICANT
            else f"{mimicked} significance"
        )
        return least, f"{closes}, and {why}; it may stand in for what their laws do not describe"

    def _each_left_out(
        self, taken: Sequence[str], effects: Mapping[str, Effect]
    ) -> dict[str, Trial]:
        benches = {
            name: tuple(e for n, e in effects.items() if n != name)
            for name in (taken if len(taken) > 1 else ())
        }
        # All at once, side by side; below they are at hand.
        self._simulate(list(benches.values()), CONFIRM, "each cause left out", ())
        return {name: self._start(benches.get(name, ())) for name in taken}
