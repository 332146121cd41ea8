"""Candidates of a search for causes: effects estimated on the fitted frames; and its result."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from pixcal.engine.run import Runtime
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, Estimate
from pixcal.stages.diagnose.comparison import Trial
from pixcal.stages.diagnose.frames import FRINGES, MORE, FramesUsed
from pixcal.stages.diagnose.trial import Effects, Signature, each_of, estimate

NEARLY_ALL = 0.9  # share of its significance above which a candidate is not scaled down
# significance of a slow estimate up to which it is a test statistic, and without fringes from which
MAX_SLOW_SIGNIFICANCE, MIN_DARK_SIGNIFICANCE = 20.0, 10.0
# significance over that of the strongest candidate below which a score test on simulated frames is
# none: the strongest effect is likely to produce it
MIN_RELATIVE_SIGNIFICANCE = 0.05


@dataclass
class Candidate:
    """An effect that may be a cause."""

    name: str
    estimate: Estimate | None  # from the fitted frames
    reason: str = ""  # why it was rejected; empty when it was accepted
    needs: tuple[str, ...] = ()  # frames needed for an estimate, if there is none
    alone: Trial | None = None  # the bench with this effect only
    variants_tried: int = 1  # number of variants simulated; the likeliest one counts
    # fraction of its significance that the previously accepted causes do not produce
    share: float = 1.0
    replay: Effect | None = None  # the effect as measured, without a law

    @property
    def significance(self) -> float:
        """Significance of the estimate, sigma; zero without one."""
        return 0.0 if self.estimate is None else self.estimate.significance

    @property
    def usable(self) -> bool:
        """Whether there is an estimate that can be simulated."""
        return self.estimate is not None and not self.estimate.refused and self.significance > 0

    @property
    def domains(self) -> tuple[str, ...]:
        """Where its effect shows; empty without an estimate."""
        return () if self.estimate is None else self.estimate.effect.domains

    @property
    def in_maps_alone(self) -> bool:
        """Whether it changes only static maps, which are common to all frames."""
        # The chance pattern of the offsets is then the same in the held-out frames.
        return self.domains == ("space",)

    @property
    def law_predicts(self) -> bool:
        """Whether static maps confirm its law."""
        return self.estimate is not None and self.estimate.law_predicts

    @property
    def law(self) -> Effect | None:
        """The best-fitting law, if the estimate is a measured curve."""
        return None if self.estimate is None else self.estimate.by_law

    def variants(self, share: float) -> list[Effect]:
        """Effects to simulate: as estimated, significant part, by law, scaled down, replayed.

        ``share``: fraction of its significance that the accepted causes do not produce.
        """
        measured = self.estimate
        assert measured is not None
        laws = [self.law] if self.law else []
        variants = list(dict.fromkeys([measured.effect, measured.significant_part, *laws]))
        if share < NEARLY_ALL:
            variants += [one.scaled(share) for one in variants]
        if self.replay is not None:
            variants.append(self.replay)
        self.variants_tried = max(self.variants_tried, len(variants))
        return variants

    def by_law(self, effect: Effect) -> Effect | None:
        """The effect by its best-fitting law; None if the effect is itself a law."""
        assert self.estimate is not None
        if effect == self.replay:
            return self.estimate.effect
        return self.estimate.by_law


@dataclass(frozen=True)
class Considered:
    """Effects that a diagnosis considers, with their estimates from the fitted frames."""

    kinds: Mapping[str, type[Effect]] = field(default_factory=dict)  # that may be causes, by name
    base: Effects = ()  # that the nominal bench includes; they are no candidates
    signatures: tuple[Signature, ...] = ()  # whose estimates are test statistics
    candidates: Mapping[str, Candidate] = field(default_factory=dict)  # by name

    def estimated(self, evidence: Evidence, unseen: Evidence, runtime: Runtime) -> "Considered":
        """The same, with candidates measured on evidence; replays are of the unseen one."""
        there = {effect.name for effect in self.base}
        tried = {name: kind for name, kind in self.kinds.items() if name not in there}
        estimates = each_of(tried, partial(estimate, evidence), runtime, "estimate effects")
        candidates = {}
        for name, one in estimates.items():
            if isinstance(one, Estimate):
                candidates[name] = Candidate(name, one, one.refused, replay=_replayed(one, unseen))
            else:
                candidates[name] = Candidate(name, None, one or "")
        more = marginal_candidates(candidates, self.kinds, fringes=bool(evidence.fringes))
        return replace(self, signatures=(*self.signatures, *more), candidates=candidates)

    def note_missing(self, facts: FramesUsed) -> None:
        """Give candidates without an estimate the frames that they need, and the reason."""
        for name, candidate in self.candidates.items():
            if candidate.estimate is None and not candidate.reason:
                candidate.needs = _needs(self.kinds[name], facts)
                candidate.reason = (
                    f"cannot be estimated from these frames; record {' or '.join(candidate.needs)}"
                )

    @property
    def estimates(self) -> dict[str, Estimate]:
        """Estimates of the candidates that have one."""
        every = self.candidates.items()
        return {name: one.estimate for name, one in every if one.estimate is not None}


NO_EFFECTS = Considered()


def _replayed(measured: Estimate, unseen: Evidence) -> Effect | None:
    """The effect as measured, in full or frame by frame; None if its law is complete."""
    if measured.refused or measured.significance < SIGNIFICANT:
        return None
    if measured.in_full is not None:
        return measured.in_full
    try:
        replay = measured.effect.replayed(unseen)
    except (InputError, np.linalg.LinAlgError, ValueError, ArithmeticError):
        return None
    return None if replay is None or replay.is_null else replay


def _needs(kind: type[Effect], facts: FramesUsed) -> tuple[str, ...]:
    """Frames needed to estimate an effect."""
    if not facts.sets and not kind.remedy:
        return (FRINGES,)
    missing = facts.missing_frames
    frames = tuple(words for name, words in missing.items() if name in kind.frames_needed)
    # Without fringes, any missing frames of a sensor may show an effect of baselines or phases.
    there = facts.sets or {"dark", "flat"} & set(kind.frames_needed)
    return frames or (() if there else tuple(missing.values())) or (MORE,)


def marginal_candidates(
    candidates: Mapping[str, Candidate], kinds: Mapping[str, type[Effect]], *, fringes: bool = True
) -> tuple[Signature, ...]:
    """Candidates significant in the fitted frames; a slow one only if it is the strongest."""
    # With fringes only if it is weak, as a strong one shows in other statistics; without them only
    # if it is strong, as a weak one is slow to confirm. A score test that is weak compared with the
    # strongest candidate is left out.
    seen = {n: c.estimate for n, c in candidates.items() if c.estimate is not None}
    most = max((e.significance for e in seen.values()), default=0.0)
    strongest = most < MAX_SLOW_SIGNIFICANCE if fringes else most > MIN_DARK_SIGNIFICANCE
    # Sorted by name, since the order of candidates must not affect the curves.
    return tuple(
        one.again or kinds[name]
        for name, one in sorted(seen.items())
        if one.significance >= SIGNIFICANT
        and (
            one.again is None
            or not one.again.simulates
            or one.significance >= MIN_RELATIVE_SIGNIFICANCE * most
        )
        and (kinds[name].quick or (strongest and one.significance == most))
    )


@dataclass(frozen=True, eq=False)
class Addition:
    """A variant of a candidate, added to the causes."""

    name: str
    effect: Effect  # as simulated
    trial: Trial
    gain: float  # in log-likelihood, over as many simulations of the causes without it


Additions = dict[str, Addition]  # likeliest addition of each candidate, by its name


@dataclass(frozen=True)
class SearchResult:
    """Accepted causes, and the simulations that the decisions rest on."""

    nominal: Trial  # nominal, final: the bench without effects, and with all causes
    final: Trial
    accepted: tuple[str, ...]  # names of the causes, in the order of acceptance
    without: Mapping[str, Trial]  # the bench with all causes but one, by its name
    candidates: Mapping[str, Candidate]
    # by the name of a cause, the candidates that fit about as well
    alike: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    # the bench with one cause by its best-fitting law, by the name of the cause. A cause that is
    # itself a law is left out.
    by_law: Mapping[str, Trial] = field(default_factory=dict)


def likeliest(additions: Iterable[Addition]) -> Additions:
    """For each candidate, the addition with the largest gain."""
    best: Additions = {}
    for one in additions:
        if one.name not in best or one.gain > best[one.name].gain:
            best[one.name] = one
    return best
