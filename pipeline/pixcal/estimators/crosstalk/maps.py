"""Couplings from the maps of a fit: visibility, and offsets at several baselines.

A pixel that gets the share k of one a step n away, and keeps the share o, has its fringe multiplied
by ``(o + sum k exp(-i K n)) / (o + sum k)``: flats suffer the same as the mean light, so the ratio
does not depend on them. Its size is seen in the visibility, its angle in the offset, as a shift of
``arg / |K|``. A true displacement, periodic or not, is the same at every K; so of the offsets only
what differs between sets counts, which needs more sets than the two axes. The visibility tells with
a single set, up to pixels of a row being wider than those of another (`WIDTH`).

Couplings that are known already are undone on the maps; what is left is linear in the rest.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.corrected import phase_change
from pixcal.estimators.crosstalk.links import MAX_PERIOD, MIN_REPEATS, REACH, Classes
from pixcal.estimators.detector import median_and_sigma
from pixcal.estimators.evidence import Evidence, FringeEvidence
from pixcal.estimators.fringes import grid, polynomial_basis
from pixcal.estimators.gauge import fringe_modes
from pixcal.kernels.crosstalk import Coupling, filled, outflow, uncouple_fringes

F64 = NDArray[np.float64]
C128 = NDArray[np.complex128]
Mask = NDArray[np.bool_]

WIDTH = 0.01
"""How much the pixels of a class may well be wider than others, px."""
DEGREE = 3
"""Of the polynomial that takes up what is smooth."""
MIN_PIXELS = 100
ALIGNED = 0.05
"""Fringe vectors that differ in direction by less (rad/px) lie on one axis."""


def map_information(evidence: Evidence, couplings: Sequence[Coupling]) -> tuple[F64, F64] | None:
    """Least-squares sums (n, n), (n,) of the shares, about those given; None without fringes."""
    sets = list(evidence.fringes.values())
    good = good_in_all(evidence)
    if not couplings or good.sum() < MIN_PIXELS:
        return None
    size = len(couplings)
    normal, right = np.zeros((size, size)), np.zeros(size)
    shifts, slopes = [], []
    smooth = smooth_modes(sets, good)
    for found in sets:
        theta = _undone(found, couplings)
        slope = _slope(found, couplings, good)
        y = without(log_visibility(theta, good), smooth)
        widths = without(_widths(found, couplings, good), smooth)
        own = _visibility(y, without(slope.real, smooth), widths)
        normal, right = normal + own[0], right + own[1]
        k = float(np.hypot(*found.k))
        change = phase_change(found.theta, theta)[good]
        shifts.append(without(found.delta[good] + change / k, smooth))
        slopes.append(without(slope.imag / k, smooth))
    weight = _apart_from_displacement(sets, good)
    y, j = np.stack(shifts), np.stack(slopes)
    weight /= max(1.0, _excess(y, weight, sets))
    normal += np.einsum("anp,ab,bmp->nm", j, weight, j, optimize=True)
    right += np.einsum("anp,ab,bp->n", j, weight, y, optimize=True)
    return normal, right + normal @ np.array([c.share for c in couplings])


def _excess(y: F64, weight: F64, sets: Sequence[FringeEvidence]) -> float:
    """Scatter (set, pixel) over that of the noise, as a reduced chi-square."""
    axes = np.array([s.k for s in sets])
    freedom = (len(sets) - int(np.linalg.matrix_rank(axes, tol=ALIGNED))) * y.shape[1]
    square = float(np.einsum("ap,ab,bp->", y, weight, y, optimize=True))
    return square / freedom if freedom else 1.0


def _undone(found: FringeEvidence, couplings: Sequence[Coupling]) -> F64:
    """The three maps without the couplings, as they were before they were divided by the flat."""
    theta = np.where(found.good, found.theta, np.nan) / found.shot_factor
    return uncouple_fringes(filled(theta, found.k), couplings, found.origin)


def good_in_all(evidence: Evidence) -> Mask:
    """Pixels that every fringe set has an offset of; none without sets.

    Those at the border of the part are left out: what they get from beyond it is not known.
    """
    sets = evidence.fringes.values()
    good: Mask = np.zeros(evidence.good.shape, bool)
    rows, columns = good.shape
    y, x = min(REACH, rows // 8), min(REACH, columns // 8)
    good[y : rows - y, x : columns - x] = len(sets) > 0
    for found in sets:
        good &= found.good & np.isfinite(found.delta)
    return good


def log_visibility(theta: F64, good: Mask) -> F64:
    """Logarithm of alpha / iota of the good pixels."""
    iota, sine, cosine = theta[:, good]
    return np.asarray(np.log(np.hypot(sine, cosine) / iota))


def smooth_modes(sets: Sequence[FringeEvidence], good: Mask) -> F64:
    """Orthonormal (mode, pixel): what is smooth, and the fringes that free intensities leave.

    The fringes of all sets together: what is taken off one map but not off another would leave true
    displacements in their difference.
    """
    shape = (good.shape[0], good.shape[1])
    y, x = grid(shape)
    modes = [polynomial_basis(shape, DEGREE)[good.ravel()].T]
    for found in sets:
        psi = np.broadcast_to(found.k[0] * x + found.k[1] * y, shape)[good]
        phasor = (found.theta[2] + 1j * found.theta[1])[good] * np.exp(-1j * psi)
        modes += fringe_modes(psi + np.angle(phasor.sum()), np.ones(len(psi)))
    return np.asarray(np.linalg.qr(np.vstack(modes).T)[0].T)


def without(values: F64, modes: F64) -> F64:
    """Values (..., pixel) freed of modes."""
    return np.asarray(values - (values @ modes.T) @ modes)


def _slope(found: FringeEvidence, couplings: Sequence[Coupling], good: Mask) -> C128:
    """Derivative (n, pixel) of the log of what couplings multiply the fringe by."""
    return _slope_at(found.k, couplings, good, found.origin)


def _slope_at(
    k: tuple[float, float], couplings: Sequence[Coupling], good: Mask, first: tuple[int, int]
) -> C128:
    shape = (good.shape[0], good.shape[1])
    light = 1 - outflow(couplings, shape, first)
    fringe = light.astype(complex)
    turns = [np.exp(-1j * (k[0] * c.dx + k[1] * c.dy)) for c in couplings]
    for c, turn in zip(couplings, turns, strict=True):
        there = c.places(shape, first)[1]
        light[there] += c.share
        fringe[there] += c.share * turn
    slope = np.zeros((len(couplings), *shape), np.complex128)
    for own, c, turn in zip(slope, couplings, turns, strict=True):
        here, there = c.places(shape, first)
        own[there] += turn / fringe[there] - 1 / light[there]
        own[here] -= 1 / fringe[here] - 1 / light[here]
    return np.asarray(slope[:, good])


def response_slopes(
    k: tuple[float, float], couplings: Sequence[Coupling], classes: Classes
) -> C128:
    """Derivative (n, class) of the log of what couplings multiply the fringe by.

    Parameters
    ----------
    k : (float, float)
        Fringe vector (kx, ky), rad/px.
    couplings : sequence of Coupling
        Of the period of the classes.
    classes : Classes
    """
    reach = max(max(abs(c.dy), abs(c.dx)) for c in couplings)
    rows, columns = (period * -(-reach // period) for period in (classes.rows, classes.columns))
    shape = (2 * rows + classes.rows, 2 * columns + classes.columns)
    inside = np.zeros(shape, bool)
    inside[rows : rows + classes.rows, columns : columns + classes.columns] = True
    return _slope_at(k, couplings, inside, (0, 0))


def _widths(found: FringeEvidence, couplings: Sequence[Coupling], good: Mask) -> F64:
    """Change of the log visibility where the receivers of a class are wider by 1 px."""
    k2 = found.k[0] ** 2 + found.k[1] ** 2
    patterns: dict[bytes, F64] = {}
    for c in couplings:
        pattern = np.zeros(good.shape)
        pattern[c.places((good.shape[0], good.shape[1]), found.origin)[1]] = k2 / 12
        patterns[pattern.tobytes()] = pattern[good]
    return np.stack(list(patterns.values()))


def _visibility(y: F64, slope: F64, widths: F64) -> tuple[F64, F64]:
    """Sums of the shares from the log visibility, the widths being free up to `WIDTH`."""
    weight = 1 / median_and_sigma(y)[1] ** 2
    inner = weight * widths @ widths.T + np.eye(len(widths)) / WIDTH**2
    cross = weight * slope @ widths.T
    taken = np.linalg.solve(inner, cross.T).T
    normal = weight * slope @ slope.T - taken @ cross.T
    return normal, weight * (slope @ y - taken @ (widths @ y))


def _apart_from_displacement(sets: Sequence[FringeEvidence], good: Mask) -> F64:
    """Weights (set, set) of offsets, px⁻², when a displacement of each pixel is free."""
    k = np.array([s.k for s in sets])
    axes = k / np.hypot(*k.T)[:, None]
    sigma = [np.median(s.sigma[good]) / np.hypot(*s.k) for s in sets]
    own = np.diag(np.array(sigma) ** -2)
    weight = own - own @ axes @ np.linalg.pinv(axes.T @ own @ axes, rcond=1e-6) @ axes.T @ own
    # Orthogonal axes leave rounding alone.
    return np.where(np.abs(weight) > 1e-9 * own.max(), weight, 0.0)


def map_periods(evidence: Evidence) -> dict[str, dict[str, tuple[int, int]]]:
    """Period (rows, columns) of delta and visibility of each set; 1 where there is none."""
    good = good_in_all(evidence)
    if good.sum() < MIN_PIXELS:
        return {}
    found = {}
    for name, fringes in evidence.fringes.items():
        smooth = smooth_modes([fringes], good)
        maps = {"delta": fringes.delta[good], "visibility": log_visibility(fringes.theta, good)}
        found[name] = {
            kind: _period(without(values, smooth), good, fringes.origin)
            for kind, values in maps.items()
        }
    return found


def _period(values: F64, good: Mask, first: tuple[int, int]) -> tuple[int, int]:
    y, x = np.nonzero(good)
    z = values / values.std()
    best = []
    for axis in range(2):
        scores = [0.0]
        for n in range(2, min(MAX_PERIOD, good.shape[axis] // MIN_REPEATS) + 1):
            classes = Classes(n, 1, first) if axis == 0 else Classes(1, n, first)
            number = classes.of(y, x)
            count = np.maximum(np.bincount(number, minlength=n), 1)
            power = float((np.bincount(number, z, n) ** 2 / count).sum())
            scores.append(power - (n - 1) * 2 * np.log(len(z)))
        best.append(1 + int(np.argmax(scores)))
    return best[0], best[1]
