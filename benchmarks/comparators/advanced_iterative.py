"""The advanced iterative algorithm (AIA) in NumPy, for frames shifted at random.

Wang and Han 2004, Opt. Lett. 29, 1671. Two linear fits in turn: with the frames' phases known, each
pixel gives its phase, and a background and modulation taken as the same in all frames; with the
pixels' phases known, each frame gives its phase, and a background and modulation taken as the same
in all pixels. They end when the phases of the frames, relative to the first, no longer change.

It assumes uniform light and response in one step, a steady laser in the other, and one fringe
vector for all frames. All samples have equal weight. The algorithm starts from guessed shifts of
the frames; here the shifts are unknown but the nominal fringes are known, so the frames come first.
"""

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

TOLERANCE_RAD = 1e-4
"""The phases stand still when none moves by more."""

MAX_ITERATIONS = 50


def fit_phases(
    cube: F64,
    vector: tuple[float, float],
    *,
    tolerance_rad: float = TOLERANCE_RAD,
    max_iterations: int = MAX_ITERATIONS,
) -> F64:
    """Phase (y, x) of every pixel: psi of ``a + b cos(psi + phi)``, rad, in ±pi.

    That of the last iteration if the phases of the frames do not converge. ``cube``: (t, y, x)
    frames, e-. ``vector``: nominal fringe vector (kx, ky), rad/px.
    """
    frames = cube.reshape(len(cube), -1)
    y, x = np.indices(cube.shape[1:])
    psi = (vector[0] * x + vector[1] * y).ravel()
    shifts = _phases(frames.T, psi)
    for _ in range(max_iterations):
        psi = _phases(frames, shifts)
        before, shifts = shifts, _phases(frames.T, psi)
        moved = np.angle(np.exp(1j * ((shifts - shifts[0]) - (before - before[0]))))
        if np.abs(moved).max() < tolerance_rad:
            break
    return psi.reshape(cube.shape[1:])


def _phases(samples: F64, known: F64) -> F64:
    """u (n,) of ``a + b cos(known + u)``, from samples (m, n) and the known phases (m,)."""
    basis = np.stack([np.ones_like(known), np.cos(known), np.sin(known)], axis=1)
    _, c, s = np.linalg.pinv(basis) @ samples
    return np.asarray(np.arctan2(-s, c))
