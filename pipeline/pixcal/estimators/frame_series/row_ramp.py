"""Light of the next or the last frame in the residuals of rows, growing with the row."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.diagnosis.evidence import FringeEvidence
from pixcal.estimators.maps.map_fit import centred
from pixcal.kernels.normal_matrix import inverse_normal, symmetric
from pixcal.kernels.sample_sums import MODES, row_sums
from pixcal.model.arrays import F32, F64

_MIN_FRAMES = 12
_MIN_PIXELS = 80
_KNEES = 24  # places of the row from which the next step is seen that are tried
_TURNS = 3
_SMALL = 1e-3
_BENT = 16.0  # chi-square that a knee inside the window must gain


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
    return enough_frames(found) and bool(found.exptime_s > 0)  # not so where unknown (nan)


def enough_frames(found: FringeEvidence) -> bool:
    """Whether a set has the frames and pixels."""
    return bool(np.count_nonzero(found.good) > _MIN_PIXELS and len(found.g) >= _MIN_FRAMES)


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
    own, mean = _apart_in_time(found.g, float(share.mean()), way), _maps(found)
    mean[1:] /= 1 - (share - share.mean())[:, None]
    other = own[1 + way : len(own) - 1 + way] - own[INSIDE]
    return rows_of(found, other, mean)


INSIDE = slice(1, -1)  # frames that have one before and one after


def _maps(found: FringeEvidence) -> F64:
    return np.asarray(np.where(found.good, found.theta, 0))


def rows_of(
    found: FringeEvidence, other: F64, mean: F64 | None = None, every: int = 1
) -> tuple[F64, F64, F64]:
    """Rows of the window, and normal matrix and right-hand side of a light's share in each row.

    Parameters
    ----------
    other : (t - 2, 3) float64
        Parameters of the light in every frame but the first and the last, as in `FringeEvidence.g`.
    mean : (3, y, x) float64, optional
        Maps of the light; default: those of the fit.
    every : int
        One column of so many is looked at.
    """
    inside, columns = INSIDE, (..., slice(None, None, every))
    theta = np.ascontiguousarray(_maps(found)[columns])
    mean = theta if mean is None else mean[columns]
    rest, variance = found.residual[inside][columns], found.variance[inside][columns]
    used = np.isfinite(rest) & found.good[columns]
    weight = np.divide(np.float32(1), variance, out=np.zeros_like(rest), where=used)
    light = _apart(other, mean, found.g[inside], weight)
    y, x = (place.ravel().astype(np.float32) for place in centred(found.good.shape))
    x = np.ascontiguousarray(x[::every])
    inner, of_rest, across, sums = row_sums(
        np.where(used, rest, np.float32(0)), weight, light,
        found.g[inside].astype(np.float32), theta.astype(np.float32), y, x,
    )  # fmt: skip
    free = MODES if np.any(found.dk) else 3
    covariance = inverse_normal(symmetric(inner)[:, :free, :free], 1e-10)
    # What the modes of each frame absorb, (y, t modes).
    across = across[:, :, :free]
    taken = across @ covariance
    beside, taken = (a.swapaxes(0, 1).reshape(len(y), -1) for a in (across, taken))
    normal = np.diag(sums[:, 0]) - taken @ beside.T
    vector = sums[:, 1] - taken @ of_rest[:, :free].ravel()
    return found.origin[0] + np.arange(len(y), dtype=float), normal, vector


def _apart(other: F64, maps: F64, g: F64, weight: F32) -> F32:
    """Light of other frames' parameters (t, 3) and maps (3, y, x) less what those of g absorb.

    In each pixel alike light of all frames, linear in the frames' g (t, 3), goes into the maps.
    """
    products = np.column_stack([_products(g, g), _products(g, other)]).astype(np.float32)
    sums = (weight.reshape(len(g), -1).T @ products).astype(float).reshape(-1, 2, 3, 3)
    flat = maps.reshape(3, -1)
    right = np.einsum("pij,jp->pi", sums[:, 1], flat)
    # Pixels without samples have no light to look for.
    inner = sums[:, 0] + np.where(sums[:, 0].any(axis=(1, 2)), 0.0, 1.0)[:, None, None] * np.eye(3)
    absorbed = np.linalg.solve(inner, right[:, :, None])[:, :, 0]
    frames = np.column_stack([other, -g]).astype(np.float32)
    light = frames @ np.concatenate([flat, absorbed.T]).astype(np.float32)
    return np.asarray(light.reshape(weight.shape))


def _products(one: F64, other: F64) -> F64:
    """Products (t, 9) of each pair of parameters."""
    return (one[:, :, None] * other[:, None, :]).reshape(len(one), -1)
