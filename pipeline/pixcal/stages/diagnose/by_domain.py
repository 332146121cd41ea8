"""Differences by domain, and statistics that were not compared."""

from collections.abc import Mapping

from pixcal.estimators.test_statistics import DETECTOR, Curve, Key, known_statistics
from pixcal.estimators.test_statistics.expectation import statistic_named
from pixcal.estimators.test_statistics.gap import Difference, sigmas_among
from pixcal.model.arrays import F64
from pixcal.simulation.effect import DOMAINS


def by_domain(
    before: Mapping[Key, Difference], after: Mapping[Key, Difference]
) -> dict[str, list[float]]:
    """Largest deviation (sigma, at least 0) in each domain, before and after."""
    largest = {}
    for domain in DOMAINS:
        keys = [k for k in before if statistic_named(k[0]).domain == domain]
        largest[domain] = [
            rounded(sigmas_among(min(one[k].log_chance for k in keys), len(keys))) if keys else 0.0
            for one in (before, after)
        ]
    return largest


def not_compared(measured: Mapping[Key, Curve], data: Mapping[Key, F64]) -> list[str]:
    """Titles of measured statistics that simulations lack, or have in another form."""
    # Estimates used as statistics are left out: simulations compute some of them only when needed.
    known = known_statistics()
    return [
        statistic_named(name).title + ("" if of == DETECTOR else f" of {of}")
        for name, of in sorted(set(measured) - set(data))
        if name in known
    ]


def rounded(value: float) -> float:
    """To four digits."""
    return float(f"{value:.4g}")
