"""Which couplings there are: links, periods and classes of pixels that stand out of the noise.

Every pair of pixels a step apart, and every period of rows and columns, is tried. For a link to be
taken it must stand out by so much that, with all that was tried, chance takes anything at all in
one acquisition of a hundred. A capacitance couples both ways alike, and a kernel repeats; so shares
there and back, and of many classes, are one number until the data tell them apart.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri_exp
from scipy.stats import norm

from pixcal.estimators.crosstalk.information import Information, Measured
from pixcal.estimators.crosstalk.links import Classes, Place, periods
from pixcal.kernels.crosstalk import Coupling

F64 = NDArray[np.float64]

FALSE_ALARM = 0.01
"""Chance that noise alone gives any coupling."""
INDEPENDENT = 0.35
"""Share of the looks that are as good as independent: periods have pixels in common. Measured: it
makes the median significance of acquisitions without couplings about zero."""
WORTH = 16.0
"""Fall in chi-square for which another share is taken, once a link is known to couple."""
APART = 5.0
"""Fall in chi-square for which shares are told apart, once the period is known."""
ZERO = 2.0
"""Sigmas below which a share is none."""
TOLD = 6.0
"""Errors of a share in the largest of its link, from which on it may be none."""
NOTHING = 1e-6
"""Weight of a share below which it is not measured at all."""


@dataclass(frozen=True)
class Pick:
    """Couplings of a link that are taken, and what is known of their shares.

    Attributes
    ----------
    couplings : tuple of Coupling
        Without shares.
    basis : (coupling, number) float64
        Shares are about this times numbers that are free: some are alike.
    information : Information
        Of these couplings only.
    """

    couplings: tuple[Coupling, ...]
    basis: F64
    information: Information


@dataclass(frozen=True)
class Choice:
    """All that is taken, and how far the best of it is from chance.

    Attributes
    ----------
    picks : tuple of Pick
    links : tuple of int
        That stand out.
    classes : Classes
        Of the period.
    best : float
        Largest chi-square of one number.
    looks : int
        Numbers that were tried.
    """

    picks: tuple[Pick, ...]
    links: tuple[int, ...]
    classes: Classes
    best: float
    looks: int

    @property
    def critical(self) -> float:
        """Chi-square that chance passes in `FALSE_ALARM` of the cases."""
        return _critical(self.looks)

    @property
    def significance(self) -> float:
        """Sigmas of a normal variate as rare as the best of so many looks."""
        looks = INDEPENDENT * self.looks
        one = np.log(2) + norm.logsf(np.sqrt(self.best))
        none = looks * np.log1p(-np.exp(one))
        if none < -0.5:
            return float(ndtri_exp(none))
        # A small chance, which looks multiply.
        return float(-ndtri_exp(np.log(-np.expm1(none)) if none < -1e-9 else one + np.log(looks)))


def choose(measured: Measured) -> Choice:
    """Take what stands out.

    First the links that do, at any period; then the one period that serves all of them best, the
    shortest that is good enough; then, for that period, which classes differ.
    """
    looks = len(measured.links) * sum(3 * n * m for n, m in periods(measured.shape))
    critical = _critical(looks)
    gains = np.stack([_best_gains(*i.total) for _, i in measured.every_period()])
    there = tuple(int(n) for n in np.nonzero(gains.max(axis=0) > critical)[0])
    none = Classes(1, 1, measured.first)
    classes = _period(measured.of(there), critical) if there else none
    return again(Choice((), there, classes, max(float(gains.max()), 1e-9), looks), measured)


def again(choice: Choice, measured: Measured) -> Choice:
    """The same links and period, with shares of what is measured now."""
    if not choice.links:
        return choice
    present = measured.of(choice.links)
    information, directions = present.of_period(choice.classes), _directions(choice.classes)
    picks = []
    for n, step in enumerate(present.links):
        own = information.of(n)
        basis, gain = _greedy(*own.total, directions, APART)
        if gain > choice.critical:
            basis = _without_zeros(*own.total, basis, gain)
            picks.append(_pick(own, choice.classes, step, basis))
    return replace(choice, picks=tuple(picks))


def _critical(looks: int) -> float:
    return float(norm.isf(FALSE_ALARM / looks / 2) ** 2)


def _period(present: Measured, critical: float) -> Classes:
    """The shortest period that is good enough for all links together."""
    scores = []
    for classes, information in present.every_period():
        directions = _directions(classes)
        score = 0.0
        for n in range(len(present.links)):
            basis, gain = _greedy(*information.of(n).total, directions, WORTH)
            score += gain - WORTH * basis.shape[1]
        scores.append((score, classes))
    enough = max(score for score, _ in scores) - critical
    return next(classes for score, classes in scores if score >= enough)


def _directions(classes: Classes) -> F64:
    """Numbers that shares may be made of, (u, direction): each has some shares alike.

    There, back and both, of each class of every period that divides the one at hand.
    """
    every = []
    for coarse in classes.divisors():
        groups = (coarse.groups_of(classes) == np.arange(coarse.count)[:, None]).astype(float)
        there, back = np.zeros((2, coarse.count, 2 * classes.count))
        there[:, ::2] = back[:, 1::2] = groups
        every += [there + back, there, back]
    return np.concatenate(every).T


def _best_gains(normal: F64, right: F64) -> F64:
    """Largest fall in chi-square (link,) that one class gives: there, back or both."""
    own = np.diagonal(normal, axis1=-2, axis2=-1)
    mixed = np.diagonal(normal, 1, axis1=-2, axis2=-1)[..., ::2]
    weight = np.concatenate([own[..., ::2] + own[..., 1::2] + 2 * mixed, own], axis=-1)
    value = np.concatenate([right[..., ::2] + right[..., 1::2], right], axis=-1)
    return np.asarray(_fall(value, weight).max(axis=-1))


def _fall(value: F64, weight: F64) -> F64:
    return np.where(weight > NOTHING, value**2 / np.maximum(weight, NOTHING), 0.0)


def _greedy(normal: F64, right: F64, directions: F64, apart: float) -> tuple[F64, float]:
    """Directions that are worth it (u, number), the strongest first, and the fall in chi-square.

    Parameters
    ----------
    normal, right : (u, u), (u,) float64
    directions : (u, direction) float64
    apart : float
        Least fall for telling shares apart that are there; one that is not yet needs `WORTH`.
    """
    weight = np.einsum("ud,ud->d", directions, normal @ directions)
    # Of equals the plainest: many shares alike, both ways.
    plain = np.count_nonzero(directions, axis=0) / len(directions)
    basis = np.zeros((len(right), 0))
    gain, rest = 0.0, right
    while basis.shape[1] < len(right):
        absent = ~np.any(basis, axis=1)
        least = np.where(np.any(directions[absent], axis=0), WORTH, apart)
        each = _fall(rest @ directions, weight) - least
        n = int(np.argmax(each + plain))
        wider = np.column_stack([basis, directions[:, n]])
        inner = wider.T @ normal @ wider
        solved = np.linalg.lstsq(inner, wider.T @ right, rcond=1e-9)[0]
        now = float(solved @ wider.T @ right)
        if each[n] < 0 or now - gain < least[n]:
            break
        basis, gain, rest = wider, now, right - normal @ wider @ solved
    return basis, gain


def _without_zeros(normal: F64, right: F64, basis: F64, gain: float) -> F64:
    """A basis without the shares that are none, as far as the data can tell them from others.

    Those have a number of their own that is small beside its error, and the error is small beside
    the largest share.
    """
    solved = np.linalg.lstsq(basis.T @ normal @ basis, basis.T @ right, rcond=1e-9)[0]
    largest = float(np.max(np.abs(basis @ solved)))
    told = np.diag(normal) > (TOLD / largest) ** 2
    for u in np.nonzero(np.any(basis, axis=1) & told)[0]:
        fewer = basis.copy()
        fewer[u] = 0.0
        numbers = np.linalg.matrix_rank(basis) - np.linalg.matrix_rank(fewer)
        if not numbers:
            continue
        fewer = fewer[:, np.any(fewer, axis=0)]
        solved = np.linalg.lstsq(fewer.T @ normal @ fewer, fewer.T @ right, rcond=1e-9)[0]
        now = float(solved @ fewer.T @ right)
        if now > gain - numbers * ZERO**2:
            basis, gain = fewer, now
    return basis


def _pick(information: Information, classes: Classes, step: Place, basis: F64) -> Pick:
    used = np.nonzero(np.any(basis, axis=1))[0]
    couplings = (coupling_of(classes, *divmod(int(u), 2), step) for u in used)
    return Pick(tuple(couplings), basis[used], information.only(used))


def coupling_of(classes: Classes, number: int, back: int, step: Place) -> Coupling:
    if not back:
        return classes.coupling(number, step, 0.0)
    return classes.coupling(classes.shifted(number, step), (-step[0], -step[1]), 0.0)
