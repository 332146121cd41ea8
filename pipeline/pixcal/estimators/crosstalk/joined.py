"""The kernel: what darks, noise and maps say together, and each by itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pixcal.estimators.crosstalk.covariance import Products, products
from pixcal.estimators.crosstalk.hot_pixels import HotPixels, hot_pixels
from pixcal.estimators.crosstalk.information import Measured
from pixcal.estimators.crosstalk.links import Place, links
from pixcal.estimators.crosstalk.maps import map_information
from pixcal.estimators.crosstalk.second_order import to_first_order
from pixcal.estimators.crosstalk.support import Choice, Pick, again, choose
from pixcal.estimators.evidence import Evidence
from pixcal.kernels.crosstalk import Coupling, outflow

F64 = NDArray[np.float64]
Sums = tuple[F64, F64]

ROUNDS = 4
"""Times that the couplings are found at most; each knows the second order of those before."""
LEVEL_STEPS = 10
"""Steps of a level dependence."""
MAP_STEPS = 3
"""Steps of the shares with the maps."""
SAME = 1e-5
"""Change of a share that is none."""
LARGEST = 0.1
"""How large a share may well be."""
ALIKE, DIFFERENT = 0.02, 0.3
"""How much shares that one number serves differ, relatively, where they are nearly alike or not."""
LEAST = 3e-4
"""Share below which that is taken of this."""
CERTAIN = 5.0
"""Sigmas beyond which a level dependence is taken."""


@dataclass(frozen=True)
class Kernel:
    """Couplings as measured.

    Attributes
    ----------
    couplings : tuple of Coupling
    covariance : (n, n) float64
        Of their shares.
    significance : float
        Of the strongest, in sigmas, corrected for all that was tried.
    by : mapping of str to ((n,), (n,) float64)
        Shares and errors of each way of measuring by itself.
    hot_pixels : int
        Used.
    per_ke, per_ke_error : float
        Relative change of the shares with the source's signal as hot pixels show it, 1/ke-, where
        they fall; the error infinite where they cannot tell.
    """

    couplings: tuple[Coupling, ...]
    covariance: F64
    significance: float
    by: Mapping[str, tuple[F64, F64]]
    hot_pixels: int
    per_ke: float
    per_ke_error: float


def measure(evidence: Evidence) -> Kernel | None:
    """Couplings of an acquisition; None where it has neither light nor dark signal to tell."""
    search = _Search.of(evidence)
    if search is None:
        return None
    found, known = search.couplings((), 0.0)
    pixels = 0 if search.hot is None else len(search.hot.y)
    per_ke, per_ke_error = 0.0, np.inf
    if known:
        known, per_ke, per_ke_error = search.level(known)
        # Once more, with the charge as it was collected, and all hot pixels.
        search = _Search.of(evidence, known) or search
        found, known = search.couplings(known, per_ke)
    if not known:
        return Kernel((), np.zeros((0, 0)), found.significance, {}, pixels, 0.0, np.inf)
    ways = _ways(found.picks, search.noise, known)
    for _ in range(MAP_STEPS):
        # The maps are those of one level, and linear only about shares that are nearly right.
        maps = None if per_ke else map_information(evidence, known)
        if maps is not None:
            ways["maps"] = maps
        about = _together(ways, found.picks)
        shares, covariance = _solve(ways, *about)
        known = _with_shares(found.picks, shares, per_ke)
    alone = {way: _solve({way: sums}, *about) for way, sums in ways.items()}
    by = {way: (own, np.sqrt(np.diag(c))) for way, (own, c) in alone.items()}
    return Kernel(known, covariance, found.significance, by, pixels, per_ke, per_ke_error)


def _shape(evidence: Evidence) -> Place:
    return evidence.good.shape[0], evidence.good.shape[1]


@dataclass(frozen=True)
class _Search:
    """The noise and the hot pixels of an acquisition, in which couplings are looked for."""

    noise: Products | None
    hot: HotPixels | None
    steps: tuple[Place, ...]
    shape: Place
    first: Place

    @classmethod
    def of(cls, evidence: Evidence, known: Sequence[Coupling] = ()) -> "_Search | None":
        shape = _shape(evidence)
        steps = links(shape)
        if not steps:
            return None
        noise, hot = products(evidence, steps, known), hot_pixels(evidence, steps, known)
        if noise is None and hot is None:
            return None
        return cls(noise, hot, steps, shape, evidence.origin)

    def couplings(
        self, known: tuple[Coupling, ...], per_ke: float
    ) -> tuple[Choice, tuple[Coupling, ...]]:
        """Couplings by noise and hot pixels; those known before give the second order."""
        found = choose(self._measured(known, per_ke))
        for _ in range(ROUNDS):
            if not found.picks:
                return found, ()
            ways = _ways(found.picks, self.noise, known)
            shares, _ = _solve(ways, *_together(ways, found.picks))
            before, known = known, _with_shares(found.picks, shares, per_ke)
            if _same(before, known):
                break
            found = again(found, self._measured(known, per_ke))
        return found, known

    def _measured(self, known: Sequence[Coupling], per_ke: float) -> Measured:
        noise, hot = self.noise, self.hot
        if noise is not None:
            noise = to_first_order(noise, known, self.steps, self.first)
        if hot is not None:
            hot = hot.corrected(outflow(known, self.shape, self.first), per_ke)
        return Measured(noise, hot, self.steps, self.shape, self.first)

    def level(self, known: tuple[Coupling, ...]) -> tuple[tuple[Coupling, ...], float, float]:
        """Couplings whose shares may fall with the signal, by how much (1/ke-), and its error.

        Shares that rise may be brighter-fatter; those that fall cannot.
        """
        per_ke, error = 0.0, np.inf
        if self.hot is None:
            return known, per_ke, error
        for _ in range(LEVEL_STEPS):
            hot = self.hot.corrected(outflow(known, self.shape, self.first), per_ke)
            more, error = hot.level_dependence(known, self.steps, self.first)
            if per_ke + more > -CERTAIN * error:
                return known, 0.0, error
            if abs(more) < 0.1 * error:
                break
            per_ke += more
            _, known = self.couplings(known, per_ke)
        return known, per_ke, error


def _couplings(picks: Sequence[Pick]) -> tuple[Coupling, ...]:
    return tuple(c for pick in picks for c in pick.couplings)


def _with_shares(picks: Sequence[Pick], shares: F64, per_ke: float) -> tuple[Coupling, ...]:
    pairs = zip(_couplings(picks), shares, strict=True)
    return tuple(replace(c, share=float(k), per_ke=per_ke) for c, k in pairs)


def _same(before: Sequence[Coupling], now: Sequence[Coupling]) -> bool:
    return len(before) == len(now) and all(
        replace(a, share=b.share) == b and abs(a.share - b.share) < SAME
        for a, b in zip(before, now, strict=True)
    )


def _ways(
    picks: Sequence[Pick], noise: Products | None, known: Sequence[Coupling]
) -> dict[str, Sums]:
    """Sums of all shares taken, by way of measuring."""
    names = {way for pick in picks for way in pick.information.normal}
    ways = {}
    for way in sorted(names):
        normal = block_diag(*(pick.information.normal[way] for pick in picks))
        right = np.concatenate([pick.information.right[way] for pick in picks])
        ways[way] = (normal, right)
    if noise is not None and "covariance" in ways:
        before = {replace(c, share=0.0, per_ke=0.0): c.share for c in known}
        shares = np.array([before.get(c, 0.0) for c in _couplings(picks)])
        ways["covariance"] = any_gain(ways["covariance"], noise, shares)
    return ways


def any_gain(sums: Sums, noise: Products, shares: F64) -> Sums:
    """Sums where all shares may be wrong by the error of the shot noise they are measured in."""
    normal, right = sums
    slope = normal @ shares
    inner = shares @ slope + (noise.shot / noise.shot_error) ** 2
    return normal - np.outer(slope, slope) / inner, right - slope * (shares @ right) / inner


def _together(ways: Mapping[str, Sums], picks: Sequence[Pick]) -> tuple[F64, F64]:
    """Basis (share, number) of all shares taken, and the shares if it held exactly."""
    basis = block_diag(*(pick.basis for pick in picks))
    normal, right = (sum(part) for part in zip(*ways.values(), strict=True))
    small = np.eye(len(basis)) / LARGEST**2
    return basis, basis @ np.linalg.solve(basis.T @ (normal + small) @ basis, basis.T @ right)


def _solve(ways: Mapping[str, Sums], basis: F64, together: F64) -> Sums:
    """Shares and their covariance.

    Shares that one number serves are alike, but how much? All nearly, or all but one, or each a
    little different: these count by how well they explain what is measured. So a share of which
    little is known has the error of one that may differ, whatever the others are.
    """
    normal, right = (sum(part) for part in zip(*ways.values(), strict=True))
    size = np.maximum(np.abs(together), LEAST)
    one = ALIKE * size
    guesses = [one, DIFFERENT * size] + [
        np.where(row, DIFFERENT * size, one) for row in np.eye(len(size))
    ]
    shares, covariances, weights = [], [], []
    for spread in guesses:
        precision, log_size = _about(basis, spread)
        whole = normal + precision + np.eye(len(right)) / LARGEST**2
        covariances.append(np.linalg.inv(whole))
        shares.append(covariances[-1] @ right)
        fit = float(right @ shares[-1])
        weights.append((fit + log_size - float(np.linalg.slogdet(whole)[1])) / 2)
    weight = np.exp(np.array(weights) - max(weights))
    weight /= weight.sum()
    mean = weight @ np.array(shares)
    apart = np.array(shares) - mean
    return mean, np.tensordot(weight, covariances, 1) + (weight * apart.T) @ apart


def _about(basis: F64, spread: F64) -> tuple[F64, float]:
    """Precision of shares that scatter about a basis, all of which is free; log of its size."""
    precision = np.diag(spread**-2)
    inner = basis.T @ precision @ basis
    common = precision @ basis @ np.linalg.solve(inner, basis.T @ precision)
    return precision - common, -2 * float(np.log(spread).sum()) - float(np.linalg.slogdet(inner)[1])
