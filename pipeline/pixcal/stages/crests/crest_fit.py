"""Fibre positions from crests and valleys (paper, section 6, equation 7, and figure 17)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pixcal.estimators.fringe_fit.models.hyperbolic import (
    PRIOR_BASELINE,
    PRIOR_CENTRE_MM,
    PRIOR_DISTANCE,
    PRIOR_TILT,
)
from pixcal.kernels.optics import PARAMETERS, Geometry, phase, phase_jacobian
from pixcal.model.errors import InputError
from pixcal.stages.crests.crests import CrestPaths

F64 = NDArray[np.float64]

OUTLIER = 5.0  # points farther from the fit, in robust standard deviations, are left out
MAP_POINTS = 400  # points that a cost map is computed with; its numbers are scaled to all of them


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of the geometry."""

    nominal: Geometry
    # (6,) 1-sigma errors, mm, in the order of `PARAMETERS`; 0 holds a parameter, infinity frees
    # it
    sigma: F64

    @classmethod
    def of_bench(cls, nominal: Geometry) -> "Prior":
        """The errors that the hyperbolic fit assumes of a bench's nominal values."""
        length = float(np.hypot(nominal.baseline_x, nominal.baseline_y))
        return cls(
            nominal,
            np.array(
                [PRIOR_CENTRE_MM, PRIOR_CENTRE_MM, PRIOR_DISTANCE * nominal.distance]
                + [PRIOR_BASELINE * length] * 2
                + [PRIOR_TILT * length]
            ),
        )

    @classmethod
    def none(cls, nominal: Geometry) -> "Prior":
        """Nothing known: every parameter is free."""
        return cls(nominal, np.full(len(PARAMETERS), np.inf))


@dataclass(frozen=True)
class CrestFit:
    """Geometry fitted to crests and valleys."""

    geometry: Geometry
    phase0: float  # phase at the frame's centre, rad
    # (6, 6) mm², in the order of `PARAMETERS`, scaled by the spread; zero for what was held
    covariance: F64
    used: NDArray[np.bool_]  # (point,) points that are no outliers
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


def relative_phase(paths: CrestPaths, geometry: Geometry) -> F64:
    """Model phase at the points, counted from the frame's centre, rad."""
    ry, rx = paths.reference
    return np.asarray(phase(paths.x, paths.y, geometry) - phase(rx, ry, geometry))


def _jacobian(paths: CrestPaths, geometry: Geometry) -> F64:
    ry, rx = paths.reference
    here = phase_jacobian(paths.x, paths.y, geometry)
    return np.asarray(here - phase_jacobian(rx, ry, geometry))


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
    unknown = 1 + int(np.isinf(prior.sigma).sum())
    if len(paths) <= unknown or len(np.unique(paths.k)) < 3:
        raise InputError(
            f"too few fringes: {len(paths)} points on {len(np.unique(paths.k))} crests and "
            f"valleys, {unknown} unknowns"
        )
    used, spread = np.ones(len(paths), bool), 1.0
    geometry = start
    for _ in range(4):
        geometry, phase0, jacobian, steps = _minimise(paths.take(used), geometry, prior, spread)
        residual = phase0 + relative_phase(paths, geometry) - paths.k * np.pi
        pull = residual / paths.sigma
        chi2 = float((pull[used] ** 2).sum() / max(used.sum() - unknown, 1))
        limit = OUTLIER * max(1.4826 * float(np.median(np.abs(pull))), 1.0)
        kept = np.abs(pull) <= limit
        same = np.array_equal(kept, used) and abs(spread - max(1.0, chi2)) < 1e-3 * spread
        used, spread = kept, max(1.0, chi2)
        if same:
            break
    scale = _scale(prior)
    free_ones = prior.sigma > 0
    covariance = np.zeros((len(PARAMETERS), len(PARAMETERS)))
    root = np.linalg.pinv(jacobian, rcond=1e-13)
    inner = (root @ root.T)[1:, 1:] * np.outer(scale[free_ones], scale[free_ones])
    covariance[np.ix_(free_ones, free_ones)] = inner
    return CrestFit(
        geometry, phase0, covariance, used, residual, float((residual[used] ** 2).sum()),
        chi2, spread, steps, prior,
    )  # fmt: skip


def _scale(prior: Prior) -> F64:
    """Scale of each unknown, mm."""
    usual = Prior.of_bench(prior.nominal).sigma
    return np.where(np.isfinite(prior.sigma) & (prior.sigma > 0), prior.sigma, usual)


