"""Offsets of a fit whose three maps were corrected for an effect linear in the intensity.

The change of each pixel's phase is added to its fitted phase. As the change contains modes that are
degenerate with the bench, these are removed again. The sums of parts of the window add up, so a
detector is corrected part by part: `phase_sums` of each part, `solve_modes` of the total, then
`offsets` of each part.
"""

import numpy as np

from pixcal.estimators.fringe_fit.fringes import grid
from pixcal.estimators.fringe_fit.gauge import fringe_modes
from pixcal.estimators.fringe_fit.modes import solve_modes
from pixcal.model.arrays import F64

PHASES = 64  # spread over a fringe
MIN_SIGNAL = 1.0  # least signal (e-) for which shot noise is computed


def phase_change(before: F64, after: F64) -> F64:
    """Change of the phase psi (y, x), rad, from maps (iota, alpha sin psi, alpha cos psi)."""
    z, moved = before[2] + 1j * before[1], after[2] + 1j * after[1]
    return np.asarray(np.angle(moved * z.conj()))


def straight_modes(theta: F64, k: tuple[float, float]) -> F64:
    """Modes (7, y, x) of straight fringes with free intensities: 1, x, y, fringes at k and 2 k."""
    shape = theta.shape[1:]
    y, x = np.broadcast_arrays(*grid(shape))
    carrier = k[0] * x + k[1] * y
    phasor = (theta[2] + 1j * theta[1]) * np.exp(-1j * carrier)
    psi = carrier + np.angle(np.nansum(phasor))
    ratio = np.nanmedian(theta[0] / np.maximum(np.abs(phasor), 1e-300))
    return np.stack([np.ones(shape), x, y, *fringe_modes(psi, np.full(shape, ratio))])


def phase_sums(modes: F64, delta: F64, sigma: F64, change: F64, k: float) -> tuple[F64, F64]:
    """Least-squares sums (mode, mode), (mode, 1) of a part's phases after a change (y, x), rad.

    ``modes``: (mode, y, x) in offsets ``delta`` and errors, px, NaN masked; ``k``: rad/px.
    """
    good = np.isfinite(delta) & np.isfinite(change) & (sigma > 0)
    good_modes = modes[:, good]
    weighted = good_modes / (sigma[good] * k) ** 2
    return weighted @ good_modes.T, (weighted @ (delta[good] * k + change[good]))[:, None]


def offsets(modes: F64, coefficients: F64, delta: F64, change: F64, k: float) -> F64:
    """Offset (y, x) along the fringe axis, px, after a change of the phase and without modes."""
    return np.asarray(delta + (change - np.tensordot(coefficients[:, 0], modes, 1)) / k)


def corrected_offsets(delta: F64, sigma: F64, change: F64, modes: F64, k: float) -> F64:
    """Offsets (y, x) of a whole window after a change of the phase; see `offsets`."""
    coefficients = solve_modes(*phase_sums(modes, delta, sigma, change, k))
    return offsets(modes, coefficients, delta, change, k)


# Change of the maps of pixels whose frame parameters differ from those of the fit


def median_fringe(theta: F64, count: int) -> tuple[F64, F64]:
    """Phases (count,) over a fringe, and maps (3, count) at median mean and amplitude."""
    psi = np.linspace(0, 2 * np.pi, count, endpoint=False)
    mean, amplitude = np.median(theta[0]), np.median(np.hypot(theta[1], theta[2]))
    return psi, np.stack([np.full(count, mean), amplitude * np.sin(psi), amplitude * np.cos(psi)])


def absorbed_map_change(theta: F64, g: F64, change: F64, read_noise_e: float) -> F64:
    """Change (3, y, x) of maps, e-, for a change (t, 3) of the frames' parameters ``g``."""
    psi, usual = median_fringe(theta, PHASES)
    taken = _taken(g, change, _weight(g @ usual, read_noise_e))
    at = np.arctan2(theta[1], theta[2])
    moved = np.empty_like(theta)
    for i in range(3):
        of_each = [np.interp(at, psi, taken[:, i, j], period=2 * np.pi) for j in range(3)]
        moved[i] = np.einsum("jyx,jyx->yx", np.stack(of_each), theta)
    return moved


def unabsorbed_power(theta: F64, g: F64, change: F64, read_noise_e: float) -> float:
    """Mean square over the noise variance of changes beyond `absorbed_map_change`."""
    _, usual = median_fringe(theta, PHASES)
    weight = _weight(g @ usual, read_noise_e)
    taken = _taken(g, change, weight)
    rest = change @ usual - g @ np.einsum("pij,jp->ip", taken, usual)
    return float(np.mean(weight * rest**2))


def _weight(signal: F64, read_noise_e: float) -> F64:
    return 1 / (np.maximum(signal, MIN_SIGNAL) + read_noise_e**2)


def _taken(g: F64, change: F64, weight: F64) -> F64:
    """Part of the change that the fit of a pixel absorbs: matrices (pixel, 3, 3) on its maps."""
    normal = np.einsum("tp,ti,tj->pij", weight, g, g, optimize=True)
    right = np.einsum("tp,ti,tj->pij", weight, g, change, optimize=True)
    return np.linalg.solve(normal, right)
