"""Which estimates are made of every simulation, as test statistics."""

import numpy as np
import pytest

from pixcal.effects.ipc import Ipc
from pixcal.effects.row_noise import RowNoise
from pixcal.estimators.test_statistics.gap import Difference
from pixcal.simulation.effect import Again, Effect, Estimate
from pixcal.stages.diagnose.candidates import Candidate, marginal_candidates
from pixcal.stages.diagnose.search_run import needs_slow

KINDS: dict[str, type[Effect]] = {"ipc": Ipc, "row_noise": RowNoise}


@pytest.mark.parametrize(
    ("crosstalk", "rows", "made", "in_the_dark"),
    [
        (6.0, 1.0, {Ipc}, set()),
        (6.0, 5.0, {Ipc, RowNoise}, {RowNoise}),
        (6.0, 9.0, {RowNoise}, {RowNoise}),
        (25.0, 5.0, {RowNoise}, {Ipc, RowNoise}),
        (25.0, 35.0, {RowNoise}, {RowNoise}),
        (3.0, 3.0, set(), set()),
    ],
)
def test_a_slow_estimate_is_a_statistic_only_if_the_strongest(
    crosstalk: float, rows: float, made: set[type[Effect]], in_the_dark: set[type[Effect]]
) -> None:
    assert not Ipc.quick
    assert RowNoise.quick
    sizes = {"ipc": crosstalk, "row_noise": rows}
    found = {n: Candidate(n, Estimate(KINDS[n](), {}, s, "")) for n, s in sizes.items()}
    assert set(marginal_candidates(found, KINDS)) == made
    assert set(marginal_candidates(found, KINDS, fringes=False)) == in_the_dark


@pytest.mark.parametrize(
    ("strongest", "simulates", "tested"),
    [(90.0, True, True), (130.0, True, False), (1000.0, False, True)],
)
def test_a_slow_score_test_is_no_statistic_beside_a_far_stronger_effect(
    strongest: float, simulates: bool, tested: bool
) -> None:
    """One that fits the maps alone is quick: a strong ghost hides no hyperbolic fringes."""
    again = Again(RowNoise(), lambda _: 5.0, simulates)
    found = {
        "ipc": Candidate("ipc", Estimate(Ipc(), {}, strongest, "")),
        "row_noise": Candidate("row_noise", Estimate(RowNoise(), {}, 5.0, "", again=again)),
    }
    assert marginal_candidates(found, KINDS) == ((again,) if tested else ())


@pytest.mark.parametrize(
    ("made", "log_chance", "needed"),
    [((Ipc, RowNoise), -2.0, True), ((Ipc, RowNoise), -40.0, False), ((RowNoise,), -2.0, False)],
    ids=["nothing differs", "a quick one differs", "none is slow"],
)
def test_a_slow_estimate_is_simulated_only_where_no_quick_statistic_differs(
    made: tuple[type[Effect], ...], log_chance: float, needed: bool
) -> None:
    quick = [kind for kind in made if kind.quick]
    differences = {("lines", "detector"): Difference(np.zeros(1), log_chance, 0.0)}
    assert needs_slow(made, quick, differences) is needed
