"""`scipy.optimize.curve_fit` on one pixel after the other.

The fit of a pixel needs B, A and phi of the frames. They are measured first, by Fourier
demodulation of the frames (Takeda, Ina and Kobayashi 1982, J. Opt. Soc. Am. 72, 156): the mean of a
frame under a Hann window is B, its component at the nominal fringe vector A exp(i phi). Each pixel
is then fitted for iota, alpha and psi, starting from the nominal fringes, the samples weighted by
the errors that a user would give: read noise, and shot noise of the sample as measured.

It assumes one fringe vector for all frames, and a window wide enough that the Hann window separates
the mean, the fringes and their mirror image.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import curve_fit

F64 = NDArray[np.float64]


def demodulate(cube: F64, vector: tuple[float, float]) -> F64:
    """B, A (e-) and phi (rad) of every frame, (3, t), for iota and alpha of mean 1.

    ``cube``: (t, y, x) frames, e-. ``vector``: nominal fringe vector (kx, ky), rad/px.
    """
    ny, nx = cube.shape[1:]
    # The zeros at the ends of the Hann window lie outside of the frame.
    window = np.outer(np.hanning(ny + 2)[1:-1], np.hanning(nx + 2)[1:-1]).ravel()
    window /= window.sum()
    y, x = (axis.ravel() for axis in np.indices((ny, nx)))
    psi = vector[0] * x + vector[1] * y
    basis = np.stack([window, window * np.cos(psi), window * np.sin(psi)], axis=1)
    level, c, s = (cube.reshape(len(cube), -1) @ basis).T
    leak = basis.sum(axis=0)
    # sin(psi + phi) has exp(i phi) / 2i at the fringe vector, where the mean has what it leaks.
    wave = 2j * (c - 1j * s - level * (leak[1] - 1j * leak[2]))
    return np.stack([level, np.abs(wave), np.angle(wave)])


def fringe(frames: F64, iota: float, alpha: float, psi: float) -> F64:
    """Electrons (t,) of a pixel in frames (B, A, phi)."""
    level, amplitude, phi = frames
    return np.asarray(iota * level + alpha * amplitude * np.sin(psi + phi))


def fit_phases(
    cube: F64,
    vector: tuple[float, float],
    frames: F64,
    chosen: NDArray[np.bool_],
    read_noise: float,
) -> F64:
    """Phase (y, x): psi of ``B iota + A alpha sin(psi + phi)``, rad; NaN where not ``chosen``.

    ``cube``: (t, y, x) frames, e-. ``vector``: nominal fringe vector (kx, ky), rad/px. ``frames``:
    (3, t) from `demodulate`. ``read_noise``: e- rms.
    """
    phase = np.full(chosen.shape, np.nan)
    for y, x in np.argwhere(chosen):
        signal = cube[:, y, x]
        start = (1.0, 1.0, vector[0] * x + vector[1] * y)
        sigma = np.sqrt(np.maximum(signal, 0) + read_noise**2)
        (_, _, phase[y, x]), _ = curve_fit(fringe, frames, signal, p0=start, sigma=sigma)
    return phase
