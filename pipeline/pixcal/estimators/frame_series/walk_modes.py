"""Orthonormal modes of a series of frames, in which white noise and a random walk are independent.

They are the eigenvectors of a random walk's covariance at the times of the frames, without the
mean. At equal steps that is the cosine transform (DCT-II); a pause between frames only changes the
modes. Mode k changes its sign k times, so modes are in order of frequency.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import eigh_tridiagonal

from pixcal.model.arrays import F64

SHORTEST = 0.1  # step in time, of the median one, that shorter ones count as


@dataclass(frozen=True, eq=False)
class WalkModes:
    """Modes of series of t frames."""

    vectors: F64  # (t - 1, t) orthonormal, slowest first
    walk: F64  # (t - 1,) variance, s, of the modes of a random walk of unit variance a second

    def of(self, series: F64) -> F64:
        """Modes (t - 1, ...) of series (t, ...)."""
        return np.asarray(np.tensordot(self.vectors, series, 1))

    def series(self, modes: F64) -> F64:
        """Series (t, ...), without mean, of some modes (t - 1, ...)."""
        return np.asarray(np.tensordot(self.vectors.T, modes, 1))


def walk_modes(time_s: F64) -> WalkModes:
    """Modes of series at some times (t,), ascending, s."""
    return _modes(np.ascontiguousarray(time_s, float).tobytes())


@lru_cache(maxsize=16)
def _modes(times: bytes) -> WalkModes:
    steps = np.diff(np.frombuffer(times))
    usual = float(np.median(steps)) if len(steps) else 1.0
    # The inverse of a walk's covariance without the mean: differences of neighbours, weighted.
    weight = 1 / np.maximum(steps, SHORTEST * usual if usual > 0 else 1.0)
    diagonal = np.append(weight, 0.0) + np.append(0.0, weight)
    values, vectors = eigh_tridiagonal(diagonal, -weight)
    return WalkModes(np.ascontiguousarray(vectors.T[1:]), 1 / values[1:])
