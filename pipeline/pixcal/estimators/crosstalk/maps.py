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

from pixcal.estimators.crosstalk.links import REACH, PixelClasses
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.fringe_fit.fringes import grid, polynomial_basis
from pixcal.estimators.fringe_fit.gauge import fringe_modes
from pixcal.kernels.crosstalk import Coupling, outflow
from pixcal.model.arrays import C128, F64, Mask

WIDTH = 0.01  # how much the pixels of a class may well be wider than others, px
DEGREE = 3  # of the polynomial that takes up what is smooth
MIN_PIXELS = 100
ALIGNED = 0.05  # fringe vectors that differ in direction by less (rad/px) lie on one axis


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
    k: tuple[float, float], couplings: Sequence[Coupling], classes: PixelClasses
) -> C128:
    """Derivative (n, class) of the log of what couplings multiply the fringe k (rad/px) by.

    The couplings are of the period of the classes.
    """
    reach = max(max(abs(c.dy), abs(c.dx)) for c in couplings)
    rows, columns = (period * -(-reach // period) for period in (classes.rows, classes.columns))
    shape = (2 * rows + classes.rows, 2 * columns + classes.columns)
    inside = np.zeros(shape, bool)
    inside[rows : rows + classes.rows, columns : columns + classes.columns] = True
    return _slope_at(k, couplings, inside, (0, 0))
