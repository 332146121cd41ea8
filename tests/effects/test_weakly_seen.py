"""Which estimates are made of every simulation, as test statistics."""

import numpy as np
import pytest

from pixcal.effects.ipc import Ipc
from pixcal.effects.row_noise import RowNoise
from pixcal.estimators.diagnosis.expectation import Reference, expect_nominal
from pixcal.estimators.diagnosis.gap import compare
from pixcal.estimators.diagnosis.test_statistics import Curve, Key
from pixcal.simulation.effect import Effect, Estimate
from pixcal.stages.diagnose.candidates import Candidate
from pixcal.stages.diagnose.inquiry import outdone_by_others, weakly_seen

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
    ("slow", "other", "dropped"), [(9.0, 12.0, True), (12.0, 9.0, False), (9.0, 1.0, False)]
)
def test_a_slow_statistic_is_dropped_where_another_differs_by_more(
    slow: float, other: float, dropped: bool
) -> None:
    rng = np.random.default_rng(3)
    keys = [("harmonics", "a"), ("harmonics", "b")]

    def curves(sizes: tuple[float, float]) -> dict[Key, Curve]:
        return {
            key: Curve(np.zeros(1), size + rng.standard_normal(1))
            for key, size in zip(keys, sizes, strict=True)
        }

    reference = Reference.of([curves((0.0, 0.0)) for _ in range(64)])
    data = {keys[0]: np.array([slow]), keys[1]: np.array([other])}
    outdone = outdone_by_others(compare(data, expect_nominal(reference)), keys[:1])
    assert outdone == (set(keys[:1]) if dropped else set())
    assert (keys[0] in reference.without(outdone).values) is not dropped
