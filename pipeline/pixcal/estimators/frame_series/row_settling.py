"""Phase that differs from row to row while the modulator settles, as a share of its step.

No law is asked of the profile along the rows: it is a spline, free but for its mean, which the
frame's own phase takes up.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.interpolate import make_interp_spline

from pixcal.estimators.diagnosis.evidence import FringeEvidence
from pixcal.estimators.frame_series.row_sums import RowSums
from pixcal.kernels.significance import sigmas_of_chi2
from pixcal.model.arrays import F64

KNOTS = 13  # rows at equal distances at which the profile is given
ORIGINS = 8  # phases tried as the one where the modulator's range begins
# standard deviations from which that phase is sought more finely, and how finely, rad
CLEAR, FINEST = 4.0, 0.01
OWN_ORDERS = 4  # harmonics of a frame's own phase that a step must not be taken for


@dataclass(frozen=True)
class Settling:
    """Share of a step by which the phase of a row is off."""

    way: int  # -1: of the step from the last frame; 1: of the step to the next one
    # where the modulator's range of one turn begins; None: it goes the shorter way
    origin_rad: float | None
    # share, error: (KNOTS,) at rows at equal distances from first to last, mean zero; 1-sigma
    # errors
    share: F64
    error: F64
    significance: float


def steps_of(phi: F64, way: int, origin_rad: float | None) -> F64:
    """Phase of the frame before (way -1) or after (1) less each's (t,), rad; 0 at the ends."""
    place = phi if origin_rad is None else np.mod(phi - origin_rad, 2 * np.pi)
    step = np.zeros(len(phi))
    own = slice(1, None) if way < 0 else slice(None, -1)
    apart = place[:-1] - place[1:] if way < 0 else place[1:] - place[:-1]
    step[own] = apart if origin_rad is not None else np.angle(np.exp(1j * apart))
    return step


def profile(share: Sequence[float] | F64, rows: F64) -> F64:
    """Profile at rows (0 first, 1 last) through its values at equal distances."""
    at = np.linspace(0, 1, len(share))
    return np.asarray(make_interp_spline(at, np.array(share), k=min(3, len(share) - 1))(rows))


@cache
def _terms(rows: int) -> F64:
    """What a profile is at so many rows (y, KNOTS) for a unit at each of its knots; mean zero."""
    terms = profile(np.eye(KNOTS), np.linspace(0, 1, rows))
    return np.asarray(terms - terms.mean(axis=0))


def find_settling(sets: Sequence[RowSums]) -> Settling:
    """The likeliest profile, of the last step or the next, along either way around the turn."""
    origins = [None, *(2 * np.pi * n / ORIGINS for n in range(ORIGINS))]
    ways = [(way, origin) for way in (-1, 1) for origin in origins]
    found = {one: _fit(sets, *one) for one in ways}
    width = np.pi / ORIGINS
    while True:
        way, origin = max(found, key=lambda one: found[one][0])
        gain, share, error = found[way, origin]
        chance = _significance(gain, len(ways))
        if origin is None or chance < CLEAR or width < FINEST:
            return Settling(way, origin, share, error, chance)
        # A frame whose step is taken around the wrong way is off by the share of a turn.
        for near in (origin - width / 2, origin + width / 2):
            found[way, near] = _fit(sets, way, near)
        width /= 2


def settling_sigmas(sets: Sequence[RowSums], way: int, origin: float | None) -> float:
    """Significance of a profile of steps that way, whatever the others."""
    return _significance(_fit(sets, way, origin)[0], 1)


def _significance(gain: float, tried: int) -> float:
    """Of the best gain in chi-square of so many."""
    return sigmas_of_chi2(max(gain - 2 * np.log(tried), 1e-9), KNOTS - 1)


def _fit(sets: Sequence[RowSums], way: int, origin: float | None) -> tuple[float, F64, F64]:
    """Gain in chi-square, profile and its error."""
    normal, right = np.zeros((KNOTS, KNOTS)), np.zeros(KNOTS)
    slopes = []
    for sums in sets:
        f = sums.found
        _, cosine, sine = f.g.T
        step = beside_own_phase(steps_of(f.phi, way, origin), f.phi)
        # Of B, A cos phi and A sin phi, what a turn of the phase does, times the step.
        other = step[:, None] * np.stack([np.zeros(len(step)), -sine, cosine], axis=1)
        own, vector = sums.share(other[sums.inside])
        terms = _terms(len(vector))
        normal += terms.T @ own @ terms
        right += terms.T @ vector
        if np.any(f.dk):
            slopes.append(_slope(f, step[sums.inside], f.free[sums.inside, 4]))
    covariance = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
    share, variance = covariance @ right, np.diag(covariance)
    gain = float(right @ share)
    if slopes:
        value, weight = np.array(slopes).T
        mean = float(np.average(value, weights=weight))
        line = np.linspace(-0.5, 0.5, KNOTS)
        # Of a profile's slope over the rows the fit's free fringe vectors have left nothing.
        rows = terms @ line
        share = share + line * (mean - rows @ terms @ share / (rows @ rows))
        variance = variance + line**2 / weight.sum()
        gain += mean**2 * float(weight.sum())
    return gain, share, np.sqrt(variance)


def beside_own_phase(step: F64, phi: F64) -> F64:
    """Steps (t,) without what goes with harmonics of the frames' own phases."""
    turns = np.outer(phi, np.arange(OWN_ORDERS + 1))
    own = np.hstack([np.cos(turns), np.sin(turns[:, 1:])])
    return np.asarray(step - own @ np.linalg.lstsq(own, step, rcond=1e-9)[0])


def _slope(found: FringeEvidence, step: F64, turn: F64) -> tuple[float, float]:
    """Change of the share from first to last row, by the fringe vectors, and its weight."""
    size, moved = step - step.mean(), turn - turn.mean()
    value = float(size @ moved / (size @ size))
    left = moved - value * size
    variance = float(left @ left) / max(len(left) - 2, 1) / float(size @ size)
    rows = found.good.shape[0] - 1
    return value * rows, 1 / (variance * rows**2)
