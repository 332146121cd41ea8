"""Other candidates in the place of an accepted cause.

A cause that was measured as a curve can take up what two effects do together; neither of them then
adds to it. So the strongest of the other candidates are tried together in its place.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

from pixcal.kernels.significance import SIGNIFICANT
from pixcal.simulation.effect import Effect
from pixcal.stages.diagnose.candidates import Candidate

STRONGEST = 3  # candidates that are tried in the place of others


@dataclass(frozen=True)
class Exchange:
    """Two candidates in the place of a cause."""

    out: str  # name of the cause
    effects: Mapping[str, Effect]  # all causes with them, by name
    new: tuple[str, str]  # names of the two

    @property
    def reason(self) -> str:
        """Why the cause is taken back."""
        return f"{' and '.join(self.new)} together explain the held-out frames better"


def exchanges(
    causes: Mapping[str, Effect], candidates: Mapping[str, Candidate]
) -> tuple[Exchange, ...]:
    """Every pair of the strongest other candidates, as measured, in the place of each cause."""
    sizes = {
        name: one.significance
        for name, one in candidates.items()
        if name not in causes and one.usable and one.significance >= SIGNIFICANT
        if one.estimate is not None and not one.estimate.effect.is_null
    }
    found = []
    for out in causes:
        rest = {name: effect for name, effect in causes.items() if name != out}
        strongest = sorted(sizes, key=lambda name: -sizes[name])[:STRONGEST]
        for new in combinations(strongest, 2):
            effects = rest | {name: _as_measured(candidates[name]) for name in new}
            found.append(Exchange(out, effects, new))
    return tuple(found)


def _as_measured(candidate: Candidate) -> Effect:
    assert candidate.estimate is not None
    return candidate.replay or candidate.estimate.effect
