"""A whole kernel: every coupling within two pixels, shrunk by its error instead of dropped.

A share is what all classes of pixels have in common both ways, what they have in common there
rather than back, and what is its own; each of these parts is of a size that is learnt from all
couplings of a kind (empirical Bayes, variance components by expectation and maximisation). Parts
that the data do not show are small by that, and their errors are those of what may be there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import lcm

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from pixcal.estimators.crosstalk.covariance import Products, products
from pixcal.estimators.crosstalk.hot_pixels import hot_pixels
from pixcal.estimators.crosstalk.information import Measured
from pixcal.estimators.crosstalk.joined import any_gain
from pixcal.estimators.crosstalk.links import Classes, Place, links
from pixcal.estimators.crosstalk.pattern import pattern_information
from pixcal.estimators.crosstalk.second_order import to_first_order
from pixcal.estimators.crosstalk.support import coupling_of
from pixcal.estimators.evidence import Evidence
from pixcal.kernels.crosstalk import Coupling, outflow

F64 = NDArray[np.float64]

WITHIN = 2
"""Rows and columns of the kernel about its middle."""
ROUNDS = 3
"""Of the shares, each with the second order of those before."""
TURNS = 60
"""Of expectation and maximisation."""
USUAL, PATTERN = 1e-3, 1e-4
"""Size of a part of a share, and of a true pattern (px), that one value more is taken to have."""
START = (1e-2, 1e-3)
"""Sizes of these to start from."""
NEGLIGIBLE = 1e-4
"""Share whose products with others do not count."""


@dataclass(frozen=True)
class Dense:
    """A kernel with all its couplings.

    Attributes
    ----------
    couplings : tuple of Coupling
    covariance : (n, n) float64
        Of their shares.
    pattern_px : float
        Rms of the true pattern of offsets that the data ask for beside the couplings.
    """

    couplings: tuple[Coupling, ...]
    covariance: F64
    pattern_px: float


def dense_kernel(parts: Sequence[Evidence], start: Sequence[Coupling]) -> Dense | None:
    """Measure all couplings of the period of a kernel that was found.

    Parameters
    ----------
    parts : sequence of Evidence
        Of the same pixels, with different frames.
    start : sequence of Coupling
        As found: they give the period and any coupling beyond `WITHIN`.
    """
    one = parts[0]
    shape = (one.good.shape[0], one.good.shape[1])
    known = tuple(start)
    steps = _steps(shape, known)
    classes = Classes(
        lcm(*(c.every_rows for c in known)), lcm(*(c.every_columns for c in known)), one.origin
    )
    noise = _sum([products(part, steps, known) for part in parts])
    hot = hot_pixels(one, steps, known)
    every = tuple(
        coupling_of(classes, *divmod(u, 2), step)
        for step in steps for u in range(2 * classes.count)
    )  # fmt: skip
    shrinkage = _Shrinkage.of(steps, classes.count)
    shares = _shares_of(every, known, classes)
    found = None
    for _ in range(ROUNDS):
        now = [replace(c, share=float(k)) for c, k in zip(every, shares, strict=True)]
        large = [c for c in now if abs(c.share) > NEGLIGIBLE]
        first = None if noise is None else to_first_order(noise, large, steps, one.origin)
        less = None if hot is None else hot.corrected(outflow(large, shape, one.origin), 0.0)
        measured = Measured(first, less, steps, shape, one.origin).of_period(classes)
        ways = {
            way: (block_diag(*normal), measured.right[way].ravel())
            for way, normal in measured.normal.items()
        }
        if first is not None:
            ways["covariance"] = any_gain(ways["covariance"], first, shares)
        normal, right = (np.sum(part, axis=0) for part in zip(*ways.values(), strict=True))
        found = shrinkage.solve(normal, right, pattern_information(one, now, classes))
        shares = found[0]
    assert found is not None
    couplings = tuple(replace(c, share=float(k)) for c, k in zip(every, found[0], strict=True))
    return Dense(couplings, found[1], found[2])


def _steps(shape: Place, known: Sequence[Coupling]) -> tuple[Place, ...]:
    every = links(shape)
    far = {(c.dy, c.dx) for c in known} | {(-c.dy, -c.dx) for c in known}
    return tuple(s for s in every if max(map(abs, s)) <= WITHIN or s in far)


def _sum(found: Sequence[Products | None]) -> Products | None:
    """Of several parts of the frames."""
    some = [one for one in found if one is not None]
    if not some:
        return None
    weight = np.array([one.shot_error**-2 for one in some])
    return replace(
        some[0],
        right=np.sum([one.right for one in some], axis=0),
        normal=np.sum([one.normal for one in some], axis=0),
        shot=float(weight @ [one.shot for one in some] / weight.sum()),
        shot_error=float(weight.sum() ** -0.5),
    )


def _shares_of(every: Sequence[Coupling], known: Sequence[Coupling], classes: Classes) -> F64:
    """Shares of all couplings where some, of shorter periods too, are known."""
    shares = np.zeros(len(every))
    for n, c in enumerate(every):
        for k in known:
            same = (k.dy, k.dx) == (c.dy, c.dx)
            rows = c.row % k.every_rows == k.row
            if same and rows and c.column % k.every_columns == k.column:
                shares[n] += k.share
    return shares


@dataclass(frozen=True)
class _Shrinkage:
    """Parts of shares, and which of them are of one size.

    Attributes
    ----------
    basis : (share, part) float64
        Shares are this times their parts.
    group : (part,) int
    classes : int
    """

    basis: F64
    group: NDArray[np.intp]
    classes: int

    @classmethod
    def of(cls, steps: Sequence[Place], classes: int) -> "_Shrinkage":
        """Parts of the couplings of each step: there and back of every class."""
        size = 2 * classes
        common = np.kron(np.eye(len(steps)), np.ones((size, 1)))
        one_way = common * np.tile([1.0, -1.0], len(steps) * classes)[:, None]
        kinds = [_kind(step) for step in steps]
        names = sorted(set(kinds))
        number = np.array([names.index(kind) for kind in kinds])
        columns, groups = [common, one_way], [number, len(names) + number]
        if classes > 1:
            columns.append(np.eye(size * len(steps)))
            groups.append(2 * len(names) + np.repeat(number, size))
        return cls(np.hstack(columns), np.concatenate(groups), classes)

    def solve(
        self, normal: F64, right: F64, maps: tuple[F64, F64] | None
    ) -> tuple[F64, F64, float]:
        """Shares, their covariance, and the rms of a true pattern.

        Parameters
        ----------
        normal, right : (n, n), (n,) float64
            Least-squares sums of the shares.
        maps : ((m, m), (m,) float64), optional
            The same of the shares and a true pattern of the offsets, as maps tell.
        """
        n, parts = self.basis.shape
        free = 0 if maps is None else 2 * self.classes
        basis = block_diag(self.basis, np.eye(free))
        group = np.concatenate([self.group, np.full(free, self.group.max() + 1)])
        whole, whole_right = block_diag(normal, np.zeros((free, free))), np.zeros(n + free)
        whole_right[:n] = right
        if maps is not None:
            whole, whole_right = whole + maps[0], whole_right + maps[1]
        inner, inner_right = basis.T @ whole @ basis, basis.T @ whole_right
        usual = np.full(group.max() + 1, USUAL)
        size = np.full(len(usual), START[0])
        if free:
            usual[-1], size[-1] = PATTERN, START[1]
        count = np.bincount(group)
        for _ in range(TURNS):
            covariance = np.linalg.inv(inner + np.diag(size[group] ** -2.0))
            value = covariance @ inner_right
            square = np.bincount(group, value**2 + np.diag(covariance))
            size = np.sqrt((square + usual**2) / (count + 1))
        shares = self.basis @ value[:parts]
        own = self.basis @ covariance[:parts, :parts] @ self.basis.T
        return shares, own, float(size[-1]) if free else 0.0


def _kind(step: Place) -> tuple[int, int]:
    """Couplings that may well be of one size: along rows, along columns, or aslant, by distance."""
    dy, dx = abs(step[0]), abs(step[1])
    if dy and dx:
        return (1, 1) if dy == dx == 1 else (2, 2)
    return (dy, dx) if max(dy, dx) == 1 else (2 * (dy > 0), 2 * (dx > 0) + 3)
