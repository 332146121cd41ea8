"""Light of the next or the last frame in the residuals of rows, growing with the row."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.evidence import FringeEvidence
from pixcal.estimators.map_fit import centred

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_MIN_FRAMES = 12
_MIN_PIXELS = 80
_KNEES = 24
"""Places of the row from which the next step is seen that are tried."""
_TURNS = 3
_SMALL = 1e-3
_BENT = 16.0
"""Chi-square that a knee inside the window must gain."""


@dataclass(frozen=True)
class RowRamp:
    """A share of another frame that grows with the row from a knee on (before it, of the last)."""

    way: int
    slope: float
    error: float
    knee: float
    knee_error: float

    @classmethod
    def of(cls, sets: Sequence[FringeEvidence], way: int) -> "RowRamp":
        """From the residuals of some sets."""
        ramp = cls._best([_rows(f, way, np.zeros(f.good.shape[0])) for f in sets], way)
        for _ in range(_TURNS):
            if ramp.share(sets[0]).max() < _SMALL or ramp.slope < 4 * ramp.error:
                break
            ramp = cls._best([_rows(f, way, ramp.share(f)) for f in sets], way)
        return ramp

    def share(self, found: FringeEvidence) -> F64:
        """Of each row of a set."""
        rows = found.origin[0] + np.arange(found.good.shape[0])
        share = self.slope * np.maximum(self.way * (rows - self.knee), 0.0)
        return np.asarray(np.clip(share, 0.0, 0.45))

    @classmethod
    def _best(cls, sets: Sequence[tuple[F64, F64, F64]], way: int) -> "RowRamp":
        """Of the normal sums by row; a knee inside the window only where it is really better."""
        rows = np.unique(np.concatenate([s[0] for s in sets]))
        first, last = rows[0], rows[-1]
        edge = 0.0 if way > 0 else last
        inside = np.linspace(first, last, _KNEES + 2)[1:-1]
        plain = _slope(sets, [np.maximum(way * (s[0] - edge), 0.0)[:, None] for s in sets])
        value, error = float(plain[0][0]), float(np.sqrt(plain[1][0, 0]))
        bent = [
            _slope(sets, [np.maximum(way * (s[0] - k), 0)[:, None] for s in sets]) for k in inside
        ]
        gains = [v[0] ** 2 / c[0, 0] if v[0] > 0 else 0.0 for v, c in bent]
        step = (last - first) / (_KNEES + 1)
        if max(gains) < max(value, 0) ** 2 / error**2 + _BENT:
            return cls(way, value, error, float(edge), float(step))
        knee, slope = float(inside[np.argmax(gains)]), float(bent[int(np.argmax(gains))][0][0])
        for _ in range(2 * _TURNS):
            terms = []
            for rows_of, _, _ in sets:
                ramp = np.maximum(way * (rows_of - knee), 0.0)
                terms.append(np.stack([ramp, -way * slope * (ramp > 0)], axis=1))
            values, covariance = _slope(sets, terms)
            # The ramp itself is refitted; the second term moves its foot.
            knee = float(np.clip(knee + np.clip(values[1], -step, step), first, last))
            slope = float(values[0])
        errors = np.sqrt(np.diag(covariance))
        return cls(way, slope, float(errors[0]), knee, float(errors[1]))


def _slope(sets: Sequence[tuple[F64, F64, F64]], terms: Sequence[F64]) -> tuple[F64, F64]:
    """Sizes of terms (row, n) of the share and their covariance; its mean is free in each set."""
    n = terms[0].shape[1]
    normal, right = np.zeros((n, n)), np.zeros(n)
    for (_, own, vector), term in zip(sets, terms, strict=True):
        weight = own.sum(axis=1)
        apart = term - (weight @ term) / max(weight.sum(), 1e-30)
        right += apart.T @ vector
        normal += apart.T @ own @ apart
    covariance: F64 = np.linalg.pinv(normal + 1e-30 * np.eye(n), hermitian=True).astype(float)
    return covariance @ right, covariance


def enough_for_rows(found: FringeEvidence) -> bool:
    """Whether a set has the frames and pixels, and the times, to tell of rows."""
    timed = found.exptime_s > 0  # not so where it is unknown (nan)
    many = np.count_nonzero(found.good) > _MIN_PIXELS
    return bool(timed and many and len(found.g) >= _MIN_FRAMES)


def _apart_in_time(g: F64, share: float, way: int) -> F64:
    """Parameters (t, 3) of the frames, of which a share is that of the frame a way further on."""
    found = g.copy()
    order = range(len(g) - 2, -1, -1) if way > 0 else range(1, len(g))
    for t in order:
        found[t] = (g[t] - share * found[t + way]) / (1 - share)
    return found


def _rows(found: FringeEvidence, way: int, share: F64) -> tuple[F64, F64, F64]:
    """Rows of the window, and normal matrix and right-hand side of a share in each row.

    The other frame's light is taken without what the fit of pixels and frames absorbs of it. Of the
    shares given (row), the frames' parameters hold the mean already, and the fringe's amplitude in
    the maps has lost the rest.
    """
    good, ny = found.good, found.good.shape[0]
    frames = np.arange(1, len(found.g) - 1)
    theta, g = found.theta[:, good], found.g[frames]
    rest = found.residual[frames][:, good]
    weight = np.where(np.isfinite(rest), 1 / found.variance[frames][:, good], 0).astype(np.float32)
    rest = np.nan_to_num(rest)
    own, mean = _apart_in_time(found.g, float(share.mean()), way), theta.copy()
    mean[1:] /= 1 - (share - share.mean())[np.nonzero(good)[0]]
    light = _apart((own[frames + way] - own[frames]) @ mean, g, weight)
    moving = bool(np.any(found.dk))
    row = np.nonzero(good)[0]
    y, x = (np.broadcast_to(c, good.shape)[good] for c in centred(good.shape))
    normal, vector = np.zeros((ny, ny)), np.zeros(ny)
    for t in range(len(frames)):
        modes = theta
        if moving:
            slope = g[t, 1] * theta[2] - g[t, 2] * theta[1]
            modes = np.concatenate([theta, [slope * x, slope * y]])
        weighted = modes * weight[t]
        across = np.stack([np.bincount(row, m * light[t], minlength=ny) for m in weighted], axis=1)
        inner = weighted @ modes.T
        size = np.sqrt(np.maximum(np.diag(inner), 1e-300))
        unit = inner / np.outer(size, size)
        inverse = np.linalg.pinv(unit, rcond=1e-10, hermitian=True) / np.outer(size, size)
        pull = weight[t] * light[t]
        normal += np.diag(np.bincount(row, pull * light[t], minlength=ny))
        normal -= across @ inverse @ across.T
        vector += np.bincount(row, pull * rest[t], minlength=ny)
        vector -= across @ (inverse @ (weighted @ rest[t]))
    return found.origin[0] + np.arange(ny, dtype=float), normal, vector


def _apart(light: F64, g: F64, weight: F32) -> F64:
    """Light (t, pixel) less what the maps of each pixel absorb: it is linear in the frames' g."""
    inner = np.einsum("ti,tj,tp->pij", g, g, weight, optimize=True)
    right = (weight * light).T @ g
    absorbed = np.linalg.solve(inner, right[:, :, None])[:, :, 0]
    return np.asarray(light - g @ absorbed.T)
