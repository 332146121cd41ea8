"""Couplings from the neighbours of hot pixels in darks, the method of the paper.

A hot pixel has dark signal without light, and its neighbours have little: their signal is a share
of it. Each direction is measured separately, so this method separates a coupling from its opposite.
A neighbour may itself be warm, so a share counts only if several hot pixels of a class agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import maximum_filter, median_filter

from pixcal.estimators.crosstalk.equations import Equations
from pixcal.estimators.crosstalk.links import REACH, PixelClasses, Place
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.crosstalk import Coupling, uncouple
from pixcal.kernels.medians import median_and_sigma
from pixcal.model.arrays import F64, Indices, Mask

MIN_SIGMAS = 40.0  # dark signal of a hot pixel over the noise of the others
OVERLAP = 0.01  # signal of another hot pixel near a receiver, over the source, that spoils it
OVERLAP_KNOWN = 0.5  # the same where its contribution is known and subtracted
OWN_RING = 0.1  # a pixel below this share of a neighbour may be due to it: no source
# values beyond this many errors from the median of their class are excluded, if they are few
CLIP = 5.0
DOUBT = 0.25  # relative error of the share from a single hot pixel: its neighbour may be warm
RISE = 1e-4  # typical rise of a share with the charge by brighter-fatter, 1/ke-
ENOUGH = 4  # values beyond the first that separate a rise with the charge from disagreement
MAX_PIXELS = 4000  # hot pixels used, the brightest


@dataclass(frozen=True)
class HotPixels:
    """Shares that each hot pixel measures for each link, in both directions."""

    y: Indices  # y, x: (h,)
    x: Indices
    charge: F64  # (h,) 10³ e- at the longest dark exposure, less the background
    # value, sigma: (h, link, 2) share read at `+step` and at `-step`, and its error (infinite
    # where spoilt)
    value: F64
    sigma: F64

    def of(self, links: Sequence[int]) -> "HotPixels":
        """Those of some links."""
        return replace(self, value=self.value[:, links], sigma=self.sigma[:, links])

    def equations(
        self, classes: PixelClasses, links: Sequence[Place], doubted: bool = False
    ) -> Equations:
        """Combined hot pixels of each class; ``doubted``: `DOUBT` even those that agree."""
        step = np.array(links)[:, :, None] * [0, 1]
        y, x = self.y[:, None, None] - step[:, 0], self.x[:, None, None] - step[:, 1]
        order = np.argsort(self.value, axis=0)
        value, sigma = (np.take_along_axis(a, order, 0) for a in (self.value, self.sigma))
        number = np.take_along_axis(classes.of(y, x), order, 0)
        charge: F64 = self.charge[order]
        powers = np.stack([np.ones_like(charge), charge])
        # Unknowns by power of the charge and by direction.
        normal = np.zeros((len(links), 2, 2, 2, 2, classes.count))
        right = np.zeros((len(links), 2, 2, classes.count))
        for n in range(classes.count):
            near = np.where(number == n, sigma, np.inf)
            alone = doubted | (np.isfinite(near).sum(axis=0) == 1)
            doubt = np.where(alone, DOUBT, 0.0) * value
            weighted = powers * _agreed(value, np.hypot(near, doubt), charge)
            for way in (0, 1):
                own = weighted[..., way], powers[..., way]
                normal[:, :, way, :, way, n] = np.einsum("ahl,bhl->lab", *own)
                right[:, :, way, n] = np.einsum("ahl,hl->la", own[0], value[..., way])
        every = normal.reshape(len(links), 4, 4, -1), right.reshape(len(links), 4, -1)
        return Equations(*every, np.eye(2), np.ones((1, 2)), np.array([RISE]))


def hot_pixels(
    evidence: Evidence, links: Sequence[Place], known: Sequence[Coupling] = ()
) -> HotPixels | None:
    """Find hot pixels and shares in their neighbours; None where no dark signal was measured.

    ``known``: couplings for which the dark signal is corrected first; shares are the remainder.
    """
    exposures = [s.exptime_s for s in evidence.of_kind("dark") if np.isfinite(s.exptime_s)]
    if not exposures or not np.any(evidence.dark_rate):
        return None
    signal = uncouple(evidence.dark_rate * max(exposures), known, evidence.origin)
    # Pixels far from saturation in every dark.
    usable = np.ones(evidence.good.shape, bool)
    for stack in evidence.of_kind("dark"):
        usable &= stack.adu.mean(axis=0) < 0.9 * evidence.saturation_adu
    return hot_pixels_of(signal, usable, links, OVERLAP_KNOWN if known else OVERLAP)


def hot_pixels_of(
    signal: F64, usable: Mask, links: Sequence[Place], overlap: float = OVERLAP
) -> HotPixels | None:
    """As `hot_pixels`, from the mean signal (y, x) of darks, e-, of pixels that do not saturate."""
    rest = signal - median_filter(signal, 2 * REACH + 5, mode="reflect")
    _, noise = median_and_sigma(rest)
    if not noise > 0:
        return None
    highest = rest > OWN_RING * maximum_filter(rest, 2 * REACH + 1, mode="constant")
    y, x = np.nonzero((rest > MIN_SIGMAS * noise) & highest & usable)
    order = np.argsort(-rest[y, x], kind="stable")[:MAX_PIXELS]
    y, x = y[order], x[order]
    if not len(y):
        return None
    charge, size = rest[y, x], 2 * REACH
    # Warm pixels spoil receivers, their own and those around them.
    around = _surroundings(rest, y, x, REACH)
    warm = _surroundings(np.where((rest > MIN_SIGMAS / 10 * noise) & highest, rest, 0), y, x, size)
    warm[:, size, size] = 0
    strongest = maximum_filter(np.nan_to_num(warm), (1, size + 1, size + 1), mode="constant")
    strongest = strongest[:, REACH:-REACH, REACH:-REACH]
    around, strongest = (a / charge[:, None, None] for a in (around, strongest))
    with np.errstate(invalid="ignore"):
        clean = (around < OWN_RING) & (strongest < overlap)
    step = np.array(links)[:, :, None] * [1, -1]
    at = slice(None), REACH + step[:, 0], REACH + step[:, 1]
    sigma = np.where(clean[at], (noise / charge)[:, None, None], np.inf)
    return HotPixels(y, x, charge * 1e-3, np.where(clean[at], around[at], 0.0), sigma)


def _surroundings(values: F64, y: Indices, x: Indices, size: int) -> F64:
    """Values (h, row, column) up to ``size`` pixels around pixels; NaN beyond the border."""
    step = np.arange(2 * size + 1)
    padded = np.pad(values, size, constant_values=np.nan)
    return np.asarray(padded[y[:, None, None] + step[:, None], x[:, None, None] + step])


def _agreed(v: F64, s: F64, q: F64) -> F64:
    """Weights (h, ...) of values in rising order, their errors and charges: of those that agree."""
    w = s**-2.0
    used, half = w > 0, w.sum(axis=0) / 2
    middle = np.take_along_axis(v, np.argmax(np.cumsum(w, axis=0) >= half, axis=0)[None], 0)
    near = used & (np.abs(v - middle) < CLIP * s)
    count, agree = used.sum(axis=0), near.sum(axis=0)
    kept = np.where((agree < 2) | (2 * agree <= count), used, near)
    w = w * kept
    per = np.maximum(w.sum(axis=0), 1e-300)
    v, q = (a - (w * a).sum(axis=0) / per for a in (v, q))
    square, product, rest = ((w * a * b).sum(axis=0) for a, b in ((q, q), (q, v), (v, v)))
    freedom = kept.sum(axis=0) - 1
    # A rise with the charge is handled later.
    rising = (freedom >= ENOUGH) & (square > 0)
    rest = rest - np.where(rising, product**2 / np.where(rising, square, 1), 0)
    freedom = np.maximum(freedom - rising, 0)
    # Reduced chi-square exceeded by chance once in a thousand (Wilson and Hilferty's cube).
    some = np.maximum(freedom, 1)
    usual = (1 - 2 / (9 * some) + 3.09 * np.sqrt(2 / (9 * some))) ** 3
    apart = (freedom > 0) & (rest > usual * freedom)
    return np.asarray(w * np.where(apart, freedom / np.where(apart, rest, 1), 1))
