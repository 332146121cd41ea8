"""Couplings from hot pixels in darks, the way of the paper: what their neighbours show.

The dark signal of a hot pixel is there whether or not light falls on it, and that of its neighbours
is low: what they show is a share of it. Each direction is measured by itself, so this is the
measurement that tells a coupling from its opposite. A neighbour may be warm by itself; so a share
counts only where several hot pixels of a class agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, median_filter

from pixcal.estimators.crosstalk.links import REACH, Classes, Place
from pixcal.estimators.detector import median_and_sigma
from pixcal.estimators.evidence import Evidence
from pixcal.kernels.crosstalk import Coupling

F64 = NDArray[np.float64]

MIN_SIGMAS = 40.0
"""Dark signal of a hot pixel over the noise of the others."""
OVERLAP = 0.01
"""Another hot pixel near the receiver, of this share of the source, spoils it."""
OWN_RING = 0.2
"""A pixel below this share of a neighbour may be read from it: no source."""
CLIP = 5.0
"""Values beyond so many errors from the median of their class are left out, if they are few."""
MIN_LEVELS = 3
"""Hot pixels of a coupling that tell whether its share changes with the signal."""
MOST = 4000
"""Hot pixels used, the brightest."""


@dataclass(frozen=True)
class HotPixels:
    """What each hot pixel shows of each link, both ways.

    Attributes
    ----------
    y, x : (h,) int
    charge : (h,) float64
        10³ e- at the longest dark exposure, less the background.
    value, sigma : (h, link, 2) float64
        Share read at ``+step`` and at ``-step``, and its error (infinite where spoilt).
    shape : (int, int)
        Rows and columns of the maps.
    """

    y: NDArray[np.intp]
    x: NDArray[np.intp]
    charge: F64
    value: F64
    sigma: F64
    shape: Place

    def corrected(self, outflow: F64, per_ke: float) -> "HotPixels":
        """Shares of what a hot pixel had, at small signals; they were measured of what it kept.

        Parameters
        ----------
        outflow : (y, x) float64
            Share that each pixel gives away, at small signals.
        per_ke : float
            Relative change of shares with the charge, 1/ke-.
        """
        lost = outflow[self.y, self.x]
        charge = self.charge / (1 - lost * (1 + per_ke * self.charge))
        kept = (1 - lost * (1 + per_ke * charge)) / (1 + per_ke * charge)
        at = kept[:, None, None]
        return replace(self, charge=charge, value=self.value * at, sigma=self.sigma * np.abs(at))

    def by_class(
        self, classes: Classes, links: tuple[Place, ...], doubt: float = 0.0
    ) -> tuple[F64, F64, NDArray[np.int64]]:
        """Shares, their information (1 / sigma²) and the hot pixels used, (link, class, 2).

        The second of a pair is ordered by the class of the receiver, which is the first pixel of
        the link. Each value has an error of ``doubt`` times itself as well.
        """
        step = np.array(links)
        y = np.stack([np.broadcast_to(self.y[:, None], (len(self.y), len(step)))] * 2, -1)
        x = np.stack([np.broadcast_to(self.x[:, None], (len(self.x), len(step)))] * 2, -1)
        y[:, :, 1] -= step[:, 0]
        x[:, :, 1] -= step[:, 1]
        value = np.zeros((len(links), classes.count, 2))
        information, count = np.zeros_like(value), np.zeros(value.shape, np.int64)
        sigma = np.hypot(self.sigma, doubt * self.value)
        _by_class(self.value, sigma, classes.of(y, x), value, information, count)
        return value, information, count

    def level_dependence(
        self, couplings: Sequence[Coupling], links: Sequence[Place], first: Place
    ) -> tuple[float, float]:
        """Relative change of the shares with the signal of the hot pixels, 1/ke-, and its error.

        Each coupling has its own share; the change is common to all. Noise would tell it with fewer
        hot pixels, but there brighter-fatter looks the same. The error is infinite without any.
        """
        right = weight = level = 0.0
        for c in couplings:
            step, side = ((c.dy, c.dx), 0) if (c.dy, c.dx) in links else ((-c.dy, -c.dx), 1)
            classes = Classes(c.every_rows, c.every_columns, first)
            own = classes.of(self.y, self.x) == c.row * c.every_columns + c.column
            value = self.value[own, links.index(step), side]
            sigma = self.sigma[own, links.index(step), side]
            near = np.isfinite(sigma) & (np.abs(value - c.share) < 0.5 * abs(c.share))
            if near.sum() < MIN_LEVELS:
                continue
            w, charge = sigma[near] ** -2, self.charge[own][near]
            mean = np.average(charge, weights=w)
            slope = c.share * (charge - mean)
            right += float((w * slope) @ value[near])
            weight += float(w @ slope**2)
            level += float(w @ slope**2 * mean)
        if not weight:
            return 0.0, np.inf
        # Shares are those at the mean signal so far.
        at_small_signals = 1 / (1 - right / weight * level / weight)
        return right / weight * at_small_signals, weight**-0.5 * at_small_signals**2


def hot_pixels(evidence: Evidence, links: tuple[Place, ...]) -> HotPixels | None:
    """Find hot pixels and what their neighbours show; None where no dark signal was measured."""
    exposures = [s.exptime_s for s in evidence.of_kind("dark") if np.isfinite(s.exptime_s)]
    rate = evidence.dark_rate
    if not exposures or not np.any(rate):
        return None
    rest = rate - median_filter(rate, 2 * REACH + 5, mode="reflect")
    _, noise = median_and_sigma(rest)
    if not noise > 0:
        return None
    usable = _unsaturated(evidence)
    peak = maximum_filter(rest, 2 * REACH + 1, mode="constant")
    hot = (rest > MIN_SIGMAS * noise) & (rest > OWN_RING * peak) & usable
    others = (rest > MIN_SIGMAS * noise / 10) & (rest > OWN_RING * peak)
    y, x = np.nonzero(hot)
    order = np.argsort(-rest[y, x], kind="stable")[:MOST]
    y, x = y[order], x[order]
    if not len(y):
        return None
    charge = rest[y, x]
    value, clean = _patches(rest, np.where(others, rest, 0.0), y, x)
    step = np.array(links)
    at = REACH + np.stack([step, -step], 1)
    value = value[:, at[..., 0], at[..., 1]] / charge[:, None, None]
    clean = clean[:, at[..., 0], at[..., 1]]
    sigma = np.where(clean, noise / charge[:, None, None], np.inf)
    return HotPixels(
        y, x, charge * max(exposures) * 1e-3, np.where(clean, value, 0.0), sigma, rate.shape
    )


def _unsaturated(evidence: Evidence) -> NDArray[np.bool_]:
    """Pixels far from saturation in every dark."""
    usable = np.ones(evidence.good.shape, bool)
    for stack in evidence.of_kind("dark"):
        usable &= stack.adu.mean(axis=0) < 0.9 * evidence.saturation_adu
    return usable


def _patches(
    rest: F64, disturbing: F64, y: NDArray[np.intp], x: NDArray[np.intp]
) -> tuple[F64, NDArray[np.bool_]]:
    """Surroundings (h, row, column) of hot pixels within `REACH`, and where they can be trusted.

    Flags do not matter here: what a hot pixel gives makes its neighbours hot as well.
    """
    size = 2 * REACH
    around = np.arange(-size, size + 1)
    rows, columns = y[:, None, None] + size + around[:, None], x[:, None, None] + size + around
    patch = np.pad(rest, size, constant_values=np.nan)[rows, columns]
    others = np.pad(disturbing, size)[rows, columns]
    others[:, size, size] = 0.0
    strongest = maximum_filter(others, (1, size + 1, size + 1), mode="constant")
    inner = (slice(None), slice(REACH, -REACH), slice(REACH, -REACH))
    charge = rest[y, x][:, None, None]
    with np.errstate(invalid="ignore"):
        clean = (patch[inner] < OWN_RING * charge) & (strongest[inner] < OVERLAP * charge)
    return patch[inner], clean


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _by_class(value: Any, sigma: Any, classes: Any, mean: Any, information: Any, used: Any) -> None:
    pixels, links, sides = value.shape
    of_class, count = np.empty(pixels, np.int64), mean.shape[1]
    for link in range(links):
        for side in range(sides):
            for number in range(count):
                n = 0
                for h in range(pixels):
                    if classes[h, link, side] == number and sigma[h, link, side] < np.inf:
                        of_class[n] = h
                        n += 1
                used[link, number, side] = n
                if n == 0:
                    continue
                chosen = of_class[:n]
                v, s = np.empty(n), np.empty(n)
                for i in range(n):
                    v[i] = value[chosen[i], link, side]
                    s[i] = sigma[chosen[i], link, side]
                mean[link, number, side], information[link, number, side] = _agreed(v, s)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _agreed(v: Any, s: Any) -> tuple[float, float]:
    """Mean of values and its information: less where they disagree by more than chance."""
    w = 1 / s**2
    order = np.argsort(v)
    half, at = 0.5 * w.sum(), 0.0
    middle = v[order[0]]
    for i in order:
        middle = v[i]
        at += w[i]
        if at >= half:
            break
    near = np.abs(v - middle) < CLIP * s
    if near.sum() < 2 or 2 * near.sum() <= len(v):
        near[:] = True
    total = (w * near).sum()
    mean = (w * near * v).sum() / total
    freedom = near.sum() - 1
    if freedom == 0:
        return mean, total
    scatter = (w * near * (v - mean) ** 2).sum() / freedom
    # Reduced chi-square that chance passes once in a thousand (Wilson and Hilferty's cube).
    usual = (1 - 2 / (9 * freedom) + 3.09 * np.sqrt(2 / (9 * freedom))) ** 3
    return mean, total / scatter if scatter > usual else total
