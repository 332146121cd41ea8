"""Simulations of the benches of a search, within the number that the search may use."""

from collections.abc import Callable, Sequence

import numpy as np

from pixcal.simulation.effect import Effect
from pixcal.stages.diagnose.comparison import Comparison, Trial
from pixcal.stages.diagnose.trial import Curves, Effects

SCREEN_SIMULATIONS = 3  # simulations of a candidate,
CONFIRM_SIMULATIONS = 8  # and of the accepted causes
# most simulations of a search (two causes take about 80); number of samples that limits them if
# each has many; least number even then. Never the time: results must not depend on the machine.
SIMULATIONS, SEARCH_SAMPLES, LEAST_SIMULATIONS = 300, 3_000_000_000, 100


def affordable(samples: int) -> int:
    """Number of simulations that a search may use; each of ``samples`` samples."""
    return int(np.clip(SEARCH_SAMPLES // max(samples, 1), LEAST_SIMULATIONS, SIMULATIONS))


Simulate = Callable[[Sequence[Effects], int, str, Sequence[str]], Sequence[list[Curves] | str]]


class Benches:
    """Simulates benches, and counts.

    simulate : benches, seeds, label, candidates that are estimated on them -> statistics
    most : largest number of simulations
    """

    def __init__(self, comparison: Comparison, simulate: Simulate, most: int) -> None:
        self.comparison, self._ask, self.most = comparison, simulate, most
        self._made: dict[frozenset[Effect], int] = {}  # simulations of each bench

    @property
    def left(self) -> int:
        """Simulations that the search may still use."""
        return self.most - sum(self._made.values())

    def simulate(
        self, benches: Sequence[Effects], seeds: int, label: str, asked: Sequence[str]
    ) -> Sequence[list[Curves] | str]:
        """Statistics of each bench, or why it cannot be simulated; several run in parallel."""
        for bench in map(frozenset, benches):
            self._made[bench] = max(self._made.get(bench, 0), seeds)
        return self._ask(benches, seeds, label, asked)

    def confirmed(
        self, effects: Effects, simulations: int = CONFIRM_SIMULATIONS, asked: Sequence[str] = ()
    ) -> Trial | str:
        """A bench with the given effects, or why it cannot be simulated."""
        (curves,) = self.simulate([effects], simulations, "confirm", asked)
        return curves if isinstance(curves, str) else self.comparison.trial(effects, curves)

    def start(self, effects: Effects, simulations: int = CONFIRM_SIMULATIONS) -> Trial:
        """A bench with the given effects; the nominal one if there are none or they are refused."""
        # A bench that was simulated with more effects is hardly ever refused with fewer.
        nominal = self.comparison.nominal
        trial = self.confirmed(effects, simulations) if effects else nominal
        return nominal if isinstance(trial, str) else trial
