"""Light that rows of a frame have beside the frame's own, from sums over each row.

In any row such light is a sum of the pixels' maps, so that the products of the residuals with the
maps, and of the maps with each other, hold all that the samples tell of it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pixcal.estimators.diagnosis.evidence import FringeEvidence
from pixcal.estimators.maps.map_fit import centred
from pixcal.kernels.frame_order import with_neighbours
from pixcal.kernels.normal_matrix import inverse_normal, symmetric
from pixcal.model.arrays import F64, Indices

_MIN_FRAMES, _MIN_PIXELS = 12, 80


def enough_frames(found: FringeEvidence) -> bool:
    """Whether a set has the frames and pixels to tell of rows."""
    return bool(np.count_nonzero(found.good) > _MIN_PIXELS and len(found.g) >= _MIN_FRAMES)


@dataclass(frozen=True)
class RowSums:
    """Of the frames of a set that have one before and one after.

    Attributes
    ----------
    found : FringeEvidence
    inside : (t,) int
        Places of the frames in it.
    rows : (y,) float64
        Of the window.
    right : (t, y, 3) float64
        Weighted products of the maps with the residuals.
    normal : (t, y, 3, 3) float64
        Of the maps with each other.
    """

    found: FringeEvidence
    inside: Indices
    rows: F64
    right: F64
    normal: F64

    @classmethod
    def of(cls, found: FringeEvidence) -> "RowSums":
        """Of a fringe set."""
        theta = np.where(found.good, found.theta, 0).astype(np.float32).transpose(1, 2, 0)
        inside = with_neighbours(found.frame)
        rest, variance = found.residual[inside], found.variance[inside]
        used = np.isfinite(rest) & found.good
        weight = np.divide(np.float32(1), variance, out=np.zeros_like(rest), where=used)
        weighted = weight * np.where(used, rest, np.float32(0))
        upper = np.triu_indices(3)
        by_row = weight.transpose(1, 0, 2) @ (theta[..., upper[0]] * theta[..., upper[1]])
        return cls(
            found,
            inside,
            found.origin[0] + np.arange(len(theta), dtype=float),
            (weighted.transpose(1, 0, 2) @ theta).transpose(1, 0, 2).astype(float),
            symmetric(by_row.transpose(1, 0, 2)),
        )

    @cached_property
    def _modes(self) -> F64:
        """Light (t, y, m, 3) that each frame is free to have: the maps, and turns along y."""
        t, y = self.right.shape[:2]
        modes = np.broadcast_to(np.eye(3), (t, y, 3, 3))
        if not np.any(self.found.dk):
            return modes
        _, c, s = self.found.g[self.inside].T
        turned = np.stack([np.zeros(t), -s, c], axis=1)
        turns = centred(self.found.good.shape)[0][None] * turned[:, None]
        return np.concatenate([modes, turns[:, :, None]], axis=2)

    @cached_property
    def _covariance(self) -> F64:
        """Of the frames' modes (t, m, m)."""
        inner = np.einsum("tymi,tyij,tynj->tmn", self._modes, self.normal, self._modes)
        return inverse_normal(inner, 1e-10)

    def share(self, other: F64, factors: F64 | None = None) -> tuple[F64, F64]:
        """Normal matrix (y, y) and right-hand side (y,) of the share of a light in each row.

        What the pixels take up of it, which is linear in the frames' own light, and what the
        frames' own parameters do, is taken off. ``other``: (t, 3) float64 parameters of the light
        in the frames inside, as in `FringeEvidence.g`. ``factors``: (y, 3) float64 of these
        parameters in each row.
        """
        g = self.found.g[self.inside]
        own = (other - g @ (np.linalg.pinv(g) @ other))[:, None]
        # Pixels take up what is best for their own weights: more of chance, by their freedom.
        left = 1 - g.shape[1] / len(g)
        if factors is not None:
            own = own * factors
        beside = np.einsum("tyij,tyj->tyi", self.normal, np.broadcast_to(own, self.right.shape))
        across = np.einsum("tymi,tyi->tym", self._modes, beside)
        of_rest = np.einsum("tymi,tyi->tm", self._modes, self.right)
        taken = across @ self._covariance
        flat, taken_flat = (a.swapaxes(0, 1).reshape(len(self.rows), -1) for a in (across, taken))
        normal = np.diag(np.sum(own * beside, axis=(0, 2))) - taken_flat @ flat.T
        return left * normal, np.sum(own * self.right, axis=(0, 2)) - taken_flat @ of_rest.ravel()
