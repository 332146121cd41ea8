"""Couplings from the maps of a fit, class by class of pixels: visibility, and offsets.

A pixel that receives the share k from one a step n away, and keeps the share o, has its fringe
multiplied by ``(o + sum k exp(-i K n)) / (o + sum k)``, whatever the flat. The modulus changes the
visibility, the angle shifts the offset by ``arg / |K|``. A true displacement is the same at every
K, so only differences of offsets between sets count, which needs more sets than the two axes. The
visibility needs one set, if pixels of all classes are equally wide (to within `WIDTH`).

True offsets have a pattern of classes by chance, or a real one, whose size is learnt together with
the couplings (`dense`). Maps are corrected for known couplings; the others then act linearly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.crosstalk.links import REACH, PixelClasses
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.fringe_fit.fringes import grid, polynomial_basis
from pixcal.estimators.fringe_fit.gauge import fringe_modes
from pixcal.estimators.maps.corrected import phase_change
from pixcal.kernels.crosstalk import Coupling, filled, outflow, uncouple_fringes
from pixcal.kernels.robust import median_and_sigma
from pixcal.model.arrays import C128, F64, Mask

CLIP = 5.0  # offsets and visibilities beyond this many robust deviations are outliers
ROUNDS = 4  # iterations of clipping: smooth modes are fitted better without outliers
WIDTH = 0.01  # prior 1-sigma of the width of a class of pixels relative to others, px
DEGREE = 3  # of the polynomial that absorbs smooth variation
MIN_PIXELS = 100


@dataclass(frozen=True)
class _Pattern:
    """A set's maps by class, without smooth modes."""

    axis: F64  # (2,) direction of the offsets
    # delta, visibility: (class,) sums of the offsets (px) and of the logarithm of the
    # visibility, without the couplings
    delta: F64
    visibility: F64
    # noise, scatter, spread: error of an offset, px; scatter of the offsets and of the
    # visibilities of pixels
    noise: float
    scatter: float
    spread: float
    slopes: C128  # (coupling, class) change of the log of the fringe over the light by each share
    k: float  # rad/px


def pattern_information(
    evidence: Evidence, couplings: Sequence[Coupling], classes: PixelClasses
) -> tuple[F64, F64] | None:
    """Least-squares sums (m, m), (m,) of the shares and of a true pattern of the offsets.

    About the couplings as known, for classes of pixels of their period. First n shares, then the
    true mean offset along x and along y of each class, px; None without fringes.
    """
    good = good_in_all(evidence)
    sets = list(evidence.fringes.values())
    if good.sum() < MIN_PIXELS or not couplings:
        return None
    smooth = smooth_modes(sets, good)
    number = classes.of(*np.nonzero(good))
    members = without((number == np.arange(classes.count)[:, None]).astype(float), smooth)
    gram = members @ members.T

    def of_set(found: FringeEvidence) -> _Pattern:
        # Flagged pixels were fitted too, so their contribution to others is known.
        read = filled(found.theta / found.shot_factor, found.k)
        theta = uncouple_fringes(read, couplings, found.origin)
        k = float(np.hypot(*found.k))
        offsets = found.delta[good] + phase_change(read, theta)[good] / k
        delta, scatter = _clipped(offsets, smooth)
        visibility, spread = _clipped(log_visibility(theta, good), smooth)
        noise = float(np.median(found.sigma[good])) / k
        sums = members @ delta, members @ visibility
        slopes = response_slopes(found.k, couplings, classes)
        return _Pattern(np.array(found.k) / k, *sums, noise, scatter, spread, slopes, k)

    found = [of_set(one) for one in sets]
    size = len(couplings)
    normal, right = np.zeros((size, size)), np.zeros(size)
    for one in found:
        own = _visibility(one, gram)
        normal, right = normal + own[0], right + own[1]
    total, total_right = _offsets(found, gram)
    total[:size, :size] += normal
    total_right[:size] += right
    known = np.array([c.share for c in couplings])
    return total, total_right + total[:, :size] @ known


def visibility_pattern(evidence: Evidence) -> Callable[[PixelClasses], float]:
    """Fall in chi-square if each class of a period has its own mean of log visibility."""
    good = good_in_all(evidence)
    sets = list(evidence.fringes.values())
    if good.sum() < MIN_PIXELS:
        return lambda classes: 0.0
    y, x = np.nonzero(good)
    smooth = smooth_modes(sets, good)
    maps = [_clipped(log_visibility(one.theta, good), smooth) for one in sets]

    def gain(classes: PixelClasses) -> float:
        number = classes.of(y, x)
        count = np.maximum(np.bincount(number, minlength=classes.count), 1)
        sums = [np.bincount(number, values / sigma, classes.count) for values, sigma in maps]
        return float(sum(np.sum(own**2 / count) for own in sums))

    return gain


