"""Which estimates are made of every simulation, as test statistics."""

import numpy as np
import pytest

from pixcal.effects.ipc import Ipc
from pixcal.effects.row_noise import RowNoise
from pixcal.estimators.diagnosis.expectation import Reference, expect_nominal
from pixcal.estimators.diagnosis.gap import compare
from pixcal.estimators.diagnosis.test_statistics import Curve
from pixcal.estimators.diagnosis.test_statistics.signature import signature_key
from pixcal.simulation.effect import Effect, Estimate
from pixcal.stages.diagnose.candidates import Candidate
from pixcal.stages.diagnose.inquiry import REFERENCES, outdone_by_others, weakly_seen

KINDS: dict[str, type[Effect]] = {"ipc": Ipc, "row_noise": RowNoise}


@pytest.mark.parametrize(
    ("crosstalk", "rows", "made"),
    [
        (6.0, 1.0, {Ipc}),
        (6.0, 5.0, {Ipc, RowNoise}),
        (6.0, 9.0, {RowNoise}),
        (25.0, 5.0, {RowNoise}),
        (3.0, 3.0, set()),
    ],
    ids=["slow alone", "slow is strongest", "slow is weaker", "slow is clear", "none is seen"],
)
def test_a_slow_estimate_is_a_statistic_only_if_weak_and_the_strongest(
    crosstalk: float, rows: float, made: set[type[Effect]]
) -> None:
    assert not Ipc.quick
    assert RowNoise.quick
    sizes = {"ipc": crosstalk, "row_noise": rows}
    found = {n: Candidate(n, Estimate(KINDS[n](), {}, s, "")) for n, s in sizes.items()}
    assert set(weakly_seen(found, KINDS)) == made


@pytest.mark.parametrize(
    ("slow", "other", "outdone"),
    [(9.0, 18.0, True), (18.0, 9.0, False), (9.0, 1.0, False), (None, 18.0, True)],
)
def test_a_slow_statistic_is_not_simulated_where_another_differs_by_more(
    slow: float | None, other: float, outdone: bool
) -> None:
    rng = np.random.default_rng(3)
    quick, wanted = ("harmonics", "a"), signature_key("ipc", "space")
    none = [{quick: Curve(np.zeros(1), rng.standard_normal(1))} for _ in range(REFERENCES)]
    measured = {quick: Curve(np.zeros(1), np.array([other]))}
    if slow is not None:
        measured[wanted] = Curve(np.zeros(1), np.array([slow]))
    reference = Reference.of(none)
    differences = compare(reference.on_scale(measured), expect_nominal(reference))
    assert outdone_by_others(differences, measured, [wanted]) == ({wanted} if outdone else set())
