"""What couplings leave in the pattern of the maps, class by class of pixels.

A kernel that repeats shifts all pixels of a class alike and changes their visibility. True offsets
have such a pattern by chance only, that of the mean of so many pixels; or, on a detector whose
pixels are drawn so, a real one, whose size is free here and learnt beside the couplings
(`pixcal.estimators.crosstalk.dense`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.crosstalk.links import PixelClasses
from pixcal.estimators.crosstalk.maps import (
    MIN_PIXELS,
    WIDTH,
    good_in_all,
    log_visibility,
    response_slopes,
    smooth_modes,
    without,
)
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.maps.corrected import phase_change
from pixcal.kernels.crosstalk import Coupling, filled, uncouple_fringes
from pixcal.kernels.robust import median_and_sigma
from pixcal.model.arrays import C128, F64, Mask

CLIP = 5.0  # offsets and visibilities beyond so many robust deviations do not count
ROUNDS = 4  # in which these are found: without them, what is smooth is known better


@dataclass(frozen=True)
class _Pattern:
    """A set's maps by class, smooth modes taken off."""

    axis: F64  # (2,) that the offsets are along
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
    found = [_of_set(one, couplings, classes, good, smooth, members) for one in sets]
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
    """How well a period describes the visibility of the pixels.

    Gives the fall in chi-square, of all sets together, if each class of a period has its own mean
    of the logarithm of the visibility.
    """
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


def _of_set(
    found: FringeEvidence,
    couplings: Sequence[Coupling],
    classes: PixelClasses,
    good: Mask,
    smooth: F64,
    members: F64,
) -> _Pattern:
    # Flagged pixels were fitted too: what they give to others is known.
    read = filled(found.theta / found.shot_factor, found.k)
    theta = uncouple_fringes(read, couplings, found.origin)
    k = float(np.hypot(*found.k))
    delta = found.delta[good] + phase_change(read, theta)[good] / k
    delta, scatter = _clipped(delta, smooth)
    visibility, spread = _clipped(log_visibility(theta, good), smooth)
    noise = float(np.median(found.sigma[good])) / k
    return _Pattern(
        np.array(found.k) / k, members @ delta, members @ visibility, noise, scatter, spread,
        response_slopes(found.k, couplings, classes), k,
    )  # fmt: skip


def _clipped(values: F64, modes: F64) -> tuple[F64, float]:
    """Values freed of modes, zero where they are outliers, and their robust scatter."""
    # Outliers would move all modes, and those of fringes look like a period of rows.
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
    slopes = [
        np.vstack([one.slopes.imag / one.k, one.axis[0] * each, one.axis[1] * each])
        for one in found
    ]
    normal = sum(
        weight[a, b] * slopes[a] @ gram @ slopes[b].T
        for a in range(len(found))
        for b in range(len(found))
    )
    right = sum(
        weight[a, b] * slopes[a] @ found[b].delta
        for a in range(len(found))
        for b in range(len(found))
    )
    return np.asarray(normal), np.asarray(right)
