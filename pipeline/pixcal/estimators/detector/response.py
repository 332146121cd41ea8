"""From collected light to signal: boundaries shifted by charge, nonlinear response.

Both are fitted together to the residuals of the fringe fit, because both cause a second harmonic of
the phase. The harmonic of the response is equal for all fringes; that of moving boundaries
(brighter-fatter) depends on the fringe period.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag

from pixcal.estimators.diagnosis import distortions
from pixcal.estimators.diagnosis.distortions import Agreement, Distortion
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, cached_on_evidence
from pixcal.kernels.boundaries import REACH, boundary_shifts, moved_charge
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F32, F64

UNIT = 1e-7  # unit of the fitted shift of boundaries (px per electron)
# Shifts of any falloff between the first and the last are a sum of these, to 10⁻⁵ within `REACH`.
FALLOFFS_PX = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
_TRIED = 61  # falloffs, from the first to the last
# Parabolas about the best falloff, the next about the top of the last and as narrow as its error;
# half-width of the first, of the logarithm.
_PARABOLAS, _WIDEST = 3, 0.17
LOOSE = 0.02  # prior 1-sigma of the departure from a response, over full scale
# response fitted with boundaries: level (e-) at which its powers are one, and their number
LEVEL, POWERS = 5e4, 3
# Prior 1-sigma of the shift along y over that along x, about 1: with one period along each axis a
# falloff may do for it.
_RATIO_ERROR = 0.2
MAX_LOG_ERROR = 0.5  # largest error of the logarithm of a measured falloff


def fit_response(
    evidence: Evidence, level_e: float, shifts: F64, known: tuple[float, float] | None = None
) -> tuple[F64, F64]:
    """Coefficients c_1, c_2 and the shift per electron (px); their covariance.

    The relative response is 1 + c_1 u + c_2 u², u = 1 at ``level_e``. ``shifts``:
    `pixcal.kernels.boundaries.boundary_shifts`, of size one. ``known``: the shift and its variance
    from the noise of neighbours.
    """
    prior = None
    if known is not None:
        value, information = np.zeros((2, 3))
        value[-1], information[-1] = known[0] / UNIT, UNIT**2 / known[1]
        prior = value, information
    sizes, covariance, _ = distortions.fit_distortions(
        tuple(evidence.fringes.values()),
        _signal_of(evidence, level_e, [UNIT * shifts]),
        3,
        margin=_margin(evidence),
        prior=prior,
    )
    scale = np.array([1.0, 1.0, UNIT])
    return sizes * scale, covariance * np.outer(scale, scale)


def _margin(evidence: Evidence) -> int:
    """Rows along the edges, near which charge outside acts; fewer in a window with few of them."""
    return int(min(REACH, (min(evidence.good.shape) - 1) // 4))


def _signal_of(evidence: Evidence, level_e: float, every: Sequence[F64]) -> Distortion:
    """Change of a signal by moving boundaries (last sizes), then by the response (first)."""
    flat = evidence.flat.astype(np.float32)

    def distortion(fringes: FringeEvidence, signal: F32, sizes: F64) -> F32:
        powers, moves = sizes[: -len(every)], sizes[-len(every) :]
        level = charge = evidence.level(fringes, signal)
        for size, shifts in zip(moves, every, strict=True):
            if size:
                charge = charge + moved_charge(level, size * shifts)
        factor = np.polyval(np.array([*powers[::-1], 1], np.float32), charge / np.float32(level_e))
        return np.asarray((charge * factor - level) / flat)

    return distortion


def departure(level: F32, knots_e: F64, change_e: F64) -> F32:
    """Natural cubic spline through the changes at knots; constant beyond them."""
    spline = CubicSpline(knots_e, change_e, bc_type="natural")
    return np.asarray(spline(np.clip(level, knots_e[0], knots_e[-1])), np.float32)


def fit_curve(
    evidence: Evidence, response: Callable[[F32], F32], knots_e: F64
) -> tuple[F64, F64, Agreement]:
    """Departure (n - 1,) of the signal from a response at all knots but the first, e-.

    With covariance and the sets' agreement. Fringes constrain neither its offset nor its factor.

    response : signal (t, y, x) of a charge of that shape, e-
    knots_e : (n,) levels, rising, e-, the first zero, where there is no departure
    """
    unit = LOOSE * knots_e[-1] * np.eye(len(knots_e))[1:-1]

    def distortion(fringes: FringeEvidence, signal: F32, sizes: F64) -> F32:
        level = evidence.level(fringes, signal)
        change = response(level) - level + departure(level, knots_e, sizes @ unit)
        return np.asarray(change / evidence.flat, np.float32)

    prior = np.zeros(len(unit)), np.ones(len(unit))
    sizes, covariance, agreement = distortions.fit_distortions(
        tuple(evidence.fringes.values()), distortion, len(unit), prior=prior
    )
    straight = np.stack([np.ones(len(unit) + 1), knots_e[1:]], axis=1)
    straight /= np.abs(straight).max(axis=0)
    taken = straight @ np.linalg.pinv(straight[1:])
    rest = np.eye(len(unit) + 1) - np.pad(taken, ((0, 0), (1, 0)))
    rest = LOOSE * knots_e[-1] * rest[:, :-1]  # the last knot is not fitted
    return rest @ sizes, rest @ covariance @ rest.T, agreement


@dataclass(frozen=True)
class Boundaries:
    """Moving boundaries without a nonlinear response, from the second harmonics of all sets."""

    shift: float  # of boundaries between columns, per electron, px
    along_y: float  # shift of boundaries between rows over that
    falloff_px: float
    # independent joint 1-sigma steps (n, 3) of these; of the first two for this falloff, and, where
    # the falloff is constrained, of all
    steps: F64
    # against, shapes: chi-square by which an additional nonlinear response, and boundaries alone
    # with any function of distance, would fit better
    against: float
    shapes: float


def boundaries_alone(evidence: Evidence, otherwise_px: float) -> Boundaries:
    """Moving boundaries alone, without a nonlinear response, with the best-fitting falloff.

    ``otherwise_px``: falloff where harmonics do not constrain it.
    """
    sums = _boundary_sums(evidence)
    shifts = [(normal[POWERS:, POWERS:], right[POWERS:]) for normal, right in sums]
    of_any_shape = sum(float(right @ inverse_normal(normal) @ right) for normal, right in shifts)
    return _best_falloff(
        lambda falloff: _alone(_of_falloff(sums, falloff)), otherwise_px, of_any_shape
    )


def _of_falloff(sums: Sequence[tuple[F64, F64]], falloff_px: float) -> list[tuple[F64, F64]]:
    """Sums for the powers and boundaries of one falloff, from those of `FALLOFFS_PX`."""
    fitted = np.stack([boundary_shifts(falloff).ravel() for falloff in FALLOFFS_PX], axis=1)
    shares = np.linalg.lstsq(fitted, boundary_shifts(falloff_px).ravel(), rcond=None)[0]
    taken = block_diag(np.eye(POWERS), shares)
    return [(taken @ normal @ taken.T, taken @ right) for normal, right in sums]


@cached_on_evidence
def _boundary_sums(evidence: Evidence) -> list[tuple[F64, F64]]:
    """Sums of `distortion_sums` for powers and falloffs, of fringes across columns and rows."""
    every = [UNIT * boundary_shifts(falloff) for falloff in FALLOFFS_PX]
    signal = _signal_of(evidence, LEVEL, every)
    sets = evidence.fringes.values()
    across = [
        tuple(f for f in sets if (abs(f.k[0]) >= abs(f.k[1])) == of_columns)
        for of_columns in (True, False)
    ]
    return [
        distortions.distortion_sums(
            own, signal, POWERS + len(every), POWERS, margin=_margin(evidence)
        )
        for own in across
        if own
    ]


def boundaries_beside(
    evidence: Evidence, falloff_px: float, known: tuple[float, float] | None = None
) -> tuple[float, float, float]:
    """Boundaries of a falloff, fitted with a free response.

    ``known``: mean shift per electron (px) and its variance, from the noise of neighbours. Returns
    both of the mean of boundaries between columns and between rows, and the chi-square that they
    explain beyond the response, less one for a second axis, which has a shift of its own.
    """
    sums = _of_falloff(_boundary_sums(evidence), falloff_px)
    normal, right = _joint(sums)
    mean = np.zeros(len(right))
    mean[POWERS:] = 1 / len(sums)
    if known is not None:
        information = UNIT**2 / known[1]
        normal = normal + information * np.outer(mean, mean)
        right = right + information * known[0] / UNIT * mean
    inverse, only = inverse_normal(normal), inverse_normal(normal[:POWERS, :POWERS])
    gain = float(right @ inverse @ right - right[:POWERS] @ only @ right[:POWERS])
    size, variance = float(mean @ inverse @ right), float(mean @ inverse @ mean)
    return UNIT * size, UNIT**2 * variance, max(gain, 0.0) - len(sums) + 1


def _joint(sums: Sequence[tuple[F64, F64]]) -> tuple[F64, F64]:
    """Normal equations: powers common to all sums of `_of_falloff`, and a shift of each."""
    n = POWERS + len(sums)
    joint, right = np.zeros((n, n)), np.zeros(n)
    for number, (normal, own) in enumerate(sums):
        places = [*range(POWERS), POWERS + number]
        joint[np.ix_(places, places)] += normal
        right[places] += own
    return joint, right


def _alone(sums: Sequence[tuple[F64, F64]]) -> F64:
    """Shift, variance, chi-square explained, and that by an added response; axis ratio, error."""
    joint, right = _joint(sums)
    normal, rights = joint[POWERS:, POWERS:], right[POWERS:]
    if len(sums) > 1:
        apart = np.array([1.0, -1.0]) * np.trace(normal) / (_RATIO_ERROR * rights.sum())
        normal += np.outer(apart, apart)
    covariance = np.linalg.inv(normal)
    sizes = covariance @ rights
    gain = sizes @ rights
    beside = right @ inverse_normal(joint) @ right - gain
    ratio = sizes[-1] / sizes[0]
    error = _RATIO_ERROR
    if len(sums) > 1:
        slope = np.array([-ratio, 1.0]) / sizes[0]
        error = np.sqrt(slope @ covariance @ slope)
    return np.array([UNIT * sizes[0], UNIT**2 * covariance[0, 0], gain, beside, ratio, error])


def _best_falloff(of: Callable[[float], F64], otherwise_px: float, of_any: float) -> Boundaries:
    """From parabolas about the best; ``of_any``: chi-square of boundaries of any shape."""
    tried = np.log(np.geomspace(FALLOFFS_PX[0], FALLOFFS_PX[-1], _TRIED))
    best, error = tried[np.argmax([of(falloff)[2] for falloff in np.exp(tried)])], np.inf
    for _ in range(_PARABOLAS):
        half = min(error, _WIDEST)
        middle = np.clip(best, tried[0] + half, tried[-1] - half)
        at = half * np.array([-1.0, 0.0, 1.0])
        bends = np.polyfit(at, [of(falloff) for falloff in np.exp(middle + at)], 2).T
        curved, slope, _ = bends[2]
        if curved >= 0:
            error = np.inf
            break
        error, top = 1 / np.sqrt(-curved), middle - slope / (2 * curved)
        best = np.clip(top, tried[0], tried[-1])
    falloff, with_falloff = otherwise_px, []
    if error < MAX_LOG_ERROR:
        # Limited to the range tried; the distance from the maximum adds to the error.
        error = np.hypot(error, top - best)
        falloff = float(np.exp(best))
        rises = [error * np.polyval(np.polyder(bends[n]), best - middle) for n in (0, 4)]
        with_falloff = [[*rises, falloff * error]]
    shift, variance, gain, against, ratio, own = of(falloff).tolist()
    steps = np.array([[np.sqrt(variance), 0, 0], [0, own, 0], *with_falloff])
    return Boundaries(shift, ratio, falloff, steps, against, of_any - gain)
