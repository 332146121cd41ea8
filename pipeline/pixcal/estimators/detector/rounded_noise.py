"""Read noise below a step or so, from the codes of each pixel in a few frames without light.

Rounding changes such noise by an amount that depends on where the level is between two codes;
pixels differ in level and in noise. Their codes follow a mixture: rounded normal noise about a
level. The noise is log-normal over the pixels, the level normal. Codes of all pixels together have
a likelihood; noise is the mean of its posterior.
"""

from collections.abc import Callable

import numpy as np
from scipy.special import gammaln, ndtr

from pixcal.estimators.detector.bad_pixels import certainly_noisy
from pixcal.estimators.detector.calibration import usual_variance
from pixcal.estimators.detector.emva import Measure
from pixcal.kernels.rounding import SHEPPARD
from pixcal.model.arrays import F64, I64

BELOW = 0.75  # noise (steps) below which rounding adds more, or less, than a twelfth
FRAMES = 8  # most frames: what a pixel tells of its noise hardly grows with more

_FINE = 32  # levels per step
_STEP = 0.05  # of the logarithms of noise
_LOGS = np.arange(np.log(0.03), np.log(3.0), _STEP)
# Least and most: logarithm of the mean noise, and standard deviation of the logarithm over pixels;
# logarithm of the standard deviation of levels. All steps.
_NOISES, _SPREADS, _LEVELS = np.log([0.05, 1.2]), np.array([0.0, 0.5]), np.log([0.02, 1.5])
_OUTER, _INNER = (9, 6), (9, 9)  # points
_ALIKE = 0.9  # scatter of means (steps) above which levels are uniform between codes
_WIDEST = 14  # codes of a pixel
_LOUD = 2.0  # noise over the usual one that is of the same population
_MARGIN = 4  # steps beyond a pixel's codes at which its level may be
_DEEP, _ROUNDS = 8.0, 20  # logarithm of likelihood below the maximum that counts; of refinement
_MARKS = 6  # points about which the grid is refined
_KNOWN = 0.2  # largest relative error


def noise_of_codes(codes: I64, shot: float = 0.0) -> tuple[Measure | None, float | None]:
    """Noise without rounding, rms over pixels, and its error; steps; None where undetermined.

    Also the standard deviation of its logarithm over the pixels; None without usable pixels.

    ``codes``: (t, n) of at least two frames, in steps. ``shot``: variance (square steps) to
    subtract; so is that common to all pixels of a frame.
    """
    codes = codes[:FRAMES]
    dof = len(codes) - 1
    variance = codes.var(axis=0, ddof=1)
    usual = max(usual_variance(variance, dof), 0.25 + SHEPPARD)
    quiet = variance <= _LOUD**2 * certainly_noisy(dof) * usual
    codes = codes[:, quiet & (np.ptp(codes, axis=0) <= _WIDEST)]
    if not codes.size:
        return None, None
    wander = codes.mean(axis=1).var(ddof=1) - codes.var(axis=0, ddof=1).mean() / codes.shape[1]
    law = _Codes(codes)

    def likelihood(noises: F64, spreads: F64) -> F64:
        return np.array([[law.likelihood(law.chances(u, t)) for t in spreads] for u in noises])

    (noises, spreads), share, _ = _posterior(likelihood, np.stack([_NOISES, _SPREADS]), _OUTER)
    of_rms = noises[:, None] + spreads**2 / 2
    mean = float((share * of_rms).sum())
    error = float(np.sqrt((share * (of_rms - mean) ** 2).sum()))
    best = np.unravel_index(share.argmax(), share.shape)
    error *= law.misfit(law.chances(noises[best[0]], spreads[best[1]]))
    noise = float(np.sqrt(max(np.exp(2 * mean) - max(wander, 0.0) - shot, 0.0)))
    spread = float((share * spreads).sum())
    unbounded = noises[0] == _NOISES[0] and share[0].max() > np.exp(-_DEEP) * share.max()
    if unbounded or not noise or not error < _KNOWN:
        return None, spread
    return (noise, error * float(np.exp(2 * mean)) / noise), spread


