"""Maximum-likelihood value of a nonlinear parameter of series."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.frame_series.variance_components import Components
from pixcal.model.arrays import F64

FARTHEST = 3.0  # largest error of the logarithm of a measured parameter
HALVINGS = 4  # of the distance to the values on either side


# components for a value of the parameter, from a start or None, after a number of steps if given
ProfiledFit = Callable[..., Components]


@dataclass(frozen=True)
class Profiled:
    """A parameter, and the components with it."""

    value: float
    error: float
    components: Components
    sides: tuple[Components, ...]  # a little below and above
    log_width: float = 0.0  # from the value to either side, of the logarithm

    def slope(self, sizes: Sequence[float]) -> float:
        """Change of a size for one error of the parameter, from its values at the sides."""
        if not self.sides:
            return 0.0
        log_error = self.error / self.value
        return abs(sizes[1] - sizes[0]) / (2 * self.log_width) * log_error


def best_shape(
    fit: ProfiledFit,
    trials: F64,
    steady: bool,
    start: Components | None = None,
    least: float = -np.inf,
) -> Profiled:
    """The best of values (n,), in equal steps of the logarithm, and between them.

    Likelihoods of a ``steady`` one, of known shapes, are compared without restriction. A best value
    that raises the log-likelihood of ``start`` by less than ``least`` is not refined.
    """

    def high(components: Components) -> float:
        return components.profile if steady else components.likelihood

    fits: list[Components] = []
    for value in trials:
        fits.append(fit(float(value), fits[-1] if fits else start, *((0,) if start else ())))
    best = int(np.argmax([high(one) for one in fits]))
    log_value = float(np.log(trials[best]))
    peak = fit(float(trials[best]), fits[best])
    width = float(np.log(trials[1] / trials[0]))
    if start and high(peak) - high(start) < least:
        return Profiled(float(trials[best]), np.inf, peak, ())
    for _ in range(HALVINGS):
        # A parabola through the three, ever closer; its curvature is the information.
        sides = tuple(fit(float(np.exp(log_value + w)), peak) for w in (-width, width))
        below, above = (high(side) - high(peak) for side in sides)
        curvature = -(below + above)
        error = width / np.sqrt(curvature) if curvature > 0 else np.inf
        shift = float(np.clip((above - below) / (2 * max(curvature, 1e-9)), -1, 1)) * width
        moved = fit(float(np.exp(log_value + shift)), peak)
        if high(moved) > high(peak):
            log_value, peak = log_value + shift, moved
        width /= 2
    value = float(np.exp(log_value))
    error = min(float(error), FARTHEST) * value
    return Profiled(value, error, peak, sides, log_width=2 * width)
