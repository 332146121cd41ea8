"""Fibre positions from crests and valleys (paper, section 6, equation 7, and figure 17)."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from pixcal.kernels.medians import robust_sigma
from pixcal.kernels.optics import PARAMETERS, Geometry, phase, phase_jacobian
from pixcal.model.arrays import F64, Mask
from pixcal.model.errors import InputError
from pixcal.stages.crests.crests import CrestPaths

OUTLIER = 5.0  # robust standard deviations from the fit above which points are left out
MAP_POINTS = 400  # points used to compute a cost map, which is scaled to all points
NOTABLE_CHI2 = 3.0  # reduced chi-square of the points above which a warning is given


@dataclass(frozen=True)
class CrestFit:
    """Geometry fitted to crests and valleys."""

    geometry: Geometry
    phase0: float  # phase at the frame's centre, rad
    # (6, 6) mm², in the order of `PARAMETERS`, scaled by the spread; zero for fixed parameters
    covariance: F64
    used: Mask  # (point,) points that are not outliers
    residual: F64  # (point,) phase of the fit minus k pi, rad
    cost: float  # equation 7: sum of the squared residuals of the points used, rad²
    chi2_reduced: float  # weighted sum per degree of freedom
    # `max(1, chi2_reduced)`: factor on squared errors, because true pixel offsets also scatter
    # the points
    spread: float
    evaluations: int  # of the model, in the last fit
    nominal: Geometry
    prior: F64  # (6,) 1-sigma errors of the nominal geometry, mm

    @property
    def sigma(self) -> F64:
        """1-sigma errors, mm, in the order of `PARAMETERS`."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def from_prior(self) -> Mask:
        """Parameters (6,) that the prior constrains more than the points do."""
        return np.asarray(self.sigma > np.sqrt(0.5) * self.prior)

    def warnings(self) -> Iterator[str]:
        """Sentences on the scatter of the points and on outliers."""
        if self.chi2_reduced > NOTABLE_CHI2:
            yield (
                f"points scatter {np.sqrt(self.chi2_reduced):.1f} times more than their noise. The "
                "errors include this, but are too small if whole blocks of pixels are offset"
            )
        lost = int((~self.used).sum())
        if lost > 0.05 * len(self.used):
            yield f"{lost} of {len(self.used)} points are outliers and were left out"

    def geometry_facts(self) -> dict[str, float]:
        """Each parameter with its error, its nominal value and the error of the prior, mm."""
        nominal = self.nominal.vector()
        columns = np.array([self.geometry.vector(), self.sigma, nominal, self.prior])
        suffixes = ("_mm", "_sigma_mm", "_nominal_mm", "_prior_sigma_mm")
        names = [name + suffix for name in PARAMETERS for suffix in suffixes]
        return dict(zip(names, columns.T.ravel().tolist(), strict=True))


def relative_phase(paths: CrestPaths, geometry: Geometry) -> F64:
    """Model phase at the points, counted from the frame's centre, rad."""
    ry, rx = paths.reference
    return np.asarray(phase(paths.x, paths.y, geometry) - phase(rx, ry, geometry))


def fit_crests(paths: CrestPaths, nominal: Geometry, prior: F64) -> CrestFit:
    """Fit equation 7 by weighted least squares over fibre positions and phase.

    ``prior``: (6,) 1-sigma errors of the nominal geometry, mm, in the order of `PARAMETERS`; 0
    fixes a parameter, infinity frees it; equal for baseline_x and baseline_y.
    """
    # Distant starts converge (tested: 10 mm of distance, 18 mm of offset, 5 % of the baseline).
    # Without a prior, only a large window determines all six parameters.
    unknown, number = 1 + int(np.isinf(prior).sum()), len(np.unique(paths.k))
    if len(paths) <= unknown or number < 3:
        raise InputError(
            f"too few fringes: {len(paths)} points on {number} crests and valleys, {unknown} "
            "unknowns"
        )
    expected, sigma = _polar(nominal), prior.copy()
    sigma[ANGLE] /= expected[LENGTH]
    origin = expected
    used, spread = np.ones(len(paths), bool), 1.0
    for _ in range(4):
        some = paths.take(used)
        some = replace(some, sigma=some.sigma * np.sqrt(spread))
        solved, geometry, chain = _solve(some, nominal, origin, expected, sigma, 1e-15)
        origin = _polar(geometry)
        residual = float(solved.x[0]) + relative_phase(paths, geometry) - paths.k * np.pi
        pull = residual / paths.sigma
        chi2 = float((pull[used] ** 2).sum() / max(used.sum() - unknown, 1))
        kept = np.abs(pull) <= OUTLIER * max(robust_sigma(pull), 1.0)
        same = np.array_equal(kept, used) and abs(spread - max(1.0, chi2)) < 1e-3 * spread
        used, spread = kept, max(1.0, chi2)
        if same:
            break
    root = chain @ np.linalg.pinv(solved.jac, rcond=1e-13)[1:]
    return CrestFit(
        geometry,
        float(solved.x[0]),
        root @ root.T,
        used,
        residual,
        float((residual[used] ** 2).sum()),
        chi2,
        spread,
        int(solved.nfev),
        nominal,
        prior,
    )


