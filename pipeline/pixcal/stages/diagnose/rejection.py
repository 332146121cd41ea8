"""Why a candidate is rejected, and which candidates may replace an accepted cause.

A candidate is rejected before acceptance, or after each cause was left out in turn. A cause
measured as a curve can absorb the joint effect of two others; neither then improves the fit. So
pairs of the strongest other candidates are tried in its place.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import combinations

from pixcal.estimators.test_statistics import Key
from pixcal.estimators.test_statistics.expectation import signature_key
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.simulation.effect import Effect, Estimate
from pixcal.stages.diagnose import thresholds
from pixcal.stages.diagnose.candidates import Candidate
from pixcal.stages.diagnose.comparison import Comparison, Trial

UNTRIED = ("not decided", "not tested", "cannot be simulated")  # how such reasons begin

Rejection = tuple[str, str]  # name of a cause, and why it is rejected
STRONGEST = 3  # candidates that are tried as replacements


def similar_to(name: str) -> str:
    """Why a candidate is no longer tried together with an accepted cause."""
    return f"explained by {name}, which has a similar signature"


def explained_by_other_law(name: str) -> str:
    """Why a cause is rejected that another one, as measured, makes redundant."""
    return f"{name}, as measured frame by frame, explains the data as well without it"


def needed_gain(candidate: Candidate) -> float:
    """Required gain in log-likelihood of the held-out frames for a candidate."""
    return (
        thresholds.MIN_LOGLIK_GAIN
        if candidate.significance >= SIGNIFICANT
        else thresholds.MIN_LOGLIK_GAIN_WEAK
    )


def gain_too_small(gain: float, candidate: Candidate) -> str:
    """Why a candidate that was tried is rejected."""
    if candidate.in_maps_alone and gain < thresholds.MIN_LOGLIK_GAIN:
        return (
            "its pattern in the held-out maps is no stronger than chance patterns of true offsets"
        )
    if gain < thresholds.MIN_LOGLIK_GAIN:
        return "does not improve the fit of the held-out frames"
    return (
        f"the log-likelihood of the held-out frames rises by only {gain:.1f}; an effect of weak "
        f"significance needs {thresholds.MIN_LOGLIK_GAIN_WEAK:g}"
    )


def redundant(
    comparison: Comparison, current: Trial, without: Mapping[str, Trial]
) -> Rejection | None:
    """Why a cause is rejected without which the held-out frames are about as likely."""
    gains = {name: comparison.gain_over(trial, current) for name, trial in without.items()}
    least = min(gains, key=lambda name: gains[name], default=None)
    if least is None or gains[least] >= thresholds.MIN_LOGLIK_GAIN:
        return None
    return least, "the other causes explain the data as well without it"


def possible_proxy(closed: float, still_open: float) -> str:
    """Why a cause is rejected that closes little of a large gap."""
    return (
        f"closes only {_weighted(closed)} while {100 * still_open:.0f} % of it stays open; it may "
        "be a proxy for an unknown cause"
    )


def _weighted(closed: float) -> str:
    return f"{100 * max(closed, 0):.1f} % of the gap weighted by significance"


def all_close_little(
    comparison: Comparison, alone: Iterable[tuple[str, Trial]]
) -> dict[str, float]:
    """Fraction of the gap that each candidate closes alone; empty unless all close little.

    This requires that together they close less than `MIN_JOINT_GAP_CLOSED`, and each less than a
    quarter of that: once a candidate closes more, others may become significant. If the fractions
    add up, `doubtful` would reject any set of these candidates. ``alone``: names of candidates, and
    benches with this one only.
    """
    if not comparison.differs(comparison.nominal):
        return {}
    trials = list(alone)
    where = comparison.gap_of(*(trial for _, trial in trials))
    closed: dict[str, float] = {}
    for name, trial in trials:
        closed[name] = max(1 - comparison.residual(trial, where), closed.get(name, 0.0))
    little = max(closed.values(), default=0.0) < thresholds.MIN_JOINT_GAP_CLOSED / 4
    return closed if little and sum(closed.values()) < thresholds.MIN_JOINT_GAP_CLOSED else {}


def unhelpful(
    comparison: Comparison,
    current: Trial,
    without: Mapping[str, Trial],
    candidates: Mapping[str, Candidate],
) -> Rejection | None:
    """Why a cause is rejected that does not reduce the differences left by the others."""
    # Where much of the gap stays open, also one that reduces none alone: it compensates others.
    where = comparison.gap_of(current)
    left = comparison.residual_size(current, where)
    gains = {n: comparison.residual_size(trial, where) - left for n, trial in without.items()}
    if left > thresholds.MAX_RESIDUAL_GAP and min(gains.values(), default=0.0) > 0:
        alone = {n: trial for n in gains if (trial := candidates[n].alone) is not None}
        gains = {n: 1 - comparison.residual_size(trial, where) for n, trial in alone.items()}
    least = min(gains, key=lambda n: gains[n], default=None)
    if least is None or gains[least] > 0:
        return None
    return least, "it does not reduce the differences; it may be a proxy for an unknown cause"


def _imitated(candidate: Candidate) -> bool:
    """Whether the causes produce much of its significance, or it has none."""
    return candidate.share < 1 - thresholds.LAW_ERROR or candidate.significance < SIGNIFICANT


def _own(candidate: Candidate) -> Key:
    """Key of its significance."""
    return signature_key(candidate.name, candidate.domains[0])


def settled(comparison: Comparison, fewer: Trial, trial: Trial, candidate: Candidate) -> bool:
    """Whether the data agree with all that a candidate changes: the rest has other causes.

    ``fewer``, ``trial``: without and with it.
    """
    # Held-out frames cannot refute static maps, or what was measured frame by frame on them. A law
    # that predicts part of the maps is tested by them, whatever else an unknown cause does there.
    fitted_there = candidate.in_maps_alone or candidate.replay in trial.effects
    return not _imitated(candidate) and (
        candidate.law_predicts
        or (not fitted_there and comparison.settles(_own(candidate), fewer, trial))
    )


def doubtful(
    comparison: Comparison,
    current: Trial,
    without: Mapping[str, Trial],
    candidates: Mapping[str, Candidate],
) -> Rejection | None:
    """Why a cause is rejected that closes little of the gap and may be a proxy for another."""
    # For an unknown cause: more stays open of a large gap than it closes, unless a candidate that
    # was not tried may be its cause. For another law of other causes: these produce much of its
    # significance, or it has none.
    strong = [one for one in candidates.values() if one.significance >= SIGNIFICANT]
    untried = any(one.reason.startswith(UNTRIED) for one in strong)
    where = comparison.gap_of(current)
    open_still = comparison.residual(current, where)
    unknown = open_still > thresholds.MAX_RESIDUAL_GAP
    imitated = {name for name in without if _imitated(candidates[name])}
    closed, left, needed = {}, {}, {}
    for name, trial in without.items():
        if settled(comparison, trial, current, candidates[name]):
            continue
        # Fitted and held-out frames agree in its significance, whatever the true cause.
        apart = {_own(candidates[name])} if unknown else set()
        left[name] = comparison.residual(current, where, apart)
        closed[name] = comparison.residual(trial, where, apart) - left[name]
        share = 1 if unknown and not untried else thresholds.MIN_SHARE_OF_RESIDUAL
        needed[name] = max(share * left[name], thresholds.MIN_GAP_CLOSED * (name in imitated))
    among = [name for name in closed if closed[name] < needed[name]]
    alone = [candidates[name].alone for name in closed]
    # Causes that only compensate each other.
    if unknown and all(
        one is not None and comparison.residual(one, where) > 1 - thresholds.MIN_GAP_CLOSED
        for one in alone
    ):
        among = list(closed)
    least = min(among, key=lambda name: closed[name], default=None)
    if least is None:
        return None
    if unknown or least not in imitated:
        return least, possible_proxy(closed[least], left[least])
    sigmas, mimicked = candidates[least].significance, 1 - candidates[least].share
    why = f"{100 * mimicked:.0f} % of its significance comes from the other causes"
    if sigmas < SIGNIFICANT:
        why = f"it is not significant ({sigmas:.1f} sigma) in the frames that it was fitted to"
    return (
        least,
        f"closes only {_weighted(closed[least])}, and {why}; it may only describe how the other "
        "causes deviate from their laws",
    )


@dataclass(frozen=True)
class Exchange:
    """Two candidates that replace a cause."""

    out: str  # name of the cause
    effects: Mapping[str, Effect]  # all causes with them, by name
    new: tuple[str, str]  # names of the two
    estimates: Mapping[str, Estimate] = field(default_factory=dict)  # measured anew, by name

    @property
    def reason(self) -> str:
        """Why the cause is rejected."""
        return f"{' and '.join(self.new)} together explain the held-out frames better"


def _other(causes: Mapping[str, Effect], candidates: Mapping[str, Candidate]) -> list[str]:
    """Other candidates that are significant, the strongest first."""
    names = (
        name
        for name, one in candidates.items()
        if name not in causes and one.usable and one.significance >= SIGNIFICANT
        if one.estimate is not None and not one.estimate.effect.is_null
    )
    return sorted(names, key=lambda name: -candidates[name].significance)


def exchanges(
    causes: Mapping[str, Effect], candidates: Mapping[str, Candidate]
) -> tuple[Exchange, ...]:
    """Replace each cause by every pair of the strongest other candidates, as measured."""
    swaps = []
    for out in causes:
        rest = {name: effect for name, effect in causes.items() if name != out}
        for new in combinations(_other(causes, candidates)[:STRONGEST], 2):
            effects = rest | {name: _as_measured(candidates[name]) for name in new}
            swaps.append(Exchange(out, effects, new))
    return tuple(swaps)


def entangled(
    causes: Mapping[str, Effect], candidates: Mapping[str, Candidate]
) -> list[tuple[str, str]]:
    """Each cause with the strongest other candidate of its domains, whose effect it may absorb."""

    def steady(name: str) -> bool:
        estimate, replay = candidates[name].estimate, candidates[name].replay
        # What the maps confirm holds no other effect.
        confirmed = candidates[name].law_predicts
        return estimate is not None and replay == estimate.in_full and not confirmed

    pairs = []
    for out in filter(steady, causes):
        domains = set(candidates[out].domains)
        others = (n for n in _other(causes, candidates) if domains & set(candidates[n].domains))
        pairs += [(out, n) for n in others if steady(n)][:1]
    return pairs


def _as_measured(candidate: Candidate) -> Effect:
    assert candidate.estimate is not None
    return candidate.replay or candidate.estimate.effect