def _minimise(
    paths: CrestPaths, start: Geometry, prior: Prior, spread: float
) -> tuple[Geometry, float, F64, int]:
    """Geometry, phase, weighted Jacobian there (priors included), and evaluations."""
    free = prior.sigma > 0
    scale = _scale(prior)[free]
    nominal = prior.nominal.vector()
    origin = start.vector()
    origin[~free] = nominal[~free]
    precision = np.where(np.isfinite(prior.sigma[free]), scale / prior.sigma[free], 0.0)
    weight = 1 / (paths.sigma * np.sqrt(spread))
    target = paths.k * np.pi

    def at(c: F64) -> Geometry:
        values = origin.copy()
        values[free] += c[1:] * scale
        return start.with_vector(values)

    def residual(c: F64) -> F64:
        geometry = at(c)
        shift = (geometry.vector() - nominal)[free] / scale
        points = (c[0] + relative_phase(paths, geometry) - target) * weight
        return np.concatenate([points, shift * precision])

    def derivative(c: F64) -> F64:
        columns = _jacobian(paths, at(c))[:, free] * scale
        points = np.column_stack([np.ones(len(paths)), columns]) * weight[:, None]
        return np.vstack([points, np.column_stack([np.zeros(free.sum()), np.diag(precision)])])

    offset = float(np.mean(target - relative_phase(paths, start.with_vector(origin))))
    solution = least_squares(
        residual, np.concatenate([[offset], np.zeros(free.sum())]), derivative,
        method="lm", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=200,
    )  # fmt: skip
    return at(solution.x), float(solution.x[0]), derivative(solution.x), int(solution.nfev)


@dataclass(frozen=True)
class CostMap:
    """Cost of equation 7 around its minimum (paper, figure 17)."""

    distance: F64  # (d,) mm
    second: F64  # (s,) length of the baseline (mm), or its ratio to the distance
    cost: F64  # (d, s) sum of `(residual / sigma)²`, priors of the re-fitted parameters included
    # whether centre, direction and tilt of the baseline were fitted again at each place, as the
    # phase always is; else they are those of the minimum
    refitted: bool


def cost_map(
    paths: CrestPaths, fit: CrestFit, distance: F64, second: F64, *, ratio: bool, refit: bool
) -> CostMap:
    """Map of the cost over distance and baseline, or over distance and their ratio.

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
        See `CostMap`.
    """
    few = _thinned(paths, fit)
    cost = np.empty((len(distance), len(second)))
    for i, d in enumerate(distance):
        for j, value in enumerate(second):
            length = float(value * d if ratio else value)
            cost[i, j] = _least_cost(few, fit, float(d), length, refit=refit)[0]
    return CostMap(distance, second, cost, refit)


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

    Unknowns: phase, foot of the centre (x, y), direction, tilt, length of the baseline.
    """
    best, nominal = fit.geometry, fit.prior.nominal.vector()
    best_length = float(np.hypot(best.baseline_x, best.baseline_y))
    # With the ratio kept the phases hardly change: the way along the valley.
    first = best_length * distance / best.distance if length is None else length
    angle = float(np.arctan2(best.baseline_y, best.baseline_x))
    start = np.array([fit.phase0, best.centre_x, best.centre_y, angle, best.baseline_z, first])
    sigma = fit.prior.sigma
    free_length = np.inf if length is None else 0.0
    known = np.array([np.inf, *sigma[:2], sigma[4] / best_length, sigma[5], free_length])
    if not refit:
        known[1:5] = 0
    free = known > 0
    precision = np.where(free & np.isfinite(known), 1 / np.where(free, known, 1.0), 0.0)
    expected = np.array([0.0, *nominal[:2], np.arctan2(nominal[4], nominal[3]), nominal[5], 0.0])
    target, weight = paths.k * np.pi, 1 / paths.sigma

    def full(c: F64) -> tuple[F64, Geometry]:
        u = start.copy()
        u[free] = c
        along = u[5] * np.cos(u[3]), u[5] * np.sin(u[3])
        return u, best.with_vector([u[1], u[2], distance, *along, u[4]])

    def residual(c: F64) -> F64:
        u, geometry = full(c)
        points = (u[0] + relative_phase(paths, geometry) - target) * weight
        return np.concatenate([points, (u - expected) * precision])

    def derivative(c: F64) -> F64:
        u, geometry = full(c)
        j = _jacobian(paths, geometry)
        cos, sin = np.cos(u[3]), np.sin(u[3])
        turn, stretch = u[5] * (cos * j[:, 4] - sin * j[:, 3]), cos * j[:, 3] + sin * j[:, 4]
        columns = [np.ones(len(paths)), j[:, 0], j[:, 1], turn, j[:, 5], stretch]
        rows = np.stack(columns, axis=1) * weight[:, None]
        return np.vstack([rows, np.diag(precision)])[:, free]

    solved = least_squares(residual, start[free], derivative, method="lm", x_scale="jac", ftol=1e-9)
    return 2 * float(solved.cost), float(full(solved.x)[0][5])


def valley(paths: CrestPaths, fit: CrestFit, distance: F64) -> tuple[F64, F64]:
    """Best ratio B / D and its cost with the distance held (paper, figure 17, right).

    The other parameters are fitted again, with the priors that `cost_map` takes.

    Parameters
    ----------
    distance : (d,) float64
        mm.

    Returns
    -------
    ratio, cost : (d,) float64
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