DISTANCE, LENGTH, ANGLE = 2, 3, 4


def _polar(geometry: Geometry) -> F64:
    """The parameters, with length and direction (rad) of the baseline instead of its x and y."""
    x, y, distance, bx, by, bz = geometry.vector()
    return np.array([x, y, distance, np.hypot(bx, by), np.arctan2(by, bx), bz])


def _solve(
    paths: CrestPaths, base: Geometry, origin: F64, nominal: F64, sigma: F64, tolerance: float
) -> tuple[OptimizeResult, Geometry, F64]:
    """Least squares over phase and free polar parameters; solution, geometry, its slopes (6, n)."""
    free, weight, (ry, rx) = sigma > 0, 1 / paths.sigma, paths.reference
    precision, expected = 1 / sigma[free], nominal - origin
    expected[ANGLE] = np.angle(np.exp(1j * expected[ANGLE]))
    expected = (origin + expected)[free]

    def at(c: F64) -> tuple[Geometry, F64]:
        u, chain = origin.copy(), np.eye(len(origin))
        u[free] = c[1:]
        unit = np.array([np.cos(u[ANGLE]), np.sin(u[ANGLE])])
        chain[3:5, 3:5] = np.column_stack([unit, u[LENGTH] * unit[::-1] * [-1, 1]])
        u[3:5] = u[LENGTH] * unit
        return base.with_vector(u), chain[:, free]

    def residual(c: F64) -> F64:
        points = c[0] + relative_phase(paths, at(c)[0]) - paths.k * np.pi
        return np.concatenate([points * weight, (c[1:] - expected) * precision])

    def derivative(c: F64) -> F64:
        geometry, chain = at(c)
        here = phase_jacobian(paths.x, paths.y, geometry) - phase_jacobian(rx, ry, geometry)
        points = np.column_stack([np.ones(len(paths)), here @ chain]) * weight[:, None]
        return np.vstack([points, np.diag(np.append(0.0, precision))[1:]])

    start = np.append(0.0, origin[free])
    start[0] = np.mean(paths.k * np.pi - relative_phase(paths, at(start)[0]))
    tolerances = dict.fromkeys(("ftol", "xtol", "gtol"), tolerance)
    solved = least_squares(
        residual, start, derivative, method="lm", x_scale="jac", max_nfev=200, **tolerances
    )
    return solved, *at(solved.x)


def cost_map(
    paths: CrestPaths, fit: CrestFit, distance: F64, second: F64, *, ratio: bool, refit: bool
) -> F64:
    """Cost (d, s) of equation 7 over distance and B (mm) or, with ``ratio``, B / D: figure 17.

    The minimum ``fit`` gives errors, outliers and priors, except those of distance and length.
    ``refit``: at each place, refit centre, direction and tilt in addition to the phase.
    """
    few = _thinned(paths, fit)
    lengths = np.multiply.outer(distance if ratio else np.ones_like(distance), second)
    places = zip(distance, lengths, strict=True)
    return np.array([[_least_cost(few, fit, d, b, refit)[0] for b in row] for d, row in places])


