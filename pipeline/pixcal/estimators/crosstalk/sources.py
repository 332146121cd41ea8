"""The sources that measure shares: noise, hot pixels and maps, freed of the couplings known so far.

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
    share_sums,
    square_terms,
)
from pixcal.estimators.crosstalk.hot_pixels import HotPixels, hot_pixels
from pixcal.estimators.crosstalk.links import PixelClasses, Place, class_sums, sums_of
from pixcal.estimators.crosstalk.maps import Maps
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.crosstalk import Coupling
from pixcal.model.arrays import F32, F64

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

    def of_period(self, classes: PixelClasses) -> Information:
        """All links, for one period."""
        right, normal = (sums_of(one, classes) for one in self._products)
        return self._information(classes, right, normal, False)

    def level_dependence(self, couplings: Sequence[Coupling]) -> tuple[float, float]:
        """Further relative change of all shares with the signal, 1/ke-, and its error."""
        slope = np.zeros((len(self.links), 2))
        for c in couplings:
            back = (c.dy, c.dx) not in self.links
            link = self.links.index((-c.dy, -c.dx) if back else (c.dy, c.dx))
            slope[link, int(back)] += c.share / (c.every_rows * c.every_columns)
        right = weight = doubt = 0.0
        if self.noise is not None:
            value, variance = square_terms(self.noise)
            # 10⁴ e- are 10 ke-; a slope of the variance is no change of the shares.
            rise = 20 * slope.sum(axis=1)
            shot, apart, error = self.noise.shot
            right += float(rise / variance @ (value / shot - apart / 20 * rise))
            weight += float(rise / variance @ rise)
            doubt = error / 20
        if self.hot is not None:
            found = self.hot.by_class(PixelClasses(1, 1, self.first), self.links)
            right += float((slope * found.product[:, 0]).sum())
            weight += float((slope**2 * found.square[:, 0]).sum())
        return (right / weight, float(np.hypot(weight**-0.5, doubt))) if weight else (0.0, np.inf)

    @property
    def _products(self) -> tuple[F32, F32]:
        if self.noise is None:
            none = np.zeros((len(self.links), 0, *self.shape), np.float32)
            return none, none
        return self.noise.right, self.noise.normal

    def _information(
        self, classes: PixelClasses, right: F64, normal: F64, doubted: bool
    ) -> Information:
        found = {}
        if self.noise is not None:
            found["covariance"] = share_sums(right / self.noise.shot[0], normal, self.noise.read)
        if self.hot is not None:
            found["hot pixels"] = self.hot.by_class(classes, self.links, doubted).sums()
        return found


def sources_of(
    parts: Iterable[Evidence],
    steps_in: Callable[[tuple[int, ...]], tuple[Place, ...]],
    known: tuple[Coupling, ...] = (),
) -> Sources | None:
    """What several parts of the frames measure together; None without light and dark signal.

    ``parts``: of the same pixels, each needed once. ``steps_in``: steps (dy, dx) in a window of
    given rows and columns. ``known``: couplings that all is freed of first.
    """
    noise: list[Products | None] = []
    found: Sources | None = None
    for part in parts:
        if found is None:
            shape, steps = part.good.shape, steps_in(part.good.shape)
            maps, hot = Maps.of(part.without_frames(), known), hot_pixels(part, steps, known)
            found = Sources(None, hot, maps, steps, shape, part.origin, known)
        noise.append(products(part, found.links, known))
        del part  # the next one is read only then
    total = joined(noise)
    if found is None or (total is None and found.hot is None):
        return None
    return replace(found, noise=total)
