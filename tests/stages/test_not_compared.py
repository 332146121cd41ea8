"""Statistics that the simulations lack are named."""

import numpy as np

from pixcal.estimators.test_statistics import DETECTOR, Curve
from pixcal.estimators.test_statistics.expectation import Reference
from pixcal.stages.diagnose.comparison import not_compared


def test_statistics_without_an_equal_in_the_simulations_are_named() -> None:
    """One is missing there, one has another number of values, one is compared."""
    rng = np.random.default_rng(4)

    def curves(levels: int) -> dict[tuple[str, str], Curve]:
        sizes = {("photon_transfer", DETECTOR): levels, ("outliers", "A"): 6}
        return {key: Curve(np.arange(n), rng.standard_normal(n)) for key, n in sizes.items()}

    measured = curves(5) | {("flat_neighbours", DETECTOR): Curve(np.arange(2), np.zeros(2))}
    data = Reference.of([curves(4) for _ in range(4)]).on_scale(measured)
    assert set(data) == {("outliers", "A")}
    assert not_compared(measured, data) == [
        "correlation of adjacent pixels in flat frames",
        "photon transfer: variance of flats against signal",
    ]
    assert not_compared({("outliers", "A"): measured["outliers", "A"]}, {}) == ["outliers of A"]
