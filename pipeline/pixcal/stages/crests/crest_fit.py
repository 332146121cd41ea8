"""Fibre positions from crests and valleys (paper, section 6, equation 7, and figure 17)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from pixcal.estimators.fringe_fit.models.hyperbolic import (
    PRIOR_BASELINE,
    PRIOR_CENTRE_MM,
    PRIOR_DISTANCE,
    PRIOR_TILT,
)
from pixcal.kernels.optics import PARAMETERS, Geometry, phase, phase_jacobian
from pixcal.model.arrays import F64, Mask
from pixcal.model.errors import InputError
from pixcal.stages.crests.crests import CrestPaths

# unknowns (n,) but the phase -> the geometry, and derivatives (6, n) of its parameters
Parametrisation = Callable[[F64], tuple[Geometry, F64]]

OUTLIER = 5.0  # points farther from the fit, in robust standard deviations, are left out
MAP_POINTS = 400  # points that a cost map is computed with; its numbers are scaled to all of them


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of the geometry."""

    nominal: Geometry
    # (6,) 1-sigma errors, mm, in the order of `PARAMETERS`; 0 holds a parameter, infinity frees it
    sigma: F64

    @classmethod
    def of_bench(cls, nominal: Geometry) -> "Prior":
        """The errors that the hyperbolic fit assumes of a bench's nominal values."""
        length = float(np.hypot(nominal.baseline_x, nominal.baseline_y))
        plane = [PRIOR_CENTRE_MM, PRIOR_CENTRE_MM, PRIOR_DISTANCE * nominal.distance]
        baseline = [PRIOR_BASELINE * length, PRIOR_BASELINE * length, PRIOR_TILT * length]
        return cls(nominal, np.array(plane + baseline))

    @classmethod
    def none(cls, nominal: Geometry) -> "Prior":
        """Nothing known: every parameter is free."""
        return cls(nominal, np.full(len(PARAMETERS), np.inf))

    @property
    def scale(self) -> F64:
        """Scale of each unknown, mm."""
        known = np.isfinite(self.sigma) & (self.sigma > 0)
        return np.where(known, self.sigma, Prior.of_bench(self.nominal).sigma)


@dataclass(frozen=True)
class CrestFit:
    """Geometry fitted to crests and valleys."""

    geometry: Geometry
    phase0: float  # phase at the frame's centre, rad
    # (6, 6) mm², in the order of `PARAMETERS`, scaled by the spread; zero for what was held
    covariance: F64
    used: Mask  # (point,) points that are no outliers
    residual: F64  # (point,) phase of the fit minus k pi, rad
    cost: float  # equation 7: sum of the squared residuals of the points used, rad²
    chi2_reduced: float  # the same weighted, for each degree of freedom
    # `max(1, chi2_reduced)`: squares of errors are scaled by it, since true offsets of the
    # pixels scatter the points too
    spread: float
    evaluations: int  # of the model, in the last fit
    prior: Prior

    @property
    def sigma(self) -> F64:
        """1-sigma errors, mm, in the order of `PARAMETERS`."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def from_prior(self) -> Mask:
        """Parameters (6,) that the prior constrains more than the points."""
        return np.asarray(self.sigma > np.sqrt(0.5) * self.prior.sigma)


def relative_phase(paths: CrestPaths, geometry: Geometry) -> F64:
    """Model phase at the points, counted from the frame's centre, rad."""
    ry, rx = paths.reference
    return np.asarray(phase(paths.x, paths.y, geometry) - phase(rx, ry, geometry))