class _Codes:
    """How often codes of pixels occur, and how likely they are."""

    def __init__(self, codes: I64) -> None:
        low, means = codes.min(axis=0), codes.mean(axis=0)
        spread = float(means.std())
        # Levels are on a circle of so many steps: far outliers fold onto it.
        self.round = 1 if spread > _ALIKE else int(np.ceil(6 * spread)) + _MARGIN
        middle = float(np.median(means))
        self.middle = middle % self.round
        above = codes - low
        counts = np.stack([(above == k).sum(axis=0) for k in range(above.max() + 1)])
        weights = (len(codes) + 1) ** np.arange(len(counts))
        _, first, which = np.unique(weights @ counts, return_index=True, return_inverse=True)
        self.counts = counts[:, first].T
        self.orders = gammaln(len(codes) + 1) - gammaln(self.counts + 1).sum(axis=1)
        both, number = np.unique(which * self.round + low % self.round, return_counts=True)
        self.kind, self.low = both // self.round, both % self.round
        self.number = number.astype(float)
        self._tables: dict[int, F64] = {}

    def _table(self, n: int) -> F64:
        """Probabilities (kind, level) of the codes, for the noise number ``n`` of `_LOGS`."""
        if n not in self._tables:
            width = self.counts.shape[1]
            places = np.arange(-_MARGIN * _FINE, (width + _MARGIN) * _FINE)
            edges = np.arange(width + 1) - 0.5
            chance = np.diff(ndtr((edges - places[:, None] / _FINE) / np.exp(_LOGS[n])), axis=1)
            own = np.exp(self.orders[:, None] + self.counts @ np.log(np.maximum(chance, 1e-30)).T)
            size = self.round * _FINE
            folded = np.zeros((size, len(own)))
            np.add.at(folded, places % size, own.T)
            at = (np.arange(size) - self.low[:, None] * _FINE) % size
            self._tables[n] = folded.T[self.kind[:, None], at]
        return self._tables[n]

    def chances(self, noise: float, spread: float) -> F64:
        """Probabilities (kind, level) with pixels of unequal noise; ``noise``: log of its mean."""
        off = _LOGS - (noise - spread**2 / 2)
        ends = np.append(off - _STEP / 2, off[-1] + _STEP / 2)
        wide = np.diff(ndtr(ends / max(spread, _STEP / 9)))
        share = np.maximum(1 - np.abs(off) / _STEP, 0) if spread < _STEP / 2 else wide
        used = np.flatnonzero(share > 1e-6)
        return np.asarray(sum(share[n] / share.sum() * self._table(n) for n in used.tolist()))

    def likelihood(self, chances: F64) -> float:
        """Its logarithm, integrated over the distribution of the levels."""
        if self.round == 1:
            return float(self.number @ np.log(chances.mean(axis=1)))

        def at(middles: F64, widths: F64) -> F64:
            levels = self._levels(middles, np.exp(widths))
            seen = chances @ levels.reshape(len(levels), -1)
            return np.asarray(self.number @ np.log(seen)).reshape(levels.shape[1:])

        middles = self.middle + np.array([-0.5, 0.5])
        axes, share, whole = _posterior(at, np.stack([middles, _LEVELS]), _INNER)
        best = np.unravel_index(share.argmax(), share.shape)
        self._best = self._levels(axes[0][[best[0]]], np.exp(axes[1][[best[1]]]))[:, 0, 0]
        return whole

    def _levels(self, middles: F64, widths: F64) -> F64:
        """Distributions (level, middle, width) of levels, with a few anywhere."""
        size = self.round * _FINE
        off = np.arange(size)[:, None] / _FINE - middles
        off = (off + self.round / 2) % self.round - self.round / 2
        chance = np.exp(-0.5 * (off[..., None] / widths) ** 2)
        return np.asarray((1 - 1e-4) * chance / chance.sum(axis=0) + 1e-4 / size)

    def misfit(self, chances: F64) -> float:
        """Root of the chi-square per degree of freedom, where it is above one."""
        self.likelihood(chances)
        levels = self._best if self.round > 1 else np.full(_FINE, 1 / _FINE)
        expected = self.number.sum() * (chances @ levels)
        # Deviance of counts; codes that did not occur have their expected number.
        off = self.number * np.log(self.number / expected) - self.number + expected
        freedom = max(len(self.number) - 4, 1)
        return float(np.sqrt(max(2 * off.sum() / freedom, 1.0)))


def _posterior(
    likelihood: Callable[[F64, F64], F64], limits: F64, points: tuple[int, int]
) -> tuple[list[F64], F64, float]:
    """Axes and posterior on a grid that is refined about its maximum, and the log evidence.

    ``likelihood``: logarithms on a grid of two axes; ``limits``: (axis, 2) of a uniform prior.
    """
    ends = limits.copy()
    for _ in range(_ROUNDS):
        axes = [np.linspace(a, b, n) for (a, b), n in zip(ends, points, strict=True)]
        value = likelihood(*axes)
        deep, few = value.max() - _DEEP, False
        # A ridge aslant to the axes is narrower than a cell: several of the points mark it.
        near = value >= min(deep, np.sort(value, axis=None)[-_MARKS])
        for k, axis in enumerate(axes):
            (inside,) = np.nonzero(near.any(axis=1 - k))
            if np.count_nonzero((value > deep).any(axis=1 - k)) <= len(axis) // 2:
                cell, few = axis[1] - axis[0], True
                around = axis[inside[0]] - cell, axis[inside[-1]] + cell
                ends[k] = np.clip(around, *limits[k])
        if not few:
            break
    share = np.exp(value - value.max())
    cells = np.prod([axis[1] - axis[0] for axis in axes])
    return axes, share / share.sum(), float(value.max() + np.log(share.sum() * cells))
