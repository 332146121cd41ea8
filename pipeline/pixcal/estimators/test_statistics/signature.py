"""Detection significance of an effect as one more statistic.

The test statistics cover everything, but each less sharply than the own estimate of an effect.
For candidates of weak significance in the fitted frames, the significance in the other frames is
a statistic too.
"""

import numpy as np

from pixcal.estimators.test_statistics import DETECTOR, Curve, Key, Statistic, known_statistics

STRAIGHT = 10.0  # standard deviations beyond which they count by their logarithm
_PREFIX, _INFIX = "estimate_of_", "_in_"


def signature_key(effect: str, domain: str) -> Key:
    """Key of the signature of an effect that shows in a domain."""
    return f"{_PREFIX}{effect}{_INFIX}{domain}", DETECTOR


def signature_curve(significance: float) -> Curve:
    """The curve, of one value."""
    size = abs(significance)
    if size > STRAIGHT:
        size = STRAIGHT * (1 + float(np.log(size / STRAIGHT)))
    return Curve(np.zeros(1), np.array([float(np.copysign(size, significance))]))


def statistic_named(name: str) -> Statistic:
    """A statistic of the test statistics, or the signature of an effect."""
    if name in known_statistics():
        return known_statistics()[name]
    effect, _, domain = name.removeprefix(_PREFIX).rpartition(_INFIX)
    title = f"detection significance of {effect}"

    def nothing(_: object) -> None:
        return None

    return Statistic(
        name, title, domain, "significance", "σ", "", "linear", False, False, FLOOR, nothing
    )


FLOOR = 0.7  # of a significance, by chance, at least
