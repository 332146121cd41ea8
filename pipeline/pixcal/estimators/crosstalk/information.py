"""What is known of the shares of every link, for classes of pixels of any period.

Each class of pixels has two unknown shares for a link, there and back. Noise and hot pixels are
joined here as least-squares sums of the same unknowns.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.crosstalk.covariance import NORMAL, TERMS, Products
from pixcal.estimators.crosstalk.hot_pixels import HotPixels
from pixcal.estimators.crosstalk.links import PixelClasses, Place, class_sums, sums_of
from pixcal.estimators.crosstalk.residuals import UNIT
from pixcal.estimators.crosstalk.second_order import level_dependence
from pixcal.kernels.crosstalk import Coupling
from pixcal.model.arrays import F32, F64, Mask

# how large the covariance of neighbours over the square of their charge may well be, 1/e-
BRIGHTER_FATTER = 1e-6
ONE_WAY = 0.01  # how much the shares there and back may well differ
LARGEST = 0.1  # how large a share may well be
# error of what a single hot pixel shows, as a share of it: a neighbour may be warm by itself
DOUBT = 0.25
MARKED = 4.0  # sigmas beyond which two numbers differ, or one is not zero
BACKED = 2.5  # sigmas of the noise's own share that back a single hot pixel


@dataclass(frozen=True)
class Information:
    """Least-squares sums of shares, by way of measuring."""

    # normal, right: (..., u, u), (..., u): unknown `2 c` is what
    # pixels of class c give over the link, `2 c + 1` what their partners give back. With a
    # leading axis for many links
    normal: dict[str, F64]
    right: dict[str, F64]

    def of(self, link: int) -> "Information":
        """That of one link, where arrays hold many."""
        return Information(
            {way: m[link] for way, m in self.normal.items()},
            {way: r[link] for way, r in self.right.items()},
        )

    @property
    def total(self) -> tuple[F64, F64]:
        """All ways together."""
        return np.sum([*self.normal.values()], axis=0), np.sum([*self.right.values()], axis=0)


@dataclass(frozen=True)
class MeasuredLinks:
    """What was measured of some links, freed of what is known already (second order)."""

    products: Products | None
    hot: HotPixels | None
    links: tuple[Place, ...]
    shape: Place  # shape, first: rows and columns of the arrays; their first in the window
    first: Place

    def of(self, numbers: Sequence[int]) -> "MeasuredLinks":
        """Some of the links."""
        at, products, hot = list(numbers), self.products, self.hot
        if products is not None:
            products = replace(products, right=products.right[at], normal=products.normal[at])
        if hot is not None:
            hot = replace(hot, value=hot.value[:, at], sigma=hot.sigma[:, at])
        return replace(self, products=products, hot=hot, links=tuple(self.links[n] for n in at))

    def level_dependence(self, couplings: Sequence[Coupling]) -> tuple[float, float]:
        """Relative change of the shares with the signal beside theirs, 1/ke-, and its error."""
        found = []
        if self.hot is not None:
            found.append(self.hot.level_dependence(couplings, self.links, self.first))
        if self.products is not None:
            found.append(level_dependence(self.products, couplings, self.links))
        values, errors = np.array(found).T
        weight = errors**-2
        total = float(weight.sum())
        return (float(weight @ values) / total, total**-0.5) if total else (0.0, np.inf)

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
            normal, right = self._of_noise(products, terms)
            if self.hot is not None:
                shown = self.hot.by_class(classes, self.links, DOUBT)
                normal["hot pixels"], right["hot pixels"] = shown.sums()
            yield classes, Information(normal, right)

    def of_period(self, classes: PixelClasses) -> Information:
        """All links for one period, hot pixels taken at their word where they agree."""
        # A hot pixel that is alone in its class counts where the noise says the same.
        normal, right = self._of_noise(*(sums_of(sums, classes) for sums in self._sums))
        if self.hot is not None:
            shown = self.hot.by_class(classes, self.links)
            alone = (shown.count == 1) & (shown.value**2 * shown.weight > MARKED**2)
            if "covariance" in normal:
                alone &= ~_backed(shown.value, normal["covariance"], right["covariance"])
            normal["hot pixels"], right["hot pixels"] = shown.without(alone).sums()
        return Information(normal, right)

    def _of_noise(self, products: F64, terms: F64) -> tuple[dict[str, F64], dict[str, F64]]:
        if self.products is None:
            return {}, {}
        normal, right = _shares(products, terms, self.products.read)
        return {"covariance": normal}, {"covariance": right}


def _backed(value: F64, normal: F64, right: F64) -> Mask:
    """Whether the noise shows shares (link, class, 2) and agrees with their values."""
    apart = np.kron(np.eye(value.shape[1]), [[1.0, -1.0], [-1.0, 1.0]]) / ONE_WAY**2
    covariance = np.linalg.inv(normal + apart + np.eye(len(apart)) / LARGEST**2)
    share = np.einsum("luv,lv->lu", covariance, right).reshape(value.shape)
    error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).reshape(value.shape)
    return np.asarray((share > BACKED * error) & (np.abs(value - share) < MARKED * error))


def _shares(right: F64, normal: F64, read: float) -> tuple[F64, F64]:
    """Sums of the shares alone (link, u, u), the constant and brighter-fatter having been freed.

    ``right, normal``: (link, term, class) float64 as in `Products`. ``read``: variance without
    light, which the constant may well reach.
    """
    links, _, count = right.shape
    free = range(2, TERMS)

    def block(i: int, j: int) -> F64:
        return normal[:, NORMAL[min(i, j), max(i, j)]]

    own: F64 = np.zeros((links, count, 2, count, 2))
    at = np.arange(count)
    for i in range(2):
        for j in range(2):
            own[:, at, i, at, j] = block(i, j)
    cross = np.stack([np.stack([block(i, j) for j in free], -1) for i in range(2)], -2)
    cross = cross.reshape(links, 2 * count, -1)
    nuisance = np.stack([np.stack([block(i, j).sum(-1) for j in free], -1) for i in free], -2)
    nuisance += np.diag([read**-2] + [(BRIGHTER_FATTER * UNIT) ** -2] * 2)
    taken = cross @ np.linalg.inv(nuisance)
    shares = right[:, :2].swapaxes(1, 2).reshape(links, -1)
    rest = shares - np.einsum("lun,ln->lu", taken, right[:, 2:].sum(-1))
    return own.reshape(links, 2 * count, -1) - taken @ cross.swapaxes(1, 2), rest
