"""Light of the next or the last frame in the residuals of rows, growing with the row."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.frame_series.row_sums import RowSums
from pixcal.model.arrays import F64

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
    def of(cls, sets: Sequence[RowSums], way: int) -> "RowRamp":
        """From the residuals of some sets."""
        ramp = cls._best([_rows(f, way, np.zeros(len(f.rows))) for f in sets], way)
        for _ in range(_TURNS):
            if ramp.share(sets[0]).max() < _SMALL or ramp.slope < 4 * ramp.error:
                break
            ramp = cls._best([_rows(f, way, ramp.share(f)) for f in sets], way)
        return ramp

    def share(self, sums: RowSums) -> F64:
        """Of each row of a set."""
        share = self.slope * np.maximum(self.way * (sums.rows - self.knee), 0.0)
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
    """Sizes of terms (row, n) of the share and their covariance; its mean goes into the frames."""
    n = terms[0].shape[1]
    normal, right = np.zeros((n, n)), np.zeros(n)
    for (_, own, vector), term in zip(sets, terms, strict=True):
        apart = term - term.mean(axis=0)
        right += apart.T @ vector
        normal += apart.T @ own @ apart
    covariance: F64 = np.linalg.pinv(normal + 1e-30 * np.eye(n), hermitian=True).astype(float)
    return covariance @ right, covariance


def _apart_in_time(g: F64, share: float, way: int) -> F64:
    """Parameters (t, 3) of the frames, of which a share is that of the frame a way further on."""
    found = g.copy()
    order = range(len(g) - 2, -1, -1) if way > 0 else range(1, len(g))
    for t in order:
        found[t] = (g[t] - share * found[t + way]) / (1 - share)
    return found


def _rows(sums: RowSums, way: int, share: F64) -> tuple[F64, F64, F64]:
    """Rows of the window, and normal matrix and right-hand side of a share in each row.

    Of the shares given (row), the frames' parameters hold the mean already, and the fringe's
    amplitude in the maps has lost the rest.
    """
    g = _apart_in_time(sums.found.g, float(share.mean()), way)
    lost = 1 / (1 - (share - share.mean()))
    factors = np.stack([np.ones_like(lost), lost, lost], axis=1)
    return sums.rows, *sums.share(g[sums.inside + way] - g[sums.inside], factors)
