"""Detection of couplings: significant links, periods and classes of pixels.

Every pair of pixels a step apart, and every period of rows and columns, is tested. A link is
accepted at a false-alarm rate of one acquisition in a hundred; half of that is reserved for the few
tests of adjacent pixels with equal coupling everywhere. Shares there and back, and of many classes,
are one number until the data separate them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, ndtri, ndtri_exp

from pixcal.estimators.crosstalk.information import MeasuredLinks, total
from pixcal.estimators.crosstalk.links import PixelClasses, Place, periods
from pixcal.kernels.crosstalk import Coupling
from pixcal.kernels.significance import log_of_any
from pixcal.model.arrays import F64
from pixcal.model.errors import InputError

FALSE_ALARM = 0.01  # chance that noise alone gives any coupling
# Effective share of independent tests, as periods have pixels in common. Measured: it makes the
# median significance of acquisitions without couplings about zero.
INDEPENDENT = 0.35
WORTH = 16.0  # fall in chi-square required of another share of a link that couples
NEAR, MAX_FAR = 2, 12  # distance (px), and most couplings of a kernel beyond it
NEAREST = (0, 1), (1, 0)  # links that a capacitance makes equal
NOTHING = 1e-6  # weight of a share below which it is not measured


@dataclass(frozen=True)
class FamilyOfTests:
    """Tests made together."""

    best: float  # largest chi-square of one of them
    count: int

    @property
    def log_none(self) -> float:
        """Logarithm of the probability that none is as large without couplings."""
        return float(INDEPENDENT * self.count * np.log1p(-np.exp(self._log_one)))

    @property
    def log_any(self) -> float:
        """Logarithm of the probability that one of them is."""
        return log_of_any(self._log_one, INDEPENDENT * self.count)

    @property
    def _log_one(self) -> float:
        return float(np.log(2) + log_ndtr(-np.sqrt(self.best)))


@dataclass(frozen=True)
class Choice:
    """All accepted couplings, and the significance of the best."""

    links: tuple[int, ...]  # that stand out
    classes: PixelClasses  # of the period
    families: tuple[FamilyOfTests, ...]  # each with the same share of the chance

    @property
    def significance(self) -> float:
        """Sigmas of a normal variate as rare as the best of so many tests."""
        rarest = min(self.families, key=lambda own: own.log_any)
        none = len(self.families) * rarest.log_none
        if none < -0.5:
            return float(ndtri_exp(none))
        return float(-ndtri_exp(rarest.log_any + np.log(len(self.families))))


def choose(measured: MeasuredLinks, pattern: Callable[[PixelClasses], float]) -> Choice:
    """Take the links that stand out, then the shortest period that serves them and the maps.

    ``pattern``: fall in chi-square of the maps by classes (`visibility_pattern`). Raises InputError
    if so many are far apart that it is no kernel.
    """
    tests = len(measured.links) * sum(3 * n * m for n, m in periods(measured.shape))
    critical = _critical(tests)
    totals = [total(information) for _, information in measured.every_period()]
    gains = np.stack([_best_gains(*sums) for sums in totals])
    best = gains.max(axis=0)
    close = [n for n, step in enumerate(measured.links) if max(map(abs, step)) == 1]
    nearest = [n for n in close if measured.links[n] in NEAREST]
    # Each link there, back and both; and the nearest ones as one number.
    few = 3 * len(close) + 1
    weight, value = (part[nearest].sum() for part in totals[0])
    alike = float(_fall(value, weight))
    taken = best > critical
    taken[close] |= gains[0, close] > _critical(few)
    taken[nearest] |= alike > _critical(few)
    there = tuple(int(n) for n in np.flatnonzero(taken))
    far = sum(max(map(abs, measured.links[n])) > NEAR for n in there)
    if far > MAX_FAR:
        raise InputError(
            f"not decided: noise is correlated at {len(there)} distances between pixels, {far} of "
            f"them beyond {NEAR} pixels (at most {MAX_FAR} are measured); this is not a "
            "crosstalk kernel"
        )
    none = PixelClasses(1, 1, measured.first)
    classes = _period(measured.of(there), pattern, critical) if there else none
    anywhere = FamilyOfTests(max(float(best.max()), 1e-9), tests)
    adjacent = FamilyOfTests(max(float(gains[0, close].max()), alike, 1e-9), few)
    return Choice(there, classes, (anywhere, adjacent))


def _critical(tests: int) -> float:
    return float(ndtri(FALSE_ALARM / 2 / tests / 2) ** 2)


def _period(
    present: MeasuredLinks, pattern: Callable[[PixelClasses], float], critical: float
) -> PixelClasses:
    """The shortest period that is good enough for all links together, and for the maps."""
    scores = []
    for classes, information in present.every_period():
        # Numbers that shares may be made of, (u, direction): each has some shares alike.
        # There, back and both, of each class of every period that divides the one at hand.
        every = []
        for coarse in classes.divisors():
            groups = (coarse.groups_of(classes) == np.arange(coarse.count)[:, None]).astype(float)
            there, back = np.zeros((2, coarse.count, 2 * classes.count))
            there[:, ::2] = back[:, 1::2] = groups
            every += [there + back, there, back]
        directions = np.concatenate(every).T
        score = pattern(classes) - WORTH * (classes.count - 1)
        for normal, right in zip(*total(information), strict=True):
            basis, gain = _greedy(normal, right, directions)
            score += gain - WORTH * basis.shape[1]
        scores.append((score, classes))
    enough = max(score for score, _ in scores) - critical
    return next(classes for score, classes in scores if score >= enough)


def _best_gains(normal: F64, right: F64) -> F64:
    """Largest fall in chi-square (link,) that one class gives: there, back or both."""
    own = np.diagonal(normal, axis1=-2, axis2=-1)
    mixed = np.diagonal(normal, 1, axis1=-2, axis2=-1)[..., ::2]
    weight = np.concatenate([own[..., ::2] + own[..., 1::2] + 2 * mixed, own], axis=-1)
    value = np.concatenate([right[..., ::2] + right[..., 1::2], right], axis=-1)
    return np.asarray(_fall(value, weight).max(axis=-1))


def _fall(value: F64, weight: F64) -> F64:
    return np.where(weight > NOTHING, value**2 / np.maximum(weight, NOTHING), 0.0)


def _greedy(normal: F64, right: F64, directions: F64) -> tuple[F64, float]:
    """Directions (u, number) that lower chi-square enough to keep, strongest first; the fall."""
    weight = np.einsum("ud,ud->d", directions, normal @ directions)
    # Of equals the plainest: many shares alike, both ways.
    plain = np.count_nonzero(directions, axis=0) / len(directions)
    basis = np.zeros((len(right), 0))
    gain, rest = 0.0, right
    while basis.shape[1] < len(right):
        each = _fall(rest @ directions, weight)
        n = int(np.argmax(each + plain))
        wider = np.column_stack([basis, directions[:, n]])
        inner = wider.T @ normal @ wider
        solved = np.linalg.lstsq(inner, wider.T @ right, rcond=1e-9)[0]
        now = float(solved @ wider.T @ right)
        if min(each[n], now - gain) < WORTH:
            break
        basis, gain, rest = wider, now, right - normal @ wider @ solved
    return basis, gain


def coupling_of(classes: PixelClasses, number: int, back: int, step: Place) -> Coupling:
    """What a class gives over a step, or gets back; without its share."""
    (dy, dx), (row, column) = step, divmod(number, classes.columns)
    if back:
        # From the partner, which is of another class.
        row, column, dy, dx = (row + dy) % classes.rows, (column + dx) % classes.columns, -dy, -dx
    return Coupling(dy, dx, 0.0, classes.rows, row, classes.columns, column)
