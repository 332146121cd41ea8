"""What fitted maps hold of frames that some pixels see otherwise than the fit takes them to be.

The fit gives a pixel the parameters of the frame. Where these are off by a known amount in each
frame, the pixel's maps take up what its own fit cannot tell from light of its own. It depends on
the phase of the pixel's fringe alone, so it is computed on a few pixels spread over a fringe.
"""

import numpy as np

from pixcal.model.arrays import F64

PHASES = 64  # spread over a fringe
MIN_SIGNAL = 1.0  # of a sample (e-), below which its shot noise is not taken


def usual_fringe(theta: F64, count: int) -> tuple[F64, F64]:
    """Phases (count,) over a fringe, and maps (3, count) of pixels of the usual light."""
    psi = np.linspace(0, 2 * np.pi, count, endpoint=False)
    mean, amplitude = np.median(theta[0]), np.median(np.hypot(theta[1], theta[2]))
    return psi, np.stack([np.full(count, mean), amplitude * np.sin(psi), amplitude * np.cos(psi)])


def imprint(theta: F64, g: F64, change: F64, read_noise_e: float) -> F64:
    """Change (3, y, x) of maps, e-, for a change (t, 3) of the frames' parameters ``g``."""
    psi, usual = usual_fringe(theta, PHASES)
    taken = _taken(g, change, _weight(g @ usual, read_noise_e))
    at = np.arctan2(theta[1], theta[2])
    moved = np.empty_like(theta)
    for i in range(3):
        of_each = [np.interp(at, psi, taken[:, i, j], period=2 * np.pi) for j in range(3)]
        moved[i] = np.einsum("jyx,jyx->yx", np.stack(of_each), theta)
    return moved


def left_in_samples(theta: F64, g: F64, change: F64, read_noise_e: float) -> float:
    """Mean square, over the samples' noise, of what maps do not take up; as of `imprint`."""
    _, usual = usual_fringe(theta, PHASES)
    weight = _weight(g @ usual, read_noise_e)
    taken = _taken(g, change, weight)
    rest = change @ usual - g @ np.einsum("pij,jp->ip", taken, usual)
    return float(np.mean(weight * rest**2))


def _weight(signal: F64, read_noise_e: float) -> F64:
    return 1 / (np.maximum(signal, MIN_SIGNAL) + read_noise_e**2)


def _taken(g: F64, change: F64, weight: F64) -> F64:
    """What the fit of a pixel takes of the change: matrices (pixel, 3, 3) on its maps."""
    normal = np.einsum("tp,ti,tj->pij", weight, g, g, optimize=True)
    right = np.einsum("tp,ti,tj->pij", weight, g, change, optimize=True)
    return np.linalg.solve(normal, right)
