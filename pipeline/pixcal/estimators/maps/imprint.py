"""What fitted maps hold of frames that some pixels see otherwise than the fit takes them to be.

The fit gives a pixel the parameters of the frame. Where these are off by a known amount in each
frame, the pixel's maps take up what its own fit cannot tell from light of its own. It depends on
the phase of the pixel's fringe alone, so it is computed on a few pixels spread over a fringe.
"""

import numpy as np

from pixcal.model.arrays import F64

PHASES = 64  # spread over a fringe
LEAST_SIGNAL = 1.0  # of a sample (e-), below which its shot noise is not taken


def imprint(theta: F64, g: F64, change: F64, read_noise_e: float) -> tuple[F64, float]:
    """Change of the maps for a change of the frames' parameters, and the noise that it leaves.

    Parameters
    ----------
    theta : (3, y, x) float64
        (iota, alpha sin psi, alpha cos psi), e-, of all pixels: they have a usual light.
    g, change : (t, 3) float64
        Intensity, and amplitude times cosine and sine of the phase, of each frame as fitted; and
        by how much they differ for the pixels.
    read_noise_e : float

    Returns
    -------
    moved : (3, y, x) float64
        What the maps take up, e-.
    left : float
        Mean square of what is left in the samples, in units of their noise.
    """
    psi = np.linspace(0, 2 * np.pi, PHASES, endpoint=False)
    mean, amplitude = np.median(theta[0]), np.median(np.hypot(theta[1], theta[2]))
    usual = np.stack([np.full(PHASES, mean), amplitude * np.sin(psi), amplitude * np.cos(psi)])
    weight = 1 / (np.maximum(g @ usual, LEAST_SIGNAL) + read_noise_e**2)
    normal = np.einsum("tp,ti,tj->pij", weight, g, g)
    taken = np.linalg.solve(normal, np.einsum("tp,ti,tj->pij", weight, g, change))
    rest = change @ usual - np.einsum("ti,pij,jp->tp", g, taken, usual)
    left = float(np.mean(weight * rest**2))
    at = np.arctan2(theta[1], theta[2])
    moved = np.empty_like(theta)
    for i in range(3):
        of_each = [np.interp(at, psi, taken[:, i, j], period=2 * np.pi) for j in range(3)]
        moved[i] = np.einsum("jyx,jyx->yx", np.stack(of_each), theta)
    return moved, left
