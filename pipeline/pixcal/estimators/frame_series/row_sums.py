"""Light of other frames in the rows of a frame, from sums over each row.

In any row such light is a sum of the pixels' maps, so the products of the residuals with the maps,
and of the maps with each other, are sufficient statistics. Light of the next or of the previous
frame grows with the row.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.optimize import minimize_scalar

from pixcal.estimators.diagnosis.evidence import FringeEvidence
from pixcal.estimators.fringe_fit.fringes import grid
from pixcal.kernels.frame_order import with_neighbours
from pixcal.kernels.normal_matrix import inverse_normal, symmetric
from pixcal.kernels.significance import sigmas_of_chi2
from pixcal.model.arrays import F64, Indices

_MIN_FRAMES, _MIN_PIXELS = 12, 80
_KNEES = 24  # places tried for the first row that contains the next step
_TURNS = 3
_SMALL = 1e-3
_BENT = 16.0  # chi-square that a knee inside the window must gain
KNOTS = 13  # rows at equal distances at which the profile is given
ORIGINS = 8  # phases tried as the one where the modulator's range begins
# significance from which that phase is refined, and its final precision, rad
CLEAR, FINEST = 4.0, 0.01
OWN_ORDERS = 4  # harmonics of a frame's own phase that are removed from steps


def enough_frames(fringes: FringeEvidence) -> bool:
    """Whether a set has enough frames and pixels for rows."""
    return bool(np.count_nonzero(fringes.good) > _MIN_PIXELS and len(fringes.g) >= _MIN_FRAMES)


@dataclass(frozen=True)
class RowSums:
    """Sums for the frames of a set that have both neighbours."""

    fringes: FringeEvidence
    inside: Indices  # (t,) places of these frames in it
    rows: F64  # (y,) of the window
    right: F64  # (t, y, 3) weighted products of the maps with the residuals
    normal: F64  # (t, y, 3, 3) of the maps with each other

    @classmethod
    def of(cls, fringes: FringeEvidence) -> "RowSums":
        """Of a fringe set."""
        theta = np.where(fringes.good, fringes.theta, 0).astype(np.float32).transpose(1, 2, 0)
        inside = with_neighbours(fringes.frame)
        rest, variance = fringes.residual[inside], fringes.variance[inside]
        used = np.isfinite(rest) & fringes.good
        weight = np.divide(np.float32(1), variance, out=np.zeros_like(rest), where=used)
        weighted = weight * np.where(used, rest, np.float32(0))
        upper = np.triu_indices(3)
        by_row = weight.transpose(1, 0, 2) @ (theta[..., upper[0]] * theta[..., upper[1]])
        return cls(
            fringes,
            inside,
            fringes.origin[0] + np.arange(len(theta), dtype=float),
            (weighted.transpose(1, 0, 2) @ theta).transpose(1, 0, 2).astype(float),
            symmetric(by_row.transpose(1, 0, 2)),
        )

    @cached_property
    def _modes(self) -> F64:
        """Modes (t, y, m, 3) that are free in each frame: the maps, and phase slopes along y."""
        t, y = self.right.shape[:2]
        modes = np.broadcast_to(np.eye(3), (t, y, 3, 3))
        if not np.any(self.fringes.dk):
            return modes
        _, c, s = self.fringes.g[self.inside].T
        turned = np.stack([np.zeros(t), -s, c], axis=1)
        turns = grid(self.fringes.good.shape)[0][None] * turned[:, None]
        return np.concatenate([modes, turns[:, :, None]], axis=2)

    @cached_property
    def _covariance(self) -> F64:
        """Of the frames' modes (t, m, m)."""
        inner = np.einsum("tymi,tyij,tynj->tmn", self._modes, self.normal, self._modes)
        return inverse_normal(inner, 1e-10)

    def share(self, other: F64, factors: F64 | None = None) -> tuple[F64, F64]:
        """Normal matrix (y, y) and right-hand side (y,) of the share of a light in each row.

        Without the part that pixels and frames absorb. ``other``: (t, 3) the light's parameters in
        the frames inside. ``factors``: (y, 3) factors of these parameters in each row.
        """
        g = self.fringes.g[self.inside]
        light = (other - g @ (np.linalg.pinv(g) @ other))[:, None]
        # Pixels absorb more noise than light, by their degrees of freedom.
        left = 1 - g.shape[1] / len(g)
        if factors is not None:
            light = light * factors
        beside = np.einsum("tyij,tyj->tyi", self.normal, np.broadcast_to(light, self.right.shape))
        across = np.einsum("tymi,tyi->tym", self._modes, beside)
        of_rest = np.einsum("tymi,tyi->tm", self._modes, self.right)
        taken = across @ self._covariance
        flat, taken_flat = (a.swapaxes(0, 1).reshape(len(self.rows), -1) for a in (across, taken))
        normal = np.diag(np.sum(light * beside, axis=(0, 2))) - taken_flat @ flat.T
        return left * normal, np.sum(light * self.right, axis=(0, 2)) - taken_flat @ of_rest.ravel()


