"""The sources that measure shares: noise, hot pixels and maps, corrected for known couplings.

Each class of pixels has two unknown shares for a link, there and back: what remains beyond the
known ones. Every source is linear in these, and gives least-squares sums of the same unknowns.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.crosstalk.covariance import (
    Products,
    joined,
    products,
    share_and_square,
    share_sums,
)
from pixcal.estimators.crosstalk.hot_pixels import HotPixels, hot_pixels
from pixcal.estimators.crosstalk.links import PixelClasses, Place, class_sums, sums_of
from pixcal.estimators.crosstalk.maps import Maps
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.boundaries import REACH, boundary_shifts, shared_noise
from pixcal.kernels.crosstalk import Coupling
from pixcal.kernels.normal_matrix import symmetric
from pixcal.model.arrays import F32, F64

CHANGES = np.arange(-0.02, 1.0, 1e-4)  # relative, of shares with the signal, 1/ke-
CERTAIN = 5.0  # sigmas beyond which such a change is accepted
MORE = 10.0  # fall in chi-square that boundaries, as a further cause, must bring; as in a search
FALLOFFS = (0.25, 0.5, 1.0)  # of boundary shifts with distance, px

# Least-squares sums of the shares of each link, by source: normal (link, u, u), right (link, u)
Information = dict[str, tuple[F64, F64]]


def total(information: Information) -> tuple[F64, F64]:
    """Sums over all sources."""
    normal, right = zip(*information.values(), strict=True)
    return np.sum(normal, axis=0), np.sum(right, axis=0)


@dataclass(frozen=True)
class Sources:
    """Measurements of some links."""

    noise: Products | None
    hot: HotPixels | None
    maps: Maps | None
    links: tuple[Place, ...]
    shape: tuple[int, ...]  # rows and columns of the arrays
    first: Place  # their first in the window
    known: tuple[Coupling, ...] = ()

    def of(self, steps: Sequence[Place]) -> "Sources":
        """Those of some links."""
        at = [self.links.index(step) for step in steps]
        noise = None if self.noise is None else self.noise.of(at)
        hot = None if self.hot is None else self.hot.of(at)
        return replace(self, noise=noise, hot=hot, links=tuple(steps))

    def every_period(self) -> Iterator[tuple[PixelClasses, F64, F64]]:
        """Sums of all links for each period that fits, with `DOUBT` of all hot pixels."""
        both = zip(*(class_sums(one, self.first) for one in self._products), strict=True)
        for (classes, right), (_, normal) in both:
            yield classes, *total(self._information(classes, right, normal, True))

    def of_period(self, classes: PixelClasses, per_ke: float) -> Information:
        """All links, for one period, and for shares that change with the signal (1/ke-)."""
        right, normal = (sums_of(one, classes) for one in self._products)
        return self._information(classes, right, normal, False, per_ke)

    def level_dependence(self) -> tuple[float, float, bool]:
        """Relative change of the known shares with the signal, zero if not certain; its error.

        Both in 1/ke-. All shares change by the same factor. A rise is attributed to boundaries
        shifted by charge (brighter-fatter) if these describe the noise much better. The last value:
        whether either is possible.
        """
        there = self._by_link(self.known) != 0
        shares, rises, covariances, used = [], [], [], []  # of each measured value
        doubt = by_boundaries = 0.0
        if self.noise is not None:
            shot, apart, error = self.noise.shot
            doubt = error / 20
            value, covariance = share_and_square(self.noise)
            share, square = value.T / shot
            # Both pixels of a pair give; 10⁴ e- are 10 ke-.
            share = 40 * share + 20 * self._by_link(self.known).sum(axis=1)
            square += 20 * self._by_link(self.known, True).sum(axis=1)
            # A slope of the variance is no change of the shares.
            shares, rises = [share], [square - apart / 20 * share]
            covariances = [covariance * [[1600, 40], [40, 1]]]
            used = [there.any(axis=1)]
            by_boundaries = _left_by_boundaries(self.links, rises[0], covariance[:, 1, 1])
        if self.hot is not None:
            hot = self.hot.by_class(PixelClasses(1, 1, self.first), self.links)
            share, rise, covariance = hot.rises()
            seen = covariance[..., 1, 1] < np.inf
            rise = rise + self._by_link(self.known, True)
            by_boundaries += float((rise**2 / covariance[..., 1, 1])[seen].sum())
            shares.append((share + self._by_link(self.known))[seen])
            rises.append(rise[seen])
            covariances.append(covariance[seen])
            used.append(there[seen])
        share, rise = np.concatenate(shares), np.concatenate(rises)
        (own, mixed), (_, other) = np.moveaxis(np.concatenate(covariances), 0, -1)
        trial = np.append(CHANGES, 0.0)[:, None]
        left = (rise - trial * share) ** 2 / (other - 2 * trial * mixed + trial**2 * own)
        own_left = left[:, np.concatenate(used)].sum(axis=1)
        best = own_left.argmin()
        weight = share**2 / (other - 2 * trial[best] * mixed + trial[best] ** 2 * own)
        weight = float(weight[np.concatenate(used)].sum())
        gain = (own_left[-1] - own_left[best]) / (1 + weight * doubt**2)
        rises, better = trial[best, 0] > 0, float(left[best].sum()) - by_boundaries
        taken = gain > CERTAIN**2 and not (rises and better > MORE)
        error = float(np.hypot(max(weight, 1e-30) ** -0.5, doubt))
        return float(trial[best, 0]) if taken else 0.0, error, bool(rises and abs(better) < MORE)

    def _by_link(self, couplings: Sequence[Coupling], changes: bool = False) -> F64:
        """Shares (link, 2) there and back, mean of all pixels, or their changes with the signal."""
        sums = np.zeros((len(self.links), 2))
        for c in couplings:
            back = (c.dy, c.dx) not in self.links
            link = self.links.index((-c.dy, -c.dx) if back else (c.dy, c.dx))
            share = c.share * c.per_ke if changes else c.share
            sums[link, int(back)] += share / (c.every_rows * c.every_columns)
        return sums

    @property
    def _products(self) -> tuple[F32, F32]:
        if self.noise is None:
            none = np.zeros((len(self.links), 0, *self.shape), np.float32)
            return none, none
        return self.noise.right, self.noise.normal

    def _information(
        self, classes: PixelClasses, right: F64, normal: F64, doubted: bool, per_ke: float = 0.0
    ) -> Information:
        sums = {}
        # The change of the frames if the known shares changed by this.
        more = self._by_link(self.known, True) - per_ke * self._by_link(self.known)
        if self.noise is not None:
            squares = symmetric(np.moveaxis(normal, 1, -1))[..., -1]
            right = right / self.noise.shot[0] + np.moveaxis(
                squares * (20 * more.sum(axis=1))[:, None, None], -1, 1
            )
            sums["covariance"] = share_sums(right, normal, self.noise.read, per_ke)
        if self.hot is not None:
            hot = self.hot.by_class(classes, self.links, doubted)
            sums["hot pixels"] = hot.sums(more, per_ke)
        return sums


def _left_by_boundaries(links: Sequence[Place], value: F64, variance: F64) -> float:
    """Chi-square of quadratic terms that boundaries shifted by charge (brighter-fatter) leave."""
    weighted, left = value / np.sqrt(variance), []
    even = np.ones((1, 4 * REACH + 1, 4 * REACH + 1), np.float32)
    still = np.zeros_like(even), np.zeros_like(even)
    middle = 0, 2 * REACH, 2 * REACH
    for falloff in FALLOFFS:
        shifts = boundary_shifts(falloff)
        shared = [
            [shared_noise(even, still, shifts, step, axes)[middle] for step in links]
            for axes in ((1.0, 0.0), (0.0, 1.0))
        ]
        pattern = np.array(shared).T / np.sqrt(variance)[:, None]
        left.append(float(np.sum((weighted - pattern @ np.linalg.pinv(pattern) @ weighted) ** 2)))
    return min(left)


def sources_of(
    parts: Iterable[Evidence],
    steps_in: Callable[[tuple[int, ...]], tuple[Place, ...]],
    known: tuple[Coupling, ...] = (),
) -> Sources | None:
    """What several parts of the frames measure together; None without light and dark signal.

    ``parts``: of the same pixels, each needed once. ``steps_in``: steps (dy, dx) in a window of
    given rows and columns. ``known``: couplings for which all data are corrected first.
    """
    noise: list[Products | None] = []
    sources: Sources | None = None
    for part in parts:
        if sources is None:
            shape, steps = part.good.shape, steps_in(part.good.shape)
            maps, hot = Maps.of(part.without_frames(), known), hot_pixels(part, steps, known)
            sources = Sources(None, hot, maps, steps, shape, part.origin, known)
        noise.append(products(part, sources.links, known))
        del part  # the next one is read only then
    total = joined(noise)
    if sources is None or (total is None and sources.hot is None):
        return None
    return replace(sources, noise=total)
