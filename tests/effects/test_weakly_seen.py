"""Which estimates are made of every simulation, as test statistics."""

import pytest

from pixcal.effects.ipc import Ipc
from pixcal.effects.row_noise import RowNoise
from pixcal.simulation.effect import Effect, Estimate
from pixcal.stages.diagnose.candidates import Candidate
from pixcal.stages.diagnose.inquiry import weakly_seen

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
