"""Information on the shares of every link, for classes of pixels of any period.

Each class of pixels has two unknown shares for a link, there and back. Noise, reduced to first
order in the shares, and hot pixels are combined here as least-squares sums of the same unknowns.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import lcm

import numpy as np

from pixcal.estimators.crosstalk.covariance import NORMAL, TERMS, Products
from pixcal.estimators.crosstalk.hot_pixels import HotPixels
from pixcal.estimators.crosstalk.links import PixelClasses, Place, class_sums, sums_of
from pixcal.estimators.crosstalk.residuals import UNIT
from pixcal.estimators.fringe_fit.combine import weighted_mean
from pixcal.kernels.crosstalk import Coupling, outflow
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F32, F64, Mask

# prior 1-sigma of the covariance of neighbours over the square of their charge, 1/e-
BRIGHTER_FATTER = 1e-6
ONE_WAY = 0.01  # prior 1-sigma of the difference of the shares there and back
LARGEST = 0.1  # prior 1-sigma of a share
# relative error of the share from a single hot pixel: its neighbour may itself be warm
DOUBT = 0.25
MARKED = 4.0  # sigmas beyond which two numbers differ, or one is not zero
BACKED = 2.5  # sigmas of the share from noise that confirm a single hot pixel
_ONE_LAW = (0, 1, 2, 4)  # `TERMS` without brighter-fatter's own


# Least-squares sums of shares, by method of measurement: normal (link, u, u) and right (link, u).
# Unknown `2 c` is the share that pixels of class c give over the link, `2 c + 1` the share that
# their partners give back.
Information = dict[str, tuple[F64, F64]]


def total(information: Information) -> tuple[F64, F64]:
    """Sums over all methods."""
    normal, right = zip(*information.values(), strict=True)
    return np.sum(normal, axis=0), np.sum(right, axis=0)


@dataclass(frozen=True)
class MeasuredLinks:
    """Measurements of some links."""

    products: Products | None
    hot: HotPixels | None
    links: tuple[Place, ...]
    shape: tuple[int, ...]  # rows and columns of the arrays
    first: Place  # their first in the window

    def of(self, numbers: Sequence[int]) -> "MeasuredLinks":
        """Some of the links."""
        at, products, hot = list(numbers), self.products, self.hot
        if products is not None:
            products = replace(products, right=products.right[at], normal=products.normal[at])
        if hot is not None:
            hot = replace(hot, value=hot.value[:, at], sigma=hot.sigma[:, at])
        return replace(self, products=products, hot=hot, links=tuple(self.links[n] for n in at))

    def level_dependence(self, couplings: Sequence[Coupling]) -> tuple[float, float]:
        """Further relative change of the shares with the signal, 1/ke-, and its error."""
        found = []
        if self.hot is not None:
            found.append(self.hot.level_dependence(couplings, self.links, self.first))
        if self.products is not None:
            found.append(level_dependence(self.products, couplings, self.links))
        value, error, _ = weighted_mean(*np.array(found).T)
        return (float(value), float(error)) if np.isfinite(value) else (0.0, np.inf)

    @property
    def _sums(self) -> tuple[F32, F32]:
        if self.products is None:
            none = np.zeros((len(self.links), 0, *self.shape), np.float32)
            return none, none
        return self.products.right, self.products.normal

    def every_period(self) -> Iterator[tuple[PixelClasses, Information]]:
        """All links for each period; single hot pixels are taken with `DOUBT`."""
        every = (class_sums(sums, self.first) for sums in self._sums)
        for (classes, products), (_, terms) in zip(*every, strict=True):
            found = self._of_noise(products, terms)
            if self.hot is not None:
                found["hot pixels"] = self.hot.by_class(classes, self.links, DOUBT).sums()
            yield classes, found

    def of_period(self, classes: PixelClasses) -> Information:
        """All links for one period, without `DOUBT` for hot pixels that agree."""
        # A single hot pixel of a class counts where the noise confirms it.
        found = self._of_noise(*(sums_of(sums, classes) for sums in self._sums))
        if self.hot is not None:
            shown = self.hot.by_class(classes, self.links)
            alone = (shown.count == 1) & (shown.value**2 * shown.weight > MARKED**2)
            if "covariance" in found:
                alone &= ~_backed(shown.value, *found["covariance"])
            found["hot pixels"] = shown.without(alone).sums()
        return found

    def _of_noise(self, products: F64, terms: F64) -> Information:
        if self.products is None:
            return {}
        return {"covariance": _shares(products, terms, self.products.read)}


def _backed(value: F64, normal: F64, right: F64) -> Mask:
    """Whether the noise shows shares (link, class, 2) and agrees with their values."""
    apart = np.kron(np.eye(value.shape[1]), [[1.0, -1.0], [-1.0, 1.0]]) / ONE_WAY**2
    covariance = np.linalg.inv(normal + apart + np.eye(len(apart)) / LARGEST**2)
    share = np.einsum("luv,lv->lu", covariance, right).reshape(value.shape)
    error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).reshape(value.shape)
    return np.asarray((share > BACKED * error) & (np.abs(value - share) < MARKED * error))


def _shares(right: F64, normal: F64, read: float) -> tuple[F64, F64]:
    """Sums of the shares alone (link, u, u), with the constant and brighter-fatter free."""
    links, _, count = right.shape
    every = normal[:, NORMAL]
    own: F64 = np.zeros((links, count, 2, count, 2))
    at = np.arange(count)
    own[:, at, :, at] = np.moveaxis(every[:, :2, :2], -1, 0)
    cross = np.moveaxis(every[:, :2, 2:], -1, 1).reshape(links, 2 * count, -1)
    nuisance = every[:, 2:, 2:].sum(-1)
    nuisance += np.diag([read**-2] + [(BRIGHTER_FATTER * UNIT) ** -2] * 2)
    taken = cross @ np.linalg.inv(nuisance)
    shares = right[:, :2].swapaxes(1, 2).reshape(links, -1)
    rest = shares - np.einsum("lun,ln->lu", taken, right[:, 2:].sum(-1))
    return own.reshape(links, 2 * count, -1) - taken @ cross.swapaxes(1, 2), rest


def to_first_order(
    found: Products, couplings: Sequence[Coupling], links: Sequence[Place], first: Place
) -> Products:
    """Products that are first order in the shares, from the measured products."""
    # A pixel keeps only a part of its charge; third pixels give to both partners; shares may change
    # with the charge; and the unit of all is the shot noise of a pixel.
    shape = found.right.shape[-2:]
    right = found.right / np.float32(found.shot)
    kept = 1 - outflow(couplings, shape, first)
    third = _third_pixels(couplings, shape, first)
    falls = 2 * _per_unit(couplings)
    for n, step in enumerate(links):
        there, back = np.zeros(shape), np.zeros(shape)
        for c in couplings:
            here, receiver = c.places(shape, first)
            if (c.dy, c.dx) == step:
                there[here] += c.share
            elif (-c.dy, -c.dx) == step:
                back[receiver] += c.share
        # There are no products beyond the border, so wrapped values do not count.
        partner = np.roll(kept, (-step[0], -step[1]), (0, 1))
        shared = third.get(step, np.zeros(shape)) / 2
        offsets = {0: there * (kept - 1) + shared, 1: back * (partner - 1) + shared}
        if falls:
            both = there * kept + back * partner
            offsets[3] = falls * (there * (kept - 1) + back * (partner - 1))
            offsets[4] = falls * (both / 2 + 2 * shared)
        for i in range(TERMS):
            for j, offset in offsets.items():
                right[n, i] -= found.normal[n, NORMAL[i, j]] * offset
    return replace(found, right=right)


def level_dependence(
    found: Products, couplings: Sequence[Coupling], links: Sequence[Place]
) -> tuple[float, float]:
    """Remaining relative change of the coupling with source charge (1/ke-), and its error."""
    # From covariance whose rise with the square of the charge differs from that of the variance.
    sizes = {(c.dy, c.dx): 0.0 for c in couplings}
    lost = got = 0.0
    for c in couplings:
        some = 1 / (c.every_rows * c.every_columns)
        sizes[c.dy, c.dx] += some * c.share
        lost, got = lost + some * c.share, got + some * c.share**2
    right = weight = 0.0
    for n, (dy, dx) in enumerate(links):
        slope = (sizes.get((dy, dx), 0.0) + sizes.get((-dy, -dx), 0.0)) * UNIT * 1e-3
        if not slope:
            continue
        sums = found.normal[n].sum(axis=(1, 2), dtype=float)
        covariance = inverse_normal(sums[NORMAL[np.ix_(_ONE_LAW, _ONE_LAW)]])
        value = float(covariance[-1] @ found.right[n, list(_ONE_LAW)].sum(axis=(1, 2), dtype=float))
        right += slope * value / float(covariance[-1, -1])
        weight += slope**2 / float(covariance[-1, -1])
    if not weight:
        return 0.0, np.inf
    # Slope of the variance of a pixel that loses less at high charge, and receives from others.
    own = 4 * _per_unit(couplings) * (got - lost * (1 - lost)) / ((1 - lost) ** 2 + got)
    per_ke = 1 / (2 * UNIT * 1e-3)
    more = right / weight - (found.curve - own) * per_ke
    # Terms of higher order, with the square of the level dependence, are of this size.
    beyond = lost * (couplings[0].per_ke + more)
    return more, float(np.linalg.norm([weight**-0.5, found.curve_error * per_ke, beyond]))


def _per_unit(couplings: Sequence[Coupling]) -> float:
    """Relative change common to all shares, 1/(10⁴ e-)."""
    return couplings[0].per_ke * UNIT * 1e-3 if couplings else 0.0


def _third_pixels(
    couplings: Sequence[Coupling], shape: tuple[int, ...], first: Place
) -> dict[Place, F64]:
    """By step, at a link's first pixel: product of the shares of both partners from a third."""
    period = lcm(*(c.every_rows for c in couplings)), lcm(*(c.every_columns for c in couplings))
    given: dict[Place, F64] = {}
    for c in couplings:
        rows = slice((c.row - first[0]) % c.every_rows, None, c.every_rows)
        columns = slice((c.column - first[1]) % c.every_columns, None, c.every_columns)
        given.setdefault((c.dy, c.dx), np.zeros(period))[rows, columns] += c.share
    found: dict[Place, F64] = {}
    for a, of_a in given.items():
        for b, of_b in given.items():
            step = (b[0] - a[0], b[1] - a[1])
            if step > (0, 0):
                product = np.roll(of_a * of_b, a, (0, 1))
                found[step] = found.get(step, 0.0) + product
    repeats = -(-shape[0] // period[0]), -(-shape[1] // period[1])
    return {s: np.tile(own, repeats)[: shape[0], : shape[1]] for s, own in found.items()}
