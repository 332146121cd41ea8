"""Least-squares equations of the shares of links, the same for noise and for hot pixels."""

from dataclasses import dataclass, replace

import numpy as np

from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F64

ESTIMABLE = 1e-6  # relative accuracy to which an unknown is recognised as determined


@dataclass(frozen=True)
class Equations:
    """Sums for each link and class of pixels: shares there and back, and two more unknowns."""

    normal: F64  # (link, 4, 4, class)
    right: F64  # (link, 4, class)
    of_rise: F64  # (2, 2) the two others for rises (1/ke-) of the shares there and back
    # (n, 2), (n,): what the two others may be otherwise, in all classes alike; prior 1-sigma
    nuisance: F64
    prior: F64
    slope: float = 0.0  # relative rise with the signal (1/ke-) that is not that of the shares

    def risen(self, rise: F64) -> "Equations":
        """The same if the shares (link, class, 2) rose by more, 1/ke-."""
        more = np.einsum("ltuc,ud,lcd->ltc", self.normal[:, :, 2:], self.of_rise, rise)
        return replace(self, right=self.right + more)

    def shares(self, per_ke: float) -> tuple[F64, F64]:
        """Sums (link, u, u), (link, u) of the shares alone, the other unknowns being free.

        With a relative rise of the shares (``per_ke``, 1/ke-), that is no longer free. Unknown ``2
        c`` is the share that pixels of class c give over the link, ``2 c + 1`` the share that
        their partners give back.
        """
        free = np.full(len(self.prior), per_ke <= 0) | ~(self.nuisance @ self.of_rise).any(axis=1)
        basis = np.zeros((2 + np.count_nonzero(free), 4))
        basis[:2] = np.hstack([np.eye(2), max(per_ke, 0.0) * self.of_rise.T])
        basis[2:, 2:] = self.nuisance[free]
        every = np.einsum("it,ltuc,ju->lijc", basis, self.normal, basis, optimize=True)
        right = basis @ self.right
        links, _, _, count = every.shape
        matrix: F64 = np.zeros((links, count, 2, count, 2))
        at = np.arange(count)
        matrix[:, at, :, at] = np.moveaxis(every[:, :2, :2], -1, 0)
        cross = np.moveaxis(every[:, :2, 2:], -1, 1).reshape(links, 2 * count, -1)
        others = every[:, 2:, 2:].sum(-1) + np.diag(self.prior[free] ** -2.0)
        taken = cross @ np.linalg.inv(others)
        rest = right[:, :2].swapaxes(1, 2).reshape(links, -1)
        rest = rest - np.einsum("lun,ln->lu", taken, right[:, 2:].sum(-1))
        return matrix.reshape(links, 2 * count, -1) - taken @ cross.swapaxes(1, 2), rest

    def rises(self, known: F64, rising: F64) -> tuple[F64, F64, F64]:
        """Shares (link, 2) at small signals, their rises with the signal, covariance of the two.

        Where only a sum of shares rises, the first is that sum. The covariance (link, 2, 2, 2) is
        infinite where no rise can be measured. ``known``, ``rising``: shares (link, 2) that the
        data were corrected for, and their rises, 1/ke-.
        """
        normal = self.normal.sum(-1)
        inverse = inverse_normal(normal)
        solution = np.einsum("ltu,lu->lt", inverse, self.right.sum(-1))
        solution += np.hstack([known, rising @ self.of_rise.T])
        rows = np.zeros((2, 2, 4))
        rows[:, 0, :2], rows[:, 1, 2:] = self.of_rise, np.eye(2)
        share, rise = np.einsum("set,lt->els", rows, solution)
        covariance = np.einsum("set,ltu,sfu->lsef", rows, inverse, rows)
        unknown = np.abs(rows[:, 1] @ (inverse @ normal) - rows[:, 1]).max(axis=-1) > ESTIMABLE
        covariance[unknown | ~self.of_rise.any(axis=1), 1, 1] = np.inf
        return share, rise - self.slope * share, covariance
