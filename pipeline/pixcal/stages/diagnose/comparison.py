"""Simulated benches compared with the held-out frames."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from pixcal.estimators.diagnosis.expectation import (
    Expectation,
    Reference,
    expect_nominal,
    expect_with,
)
from pixcal.estimators.diagnosis.gap import (
    CHANCE,
    compare,
    flagged,
    likelier,
    log_likelihood,
    remaining,
)
from pixcal.estimators.diagnosis.test_statistics import Key
from pixcal.model.arrays import F64
from pixcal.stages.diagnose.shrinkage import Trial, differing
from pixcal.stages.diagnose.trial import Curves, Effects

# relative error of an effect's law: a second cause needs evidence that another law of the first
# would not produce
LAW_ERROR = 0.25


class Comparison:
    """Likelihoods and residual gaps of simulated benches.

    Parameters
    ----------
    reference : of the nominal bench
    data : test statistics of the held-out frames, on the scales of the reference
    """

    def __init__(self, reference: Reference, data: Mapping[Key, F64]) -> None:
        self.reference, self.data = reference, data
        self.nominal = self._trial((), expect_nominal(reference))

    def trial(
        self, effects: Effects, curves: Sequence[Curves], significance: float = np.inf
    ) -> Trial:
        """A bench with some effects, from its simulations.

        Parameters
        ----------
        curves : of the simulations
        significance : of the added effect, sigma: its strength has a relative error of one over it
        """
        error = 1 / max(significance, 1.0)
        return self._trial(effects, expect_with(self.reference, curves, error))

    def allowing_for_laws(self, trial: Trial, accepted: Trial) -> Trial:
        """A trial that allows for other laws of the effects accepted before."""
        if not accepted.effects:
            return trial
        nominal, variance = self.nominal.expected.mean, dict(trial.expected.variance)
        for key, mean in accepted.expected.mean.items():
            variance[key] = variance[key] + (LAW_ERROR * (mean - nominal[key])) ** 2
        return self._trial(trial.effects, replace(trial.expected, variance=variance))

    def gain_where_differing(self, start: Trial, trial: Trial, own: Key) -> float:
        """Rise of the log-likelihood by the test statistics that differ from ``start``.

        ``own`` is the significance of the effect that is added: one statistic, not the worst of
        all.
        """
        gains = likelier(self.data, start.expected, trial.expected)
        differences = compare(self.data, start.expected)
        where = flagged(differences)
        if own in differences and differences[own].log_chance < np.log(CHANCE):
            where.add(own)
        return sum(gains[key] for key in where)

    def differs(self, trial: Trial) -> bool:
        """Whether any test statistic of the data differs from a bench by more than chance."""
        return bool(flagged(compare(self.data, trial.expected)))

    def residual(self, trial: Trial, where: set[Key]) -> float:
        """Fraction of the gap that a bench leaves.

        ``where``: test statistics that make up the gap.
        """
        before = compare(self.data, self.nominal.expected)
        return remaining(before, compare(self.data, trial.expected), where).total

    def gap_of(self, *trials: Trial) -> set[Key]:
        """Test statistics that make up the gap, for these benches together."""
        return set().union(*(differing(self.nominal, trial, self.data) for trial in trials))

    def replay_fits_better(self, replay: Trial, law: Trial) -> bool:
        """Whether a replay is likelier than the law, or leaves less of the gap.

        A law that leaves single frames to chance allows for more, and may be as likely for that.
        """
        if replay.log_likelihood > law.log_likelihood:
            return True
        where = self.gap_of(replay, law)
        return self.residual(replay, where) < self.residual(law, where)

    def _trial(self, effects: Effects, expected: Expectation) -> Trial:
        return Trial(effects, expected, log_likelihood(self.data, expected))