def fit_crests(paths: CrestPaths, start: Geometry, prior: Prior | None = None) -> CrestFit:
    """Weighted least squares of equation 7 over fibre positions and phase.

    Parameters
    ----------
    start : Geometry
        Where to begin; far starts converge (tested: 10 mm of distance, 18 mm of offset, 5 % of
        the baseline).
    prior : Prior, optional
        Default `Prior.none`: only a large window determines all six parameters.

    Raises
    ------
    InputError
        If there are fewer points than unknowns, or they lie on fewer than three paths.
    """
    prior = Prior.none(start) if prior is None else prior
    unknown, number = 1 + int(np.isinf(prior.sigma).sum()), len(np.unique(paths.k))
    if len(paths) <= unknown or number < 3:
        raise InputError(
            f"too few fringes: {len(paths)} points on {number} crests and valleys, {unknown} "
            "unknowns"
        )
    used, spread, geometry = np.ones(len(paths), bool), 1.0, start
    for _ in range(4):
        some = paths.take(used)
        solved, at = _minimise(replace(some, sigma=some.sigma * np.sqrt(spread)), geometry, prior)
        geometry, phase0 = at(solved.x[1:])[0], float(solved.x[0])
        residual = phase0 + relative_phase(paths, geometry) - paths.k * np.pi
        pull = residual / paths.sigma
        chi2 = float((pull[used] ** 2).sum() / max(used.sum() - unknown, 1))
        limit = OUTLIER * max(1.4826 * float(np.median(np.abs(pull))), 1.0)
        kept = np.abs(pull) <= limit
        same = np.array_equal(kept, used) and abs(spread - max(1.0, chi2)) < 1e-3 * spread
        used, spread = kept, max(1.0, chi2)
        if same:
            break
    # From (phase, unknowns) to the parameters in mm.
    root = at(solved.x[1:])[1] @ np.linalg.pinv(solved.jac, rcond=1e-13)[1:]
    return CrestFit(
        geometry, phase0, root @ root.T, used, residual, float((residual[used] ** 2).sum()),
        chi2, spread, int(solved.nfev), prior,
    )  # fmt: skip


def _minimise(
    paths: CrestPaths, start: Geometry, prior: Prior
) -> tuple[OptimizeResult, Parametrisation]:
    """Least squares over what the prior does not hold, in units of `Prior.scale`."""
    free, nominal = prior.sigma > 0, prior.nominal.vector()
    origin = np.where(free, start.vector(), nominal)
    unit = np.diag(prior.scale)[:, free]

    def at(c: F64) -> tuple[Geometry, F64]:
        return start.with_vector(origin + unit @ c), unit

    expected = ((nominal - origin) / prior.scale)[free]
    precision = (prior.scale / np.where(free, prior.sigma, 1.0))[free]
    shift = paths.k * np.pi - relative_phase(paths, start.with_vector(origin))
    first = np.append(shift.mean(), np.zeros(free.sum()))
    exact = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "max_nfev": 200}
    return _least_squares(paths, at, first, expected, precision, **exact), at


def _least_squares(
    paths: CrestPaths, at: Parametrisation, start: F64, expected: F64, precision: F64, **limits: Any
) -> OptimizeResult:
    """Phase and unknowns (1 + n,) that the points, and prior knowledge of the unknowns, suggest.

    That is their expected values and inverse errors, (n,).
    """
    weight, (ry, rx) = 1 / paths.sigma, paths.reference

    def residual(c: F64) -> F64:
        points = c[0] + relative_phase(paths, at(c[1:])[0]) - paths.k * np.pi
        return np.concatenate([points * weight, (c[1:] - expected) * precision])

    def derivative(c: F64) -> F64:
        geometry, chain = at(c[1:])
        here = phase_jacobian(paths.x, paths.y, geometry) - phase_jacobian(rx, ry, geometry)
        points = np.column_stack([np.ones(len(paths)), here @ chain]) * weight[:, None]
        return np.vstack([points, np.diag(np.append(0.0, precision))[1:]])

    return least_squares(residual, start, derivative, method="lm", x_scale="jac", **limits)


def cost_map(
    paths: CrestPaths, fit: CrestFit, distance: F64, second: F64, *, ratio: bool, refit: bool
) -> F64:
    """Cost of equation 7 over distance and baseline, or over distance and their ratio (figure 17).

    Parameters
    ----------
    fit : CrestFit
        The minimum, whose errors, outliers and priors are taken over. Priors of distance and
        length do not count: the map shows what the points say of these.
    distance : (d,) float64
        mm.
    second : (s,) float64
        B in mm or, with ``ratio``, B / D. B is the length in the detector's plane.
    refit : bool
        Whether centre, direction and tilt of the baseline are fitted again at each place, as the
        phase always is; else they are those of the minimum.

    Returns
    -------
    (d, s) float64
        Sum of ``(residual / sigma)²``, priors of the parameters fitted again included.
    """
    few = _thinned(paths, fit)
    lengths = np.multiply.outer(distance, second) if ratio else np.tile(second, (len(distance), 1))
    return np.array(
        [
            [_least_cost(few, fit, float(d), float(length), refit=refit)[0] for length in row]
            for d, row in zip(distance, lengths, strict=True)
        ]
    )


