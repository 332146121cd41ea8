"""Candidates of a search for causes, and its result."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from pixcal.simulation.effect import Effect, Estimate
from pixcal.stages.diagnose.comparison import Trial
from pixcal.stages.diagnose.trial import Effects

NEARLY_ALL = 0.9  # share of its significance above which a candidate is not scaled down


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
    def in_maps_alone(self) -> bool:
        """Whether it changes only static maps, which are common to all frames."""
        # The chance pattern of the offsets is then the same in the held-out frames.
        return self.estimate is not None and self.estimate.effect.domains == ("space",)

    @property
    def law(self) -> Effect | None:
        """The best-fitting law, if the estimate is a measured curve."""
        return None if self.estimate is None else self.estimate.by_law

    def variants(self, share: float) -> list[Effect]:
        """Effects to simulate: as estimated, significant part, by law, scaled down, replayed.

        ``share``: fraction of its significance that the accepted causes do not produce.
        """
        found = self.estimate
        assert found is not None
        laws = [self.law] if self.law else []
        variants = list(dict.fromkeys([found.effect, found.significant_part, *laws]))
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


@dataclass(frozen=True, eq=False)
class Addition:
    """A variant of a candidate, added to the causes."""

    name: str
    effect: Effect  # as simulated
    trial: Trial
    gain: float  # in log-likelihood, over as many simulations of the causes without it


Additions = dict[str, Addition]  # likeliest addition of each candidate, by its name


@dataclass
class Accepted:
    """Causes accepted so far."""

    current: Trial  # the bench with all of them
    # fraction of each remaining candidate's significance that the causes do not produce
    shares: dict[str, float]
    effects: dict[str, Effect] = field(default_factory=dict)  # by name, in the order of acceptance
    # by the name of a cause, the candidates that fit about as well
    alike: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def bench(self) -> Effects:
        """Effects of the bench with all causes."""
        return tuple(self.effects.values())


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