@dataclass(frozen=True)
class RowRamp:
    """A share of the next frame, growing with the row beyond a knee; before it, of the last."""

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
        """From normal sums by row; a knee inside the window only if significantly better."""
        rows = np.unique(np.concatenate([s[0] for s in sets]))
        first, last = float(rows[0]), float(rows[-1])
        edge, step = (0.0 if way > 0 else last), (last - first) / (_KNEES + 1)

        def ramps(knee: float) -> list[F64]:
            return [np.maximum(way * (s[0] - knee), 0.0)[:, None] for s in sets]

        def gain(knee: float) -> float:
            (value,), ((variance,),) = _slope(sets, ramps(knee))
            return float(value**2 / variance) if value > 0 else 0.0

        knee = max(np.linspace(first, last, _KNEES + 2)[1:-1].tolist(), key=gain)
        if gain(knee) < gain(edge) + _BENT:
            (value,), ((variance,),) = _slope(sets, ramps(edge))
            return cls(way, float(value), float(np.sqrt(variance)), edge, step)
        near = max(knee - step, first), min(knee + step, last)
        knee = float(minimize_scalar(lambda k: -gain(k), bounds=near, method="bounded").x)
        slope = float(_slope(sets, ramps(knee))[0][0])
        # The second term moves the knee.
        terms = [np.hstack([ramp, -way * slope * (ramp > 0)]) for ramp in ramps(knee)]
        errors = np.sqrt(np.diag(_slope(sets, terms)[1]))
        return cls(way, slope, float(errors[0]), knee, float(errors[1]))


def _slope(sets: Sequence[tuple[F64, F64, F64]], terms: Sequence[F64]) -> tuple[F64, F64]:
    """Sizes of terms (row, n) of the share, covariance; the frames absorb the mean share."""
    n = terms[0].shape[1]
    normal, right = np.zeros((n, n)), np.zeros(n)
    for (_, matrix, vector), term in zip(sets, terms, strict=True):
        apart = term - term.mean(axis=0)
        right += apart.T @ vector
        normal += apart.T @ matrix @ apart
    covariance: F64 = np.linalg.pinv(normal + 1e-30 * np.eye(n), hermitian=True).astype(float)
    return covariance @ right, covariance


def _rows(sums: RowSums, way: int, share: F64) -> tuple[F64, F64, F64]:
    """Rows of the window, normal matrix and right-hand side of a share in each row."""
    # Parameters of the frames, less the mean share of those of the frame before or after.
    g, mean = sums.fringes.g.copy(), float(share.mean())
    for t in range(len(g) - 2, -1, -1) if way > 0 else range(1, len(g)):
        g[t] = (g[t] - mean * g[t + way]) / (1 - mean)
    lost = 1 / (1 - (share - share.mean()))
    factors = np.stack([np.ones_like(lost), lost, lost], axis=1)
    return sums.rows, *sums.share(g[sums.inside + way] - g[sums.inside], factors)


# Phase errors of rows proportional to the phase step: a modulator that settles


@dataclass(frozen=True)
class Settling:
    """Phase error of each row as a share of the phase step."""

    way: int  # -1: of the step from the last frame; 1: of the step to the next one
    # where the modulator's range of one turn begins; None: it goes the shorter way
    origin_rad: float | None
    # share, error: (KNOTS,) at rows at equal distances from first to last, mean zero; 1-sigma
    # errors
    share: F64
    error: F64
    significance: float


def steps_of(phi: F64, way: int, origin_rad: float | None) -> F64:
    """Phase (t,) of the previous (way -1) or next (1) frame less its own, rad; 0 at the ends."""
    place = phi if origin_rad is None else np.mod(phi - origin_rad, 2 * np.pi)
    step = np.zeros(len(phi))
    frames = slice(1, None) if way < 0 else slice(None, -1)
    apart = place[:-1] - place[1:] if way < 0 else place[1:] - place[:-1]
    step[frames] = apart if origin_rad is not None else np.angle(np.exp(1j * apart))
    return step