def _thinned(paths: CrestPaths, fit: CrestFit) -> CrestPaths:
    """A subset of the points used, with errors reduced to keep the total weight."""
    used = np.flatnonzero(fit.used)
    chosen = used[np.linspace(0, len(used) - 1, min(len(used), MAP_POINTS)).astype(int)]
    few = paths.take(chosen)
    return replace(few, sigma=few.sigma * np.sqrt(fit.spread * len(chosen) / len(used)))


def _least_cost(
    paths: CrestPaths, fit: CrestFit, distance: float, length: float | None, *, refit: bool
) -> tuple[float, float]:
    """Cost with the distance held, and the length too unless it is None; and that length.

    Unknowns beside the phase: foot of the centre (x, y), direction, tilt and length of the
    baseline.
    """
    best, nominal, sigma = fit.geometry, fit.prior.nominal, fit.prior.sigma
    best_length = float(np.hypot(best.baseline_x, best.baseline_y))
    # With the ratio kept the phases hardly change: the way along the valley.
    first = best_length * distance / best.distance if length is None else length
    angle = np.arctan2(best.baseline_y, best.baseline_x)
    start = np.array([best.centre_x, best.centre_y, angle, best.baseline_z, first])
    angle = np.arctan2(nominal.baseline_y, nominal.baseline_x)
    expected = np.array([nominal.centre_x, nominal.centre_y, angle, nominal.baseline_z, 0.0])
    known = np.array([*sigma[:2], sigma[4] / best_length, sigma[5], np.inf])
    free = (known > 0) & ([refit] * 4 + [length is None])

    def at(c: F64) -> tuple[Geometry, F64]:
        u = start.copy()
        u[free] = c
        x, y, angle, tilt, b = u
        cos, sin = np.cos(angle), np.sin(angle)
        chain = np.zeros((len(PARAMETERS), len(u)))
        chain[[0, 1, 5], [0, 1, 3]] = 1
        chain[3:5, 2], chain[3:5, 4] = (-b * sin, b * cos), (cos, sin)
        return best.with_vector([x, y, distance, b * cos, b * sin, tilt]), chain[:, free]

    first_guess = np.append(fit.phase0, start[free])
    solved = _least_squares(paths, at, first_guess, expected[free], 1 / known[free], ftol=1e-9)
    geometry = at(solved.x[1:])[0]
    return 2 * float(solved.cost), float(np.hypot(geometry.baseline_x, geometry.baseline_y))


def valley(paths: CrestPaths, fit: CrestFit, distance: F64) -> tuple[F64, F64]:
    """Best ratio B / D and its cost, (d,), with the distance (d,) mm held (figure 17, right).

    The other parameters are fitted again, with the priors that `cost_map` takes.
    """
    few = _thinned(paths, fit)
    results = [_least_cost(few, fit, float(d), None, refit=True) for d in distance]
    cost, length = np.array(results).T
    return length / distance, cost


def falls_then_rises(cost: F64) -> bool:
    """Whether a curve (or every row of a map) falls to one minimum and rises after it.

    A map whose rows do, and whose valley does, has one minimum. Counting the low places of a
    sampled map would not tell: a valley narrower than the samples shows many.
    """
    steps = np.diff(np.atleast_2d(cost), axis=1)
    # What the fits at each place leave undone.
    steps[np.abs(steps) < 1e-5 * np.atleast_2d(cost)[:, 1:]] = 0
    rising = np.cumsum(steps > 0, axis=1) > 0
    return not bool(np.any(rising & (steps < 0)))