def valley(paths: CrestPaths, fit: CrestFit, distance: F64) -> tuple[F64, F64]:
    """Best ratio B / D and its cost, (d,), at fixed distance (d,), mm (figure 17, right)."""
    # The other parameters are refitted, with the priors of `cost_map`.
    few = _thinned(paths, fit)
    cost, length = np.array([_least_cost(few, fit, d, None, True) for d in distance]).T
    return length / distance, cost


def _thinned(paths: CrestPaths, fit: CrestFit) -> CrestPaths:
    """A subset of the points used, with errors reduced to keep the total weight."""
    used = np.flatnonzero(fit.used)
    chosen = used[np.linspace(0, len(used) - 1, min(len(used), MAP_POINTS)).astype(int)]
    few = paths.take(chosen)
    return replace(few, sigma=few.sigma * np.sqrt(fit.spread * len(chosen) / len(used)))


def _least_cost(
    paths: CrestPaths, fit: CrestFit, distance: float, length: float | None, refit: bool
) -> tuple[float, float]:
    """Cost at fixed distance, and at fixed length unless that is None; and the length."""
    origin = _polar(fit.geometry)
    # At constant ratio the phases hardly change: this follows the valley.
    origin[LENGTH] *= distance / origin[DISTANCE]
    origin[DISTANCE] = distance
    sigma = fit.prior.copy() if refit else np.zeros(len(origin))
    sigma[ANGLE] /= origin[LENGTH]
    sigma[DISTANCE], sigma[LENGTH] = 0.0, np.inf
    if length is not None:
        origin[LENGTH], sigma[LENGTH] = length, 0.0
    expected = _polar(fit.nominal)
    solved, geometry, _ = _solve(paths, fit.geometry, origin, expected, sigma, 1e-9)
    return 2 * float(solved.cost), float(_polar(geometry)[LENGTH])


def falls_then_rises(cost: F64) -> bool:
    """Whether a curve (or every row of a map) falls to one minimum and rises after it."""
    # A map has one minimum if its rows and its valley each have one. Counting local minima of a
    # sampled map fails: a valley narrower than the samples shows many.
    steps = np.diff(np.atleast_2d(cost), axis=1)
    # Ignore the convergence error of the fits at each place.
    steps[np.abs(steps) < 1e-5 * np.atleast_2d(cost)[:, 1:]] = 0
    rising = np.cumsum(steps > 0, axis=1) > 0
    return not bool(np.any(rising & (steps < 0)))


def agreement(
    paths: CrestPaths, fit: CrestFit, facts: Mapping[str, Any] | None
) -> tuple[dict[str, Any] | None, str]:
    """Differences to the geometry of a set in ``fit.json`` (mm, and phases, px), or why none."""
    if facts is None:
        return None, "RUN/fit is not there yet"
    if facts["model"] != "hyperbolic":
        return None, f"the fit used {facts['model']} fringes, which give no positions of the fibres"
    fitted = facts["geometry"]
    other = fit.geometry.with_vector([fitted[f"{name}_mm"] for name in PARAMETERS])
    sigma = np.hypot(fit.sigma, [fitted[f"{name}_sigma_mm"] for name in PARAMETERS])
    difference = fit.geometry.vector() - other.vector()
    ny, nx = paths.frame
    y, x = (a.ravel() for a in np.mgrid[0 : ny - 1 : 33j, 0 : nx - 1 : 33j])
    apart = phase(x, y, fit.geometry) - phase(x, y, other)
    modes = phase_jacobian(x, y, fit.geometry)
    modes -= modes.mean(axis=0)
    expected = np.einsum("ni,ij,nj->n", modes, fit.covariance, modes)
    px = paths.interfringe / (2 * np.pi)
    values = (column.tolist() for column in (difference, sigma, fit.from_prior))
    of_each = zip(PARAMETERS, *values, strict=True)
    return {
        "parameters": {
            name: {"difference_mm": d, "sigma_mm": s, "difference_sigma": d / s, "from_prior": held}
            for name, d, s, held in of_each
        },
        "phase_rms_px": float(np.std(apart) * px),
        "phase_max_px": float(np.max(np.abs(apart - apart.mean())) * px),
        "phase_sigma_px": float(np.sqrt(expected.mean()) * px),
    }, ""
