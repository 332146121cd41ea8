"""Pixel-to-pixel scatter of the fringe visibility, within and between sets."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.maps import map_fit
from pixcal.estimators.maps.structure import without_outliers
from pixcal.model.arrays import F64, Mask

# pairs of sets, mean products of the logarithms of their visibilities, and the errors of these
Products = tuple[list[tuple[int, int]], F64, F64]


def visibility_products(evidence: Evidence, sets: Sequence[FringeEvidence]) -> Products:
    """Mean products per pixel, without noise: of each set with itself, then of pairs of sets."""
    # Structure that neighbours share is removed, and so is the noise of the subtracted bias.
    maps = [_two_halves(fringes) for fringes in sets]
    both = [(one + other) / 2 for one, other, _ in maps]
    pairs = [(m, m) for m in range(len(sets))] + list(combinations(range(len(sets)), 2))
    products, errors = np.empty((2, len(pairs)))
    for at, (m, n) in enumerate(pairs):
        first, second = maps[m][:2] if m == n else (both[m], both[n])
        kept = maps[m][2] & maps[n][2]
        white = map_fit.white_products(first, second, kept)
        errors[at] = white.std() / np.sqrt(len(white))
        # Variance of the subtracted bias, e-², which is common to all frames.
        counts = [len(s.adu) for s in evidence.of_kind("bias")]
        products[at] = white.mean() - (evidence.read_noise**2 / sum(counts) if counts else 0.0) / (
            mean_light(sets[m]) * mean_light(sets[n])
        )
    return pairs, products, errors


def mean_light(fringes: FringeEvidence) -> float:
    """Mean light of a set's good pixels, e-, as reference for a charge common to all of them."""
    light = fringes.theta[0][fringes.good]
    # Of the inverse squares, since pixels in little light change most; dead corners do not count.
    return float(np.mean(np.maximum(light, 0.1 * np.median(light)) ** -2.0) ** -0.5)


def _two_halves(fringes: FringeEvidence) -> tuple[F64, F64, Mask]:
    """Visibility of the pixels in two halves of the frames; where both are known."""
    one, other = (_visibility(fringes, half) for half in (0, 1))
    kept = np.isfinite(one) & np.isfinite(other)
    one, other = (map_fit.without_lines(half[kept], kept) for half in (one, other))
    return *map_fit.without_harmonics(one, other, fringes, kept), kept


def _visibility(fringes: FringeEvidence, half: int) -> F64:
    """Logarithm of the visibility (y, x) of half the frames, without fringes; outliers are NaN."""
    good = fringes.good
    theta = map_fit.half_theta(fringes, half, good)
    rest = np.full(good.shape, np.nan)
    rest[good] = np.log(np.maximum(np.hypot(theta[1], theta[2]), 1e-9) / np.maximum(theta[0], 1e-9))
    rest = without_outliers(rest)
    used = np.isfinite(rest)
    rest[used] = map_fit.without(rest[used][:, None], map_fit.gauge_terms(fringes)[:, used].T)[:, 0]
    return rest