def profile(share: Sequence[float] | F64, rows: F64) -> F64:
    """Profile at rows (0 first, 1 last) through its values at equal distances."""
    at = np.linspace(0, 1, len(share))
    return np.asarray(make_interp_spline(at, np.array(share), k=min(3, len(share) - 1))(rows))


@cache
def _terms(rows: int) -> F64:
    """Profiles (y, KNOTS) of zero mean at ``rows`` rows, for a unit value at each knot."""
    terms = profile(np.eye(KNOTS), np.linspace(0, 1, rows))
    return np.asarray(terms - terms.mean(axis=0))


def find_settling(sets: Sequence[RowSums]) -> Settling:
    """The likeliest profile, of the last step or the next, in either direction of rotation."""
    origins = [None, *(2 * np.pi * n / ORIGINS for n in range(ORIGINS))]
    ways = [(way, origin) for way in (-1, 1) for origin in origins]
    fits = {one: _fit(sets, *one) for one in ways}
    width = np.pi / ORIGINS
    while True:
        way, origin = max(fits, key=lambda one: fits[one][0])
        gain, share, error = fits[way, origin]
        chance = _significance(gain, len(ways))
        if origin is None or chance < CLEAR or width < FINEST:
            return Settling(way, origin, share, error, chance)
        # A step taken in the wrong direction is off by the share of one turn.
        for near in (origin - width / 2, origin + width / 2):
            fits[way, near] = _fit(sets, way, near)
        width /= 2


def settling_sigmas(sets: Sequence[RowSums], way: int, origin: float | None) -> float:
    """Significance of a profile for given steps alone."""
    return _significance(_fit(sets, way, origin)[0], 1)


def _significance(gain: float, tried: int) -> float:
    """Of the best gain in chi-square of ``tried``."""
    return sigmas_of_chi2(max(gain - 2 * np.log(tried), 1e-9), KNOTS - 1)


def _fit(sets: Sequence[RowSums], way: int, origin: float | None) -> tuple[float, F64, F64]:
    """Gain in chi-square, profile and its error."""
    normal, right = np.zeros((KNOTS, KNOTS)), np.zeros(KNOTS)
    slopes = []
    for sums in sets:
        f = sums.fringes
        _, cosine, sine = f.g.T
        step = without_own_harmonics(steps_of(f.phi, way, origin), f.phi)
        # Derivative of B, A cos phi and A sin phi by the phase, times the step.
        other = step[:, None] * np.stack([np.zeros(len(step)), -sine, cosine], axis=1)
        matrix, vector = sums.share(other[sums.inside])
        terms = _terms(len(vector))
        normal += terms.T @ matrix @ terms
        right += terms.T @ vector
        if np.any(f.dk):
            slopes.append(_weighted_slope(f, step[sums.inside], f.free[sums.inside, 4]))
    covariance = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
    share, variance = covariance @ right, np.diag(covariance)
    gain = float(right @ share)
    if slopes:
        value, weight = np.array(slopes).T
        mean = float(np.average(value, weights=weight))
        line = np.linspace(-0.5, 0.5, KNOTS)
        # The fit's free fringe vectors absorbed the slope of the profile over the rows.
        rows = terms @ line
        share = share + line * (mean - rows @ terms @ share / (rows @ rows))
        variance = variance + line**2 / weight.sum()
        gain += mean**2 * float(weight.sum())
    return gain, share, np.sqrt(variance)


def without_own_harmonics(step: F64, phi: F64) -> F64:
    """Steps (t,) without harmonics of the frames' own phases."""
    turns = np.outer(phi, np.arange(OWN_ORDERS + 1))
    harmonics = np.hstack([np.cos(turns), np.sin(turns[:, 1:])])
    return np.asarray(step - harmonics @ np.linalg.lstsq(harmonics, step, rcond=1e-9)[0])


def _weighted_slope(fringes: FringeEvidence, step: F64, turn: F64) -> tuple[float, float]:
    """Change of the share from first to last row, from fringe vectors, and its weight."""
    size, moved = step - step.mean(), turn - turn.mean()
    value = float(size @ moved / (size @ size))
    left = moved - value * size
    variance = float(left @ left) / max(len(left) - 2, 1) / float(size @ size)
    rows = fringes.good.shape[0] - 1
    return value * rows, 1 / (variance * rows**2)