def _clipped(values: F64, modes: F64) -> tuple[F64, float]:
    """Values without modes, zero where they are outliers, and their robust scatter."""
    # Outliers would move all modes, and fringe modes resemble a period of rows.
    for _ in range(ROUNDS):
        rest = without(values, modes)
        sigma = float(median_and_sigma(rest)[1])
        usual = np.abs(rest) < CLIP * sigma
        values = np.where(usual, values, values - rest)
    return np.where(usual, rest, 0.0), sigma


def _visibility(one: _Pattern, gram: F64) -> tuple[F64, F64]:
    """Sums of the shares; pixels of a class may be wider than others by `WIDTH`."""
    weight = one.spread**-2
    wider = WIDTH * one.k**2 / 12
    inner = weight * gram + np.eye(len(gram)) / wider**2
    kept = weight * (gram - gram @ np.linalg.solve(inner, weight * gram))
    data = weight * (one.visibility - gram @ np.linalg.solve(inner, weight * one.visibility))
    return one.slopes.real @ kept @ one.slopes.real.T, one.slopes.real @ data


def _offsets(found: Sequence[_Pattern], gram: F64) -> tuple[F64, F64]:
    """Sums of the shares and of a true pattern; pixels scatter about it by their own offsets."""
    axes = np.array([one.axis for one in found])
    own = np.array([max(one.scatter**2 - one.noise**2, 0.0) for one in found])
    noise = np.array([one.noise for one in found])
    weight = np.linalg.inv(np.diag(noise**2) + own.mean() * axes @ axes.T)
    each = np.eye(len(gram))
    slopes = np.stack(
        [
            np.vstack([one.slopes.imag / one.k, one.axis[0] * each, one.axis[1] * each])
            for one in found
        ]
    )
    weighted = np.tensordot(weight, slopes, 1)
    normal = np.einsum("aik,kl,ajl->ij", weighted, gram, slopes, optimize=True)
    return normal, np.einsum("aik,ak->i", weighted, np.stack([one.delta for one in found]))


def good_in_all(evidence: Evidence) -> Mask:
    """Pixels off the border with an offset in every fringe set; none without sets."""
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
    """Orthonormal (mode, pixel): smooth variation, and the fringes left by free light."""
    y, x = grid(good.shape)
    modes = [polynomial_basis(good.shape, DEGREE)[good.ravel()].T]
    for found in sets:
        psi = np.broadcast_to(found.k[0] * x + found.k[1] * y, good.shape)[good]
        phasor = (found.theta[2] + 1j * found.theta[1])[good] * np.exp(-1j * psi)
        modes += fringe_modes(psi + np.angle(phasor.sum()), np.ones(len(psi)))
    return np.asarray(np.linalg.qr(np.vstack(modes).T)[0].T)


def without(values: F64, modes: F64) -> F64:
    """Values (..., pixel) without modes."""
    return np.asarray(values - (values @ modes.T) @ modes)


def response_slopes(
    k: tuple[float, float], couplings: Sequence[Coupling], classes: PixelClasses
) -> C128:
    """Derivative (n, class) of the log of the factor of couplings on a fringe k (rad/px)."""
    reach = max(max(abs(c.dy), abs(c.dx)) for c in couplings)
    rows, columns = (period * -(-reach // period) for period in (classes.rows, classes.columns))
    shape = (2 * rows + classes.rows, 2 * columns + classes.columns)
    light = 1 - outflow(couplings, shape, (0, 0))
    fringe = light.astype(complex)
    turns = [np.exp(-1j * (k[0] * c.dx + k[1] * c.dy)) for c in couplings]
    for c, turn in zip(couplings, turns, strict=True):
        there = c.places(shape, (0, 0))[1]
        light[there] += c.share
        fringe[there] += c.share * turn
    slope = np.zeros((len(couplings), *shape), np.complex128)
    for own, c, turn in zip(slope, couplings, turns, strict=True):
        here, there = c.places(shape, (0, 0))
        own[there] += turn / fringe[there] - 1 / light[there]
        own[here] -= 1 / fringe[here] - 1 / light[here]
    inside = slope[:, rows : rows + classes.rows, columns : columns + classes.columns]
    return np.asarray(inside.reshape(len(slope), -1))
