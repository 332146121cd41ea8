"""The sources that measure shares: noise, hot pixels and maps, corrected for known couplings.

Each class of pixels has two unknown shares for a link, there and back: what remains beyond the
known ones. Every source is linear in these, and gives least-squares sums of the same unknowns.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.crosstalk.covariance import Products
from pixcal.estimators.crosstalk.equations import Equations
from pixcal.estimators.crosstalk.hot_pixels import HotPixels, hot_pixels
from pixcal.estimators.crosstalk.links import (
    PixelClasses,
    Place,
    class_sums,
    couplings_of,
    shares_of,
)
from pixcal.estimators.crosstalk.maps import Maps
from pixcal.estimators.crosstalk.residuals import UNIT
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.boundaries import REACH, boundary_shifts, shared_noise
from pixcal.kernels.crosstalk import Coupling
from pixcal.model.arrays import F64

CHANGES = np.arange(-1.0, 50.0, 2e-3)  # relative, of shares, up to the brightest light
BRIGHT = 50.0  # the same without light: charge of hot pixels, ke-
CERTAIN = 5.0  # sigmas beyond which such a change is accepted
MORE = 10.0  # fall in chi-square that boundaries, as a further cause, must bring; as in a search
FALLOFFS = (0.25, 0.5, 1.0)  # of boundary shifts with distance, px


@dataclass(frozen=True)
class Sources:
    """Measurements of some links."""

    noise: Products
    hot: HotPixels | None
    maps: Maps | None
    links: tuple[Place, ...]
    shape: tuple[int, ...]  # rows and columns of the arrays
    first: Place  # their first in the window
    known: tuple[Coupling, ...] = ()

    def of(self, steps: Sequence[Place]) -> "Sources":
        """Those of some links."""
        at = [self.links.index(step) for step in steps]
        hot = None if self.hot is None else self.hot.of(at)
        return replace(self, noise=self.noise.of(at), hot=hot, links=tuple(steps))

    def periods(
        self, only: Place | None = None, doubted: bool = True
    ) -> Iterator[tuple[PixelClasses, dict[str, Equations]]]:
        """Equations by source, for each period that fits, or for one (rows, columns).

        ``doubted``: with `DOUBT` of all hot pixels.
        """
        sums = self.noise.right, self.noise.normal
        both = (class_sums(one, self.first, only) for one in sums)
        for (classes, rights), (_, normals) in zip(*both, strict=True):
            found = {}
            if self.noise.lit:
                found["covariance"] = self.noise.equations(rights, normals)
            if self.hot is not None:
                found["hot pixels"] = self.hot.equations(classes, self.links, doubted)
            yield classes, found

    def known_shares(self, classes: PixelClasses) -> tuple[F64, F64]:
        """Known shares (link, class, 2), there and back, and their rises with the signal, 1/ke-."""
        every = couplings_of(classes, self.links)
        rising = [c.scaled(c.per_ke) for c in self.known]
        shape = len(self.links), classes.count, 2
        return shares_of(every, self.known).reshape(shape), shares_of(every, rising).reshape(shape)

    def level_dependence(self, classes: PixelClasses) -> tuple[float, float, bool]:
        """Relative change of the known shares with the signal, zero if not certain; its error.

        Both in 1/ke-. All shares change by the same factor. A rise is attributed to boundaries
        shifted by charge (brighter-fatter) if these describe the noise much better. The last value:
        whether either is possible.
        """
        known, rising = (shares.mean(axis=1) for shares in self.known_shares(classes))
        measured, by_boundaries = [], 0.0
        for source, equations in next(self.periods((1, 1), False))[1].items():
            share, rise, covariance = equations.rises(known, rising)
            variance = covariance[..., 1, 1]
            seen, used = np.isfinite(variance), (known != 0) @ equations.of_rise.T > 0
            measured.append([a[seen] for a in (share, rise, used, covariance)])
            if source == "covariance":
                by_boundaries += _left_by_boundaries(self.links, rise[:, 1], variance[:, 1])
            else:
                by_boundaries += float((rise[seen] ** 2 / variance[seen]).sum())
        share, rise, used, covariance = (np.concatenate(a) for a in zip(*measured, strict=True))
        (own, mixed), (_, other) = np.moveaxis(covariance, 0, -1)
        brightest = self.noise.brightest * UNIT / 1e3 if self.noise.lit else BRIGHT
        trial = np.append(CHANGES / brightest, 0.0)[:, None]
        variance = other - 2 * trial * mixed + trial**2 * own
        left = (rise - trial * share) ** 2 / variance
        own_left = left[:, used].sum(axis=1)
        best = own_left.argmin()
        weight = float((share**2 / variance[best])[used].sum())
        doubt = self.noise.shot[2] if self.noise.lit else 0.0
        gain = (own_left[-1] - own_left[best]) / (1 + weight * doubt**2)
        rises, better = trial[best, 0] > 0, float(left[best].sum()) - by_boundaries
        taken = gain > CERTAIN**2 and not (rises and better > MORE)
        error = float(np.hypot(max(weight, 1e-30) ** -0.5, doubt))
        return float(trial[best, 0]) if taken else 0.0, error, bool(rises and abs(better) < MORE)


def total(equations: Mapping[str, Equations], per_ke: float = 0.0) -> tuple[F64, F64]:
    """Sums (link, u, u), (link, u) of the shares over all sources; see `Equations.shares`."""
    normal, right = zip(*(one.shares(per_ke) for one in equations.values()), strict=True)
    return np.sum(normal, axis=0), np.sum(right, axis=0)


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
    noise: Products | None = None
    for part in parts:
        if noise is None:
            shape, first, steps = part.good.shape, part.origin, steps_in(part.good.shape)
            maps, hot = Maps.of(part.without_frames(), known), hot_pixels(part, steps, known)
            noise = Products.none(steps, part)
        noise.add(part, steps, known)
        del part  # the next one is read only then
    if noise is None or not (noise.lit or hot):
        return None
    return Sources(noise, hot, maps, steps, shape, first, known)
