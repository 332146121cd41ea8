"""Parts of shares, shrunk by their errors.

A share is what all classes of pixels have in common both ways, what they have in common there
rather than back, and what is its own; each of these parts is of a size that is learnt from all
couplings of a kind (empirical Bayes, variance components by expectation and maximisation). Parts
that the data do not show are small by that, and their errors are those of what may be there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from pixcal.estimators.crosstalk.links import Place
from pixcal.model.arrays import F64, Indices

TURNS = 60  # of expectation and maximisation
# size of a part of a share, and of a true pattern (px), that one value more is taken to have
USUAL, PATTERN = 4e-4, 1e-4
START = (1e-2, 1e-3)  # sizes of these to start from


@dataclass(frozen=True)
class ShareShrinkage:
    """Parts of shares, and which of them are of one size."""

    basis: F64  # (share, part) shares are this times their parts
    group: Indices  # (part,)
    classes: int

    @classmethod
    def of(cls, steps: Sequence[Place], classes: int) -> "ShareShrinkage":
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

        From least-squares sums (n, n), (n,) of the shares, and those of the shares and a true
        pattern of the offsets, as maps tell.
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
