"""The paper's method in NumPy: frames and pixels in turn, five times.

Rousset et al., sections 3.3 and 4.2, after Crouzier et al. 2016, A&A 595, A108. With fixed
parameters of the pixels, every frame gives B, A, phi and the fringe vector; with fixed parameters
of the frames, every pixel gives iota, alpha and, from the second iteration on, its offset, which
here is its phase psi. The fringe vector is the mean of all frames. B and A are set to their means
from the second iteration on, without which the paper found no sure convergence, or are left free.

Where the paper leaves a choice, the simplest is used: the weights of its equation 5 are 1. With A
cos(phi) and A sin(phi) as unknowns, and the turn of the fringes to first order, both steps are
linear: one product of a small pseudo-inverse and the whole cube each, far faster than a non-linear
search for every frame and pixel.
"""

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

ITERATIONS = 5
"""Of the paper's figure 10."""


def fit_phases(
    cube: F64, vector: tuple[float, float], *, constant: bool, iterations: int = ITERATIONS
) -> F64:
    """Phase (y, x) of every pixel: psi of ``B iota + A alpha sin(psi + phi)``, rad, modulo a turn.

    ``cube``: (t, y, x) frames, e-. ``vector``: nominal fringe vector (kx, ky), rad/px, right to a
    fraction of a fringe across the window. ``constant``: set B and A to their means from the second
    iteration on.
    """
    frames = cube.reshape(len(cube), -1)
    y, x = (axis.ravel() - axis.mean() for axis in np.indices(cube.shape[1:]))
    psi = vector[0] * x + vector[1] * y
    iota = alpha = np.ones_like(psi)
    for iteration in range(iterations):
        level, amplitude, phi, (dkx, dky) = _fit_frames(frames, iota, alpha, psi, x, y)
        if constant and iteration > 0:
            level[:], amplitude[:] = level.mean(), amplitude.mean()
        psi = psi + dkx * x + dky * y
        iota, s, c = _fit_pixels(frames, level, amplitude, phi)
        if iteration == 0:
            alpha = s * np.sin(psi) + c * np.cos(psi)
        else:
            alpha, psi = np.hypot(s, c), np.arctan2(s, c)
    return np.asarray(psi.reshape(cube.shape[1:]))


def _fit_frames(
    frames: F64, iota: F64, alpha: F64, psi: F64, x: F64, y: F64
) -> tuple[F64, F64, F64, F64]:
    """B, A, phi (t,) of the frames (t, p), and the mean change (2,) of the fringe vector."""
    s, c = alpha * np.sin(psi), alpha * np.cos(psi)
    basis = np.stack([iota, s, c, x * s, x * c, y * s, y * c], axis=1)
    level, p, q, xs, xc, ys, yc = np.linalg.pinv(basis) @ frames.T
    # Fringes p s + q c that turn by e = dkx x + dky y become p s + q c + e (p c - q s).
    square = p * p + q * q
    turn = np.array([np.mean((p * xc - q * xs) / square), np.mean((p * yc - q * ys) / square)])
    return level, np.sqrt(square), np.arctan2(q, p), turn


def _fit_pixels(frames: F64, level: F64, amplitude: F64, phi: F64) -> F64:
    """iota, alpha sin psi and alpha cos psi (3, p) of the pixels."""
    basis = np.stack([level, amplitude * np.cos(phi), amplitude * np.sin(phi)], axis=1)
    return np.asarray(np.linalg.pinv(basis) @ frames)
