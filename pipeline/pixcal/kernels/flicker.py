"""Flicker (1/f) noise along a line of samples, of the same power in every octave of frequency."""

import numpy as np

from pixcal.model.arrays import F64

SPAN = 4  # periods up to so many lengths of the line are there


def flicker(rng: np.random.Generator, count: int) -> F64:
    """One line of flicker noise (count,), of unit variance in every octave, without its mean."""
    period = _period(count)
    variance = _variance(period)
    drawn = rng.standard_normal((2, len(variance)))
    modes = period / 2 * np.sqrt(variance) * (drawn[0] - 1j * drawn[1])
    line = np.fft.irfft(modes, period)[:count]
    return np.asarray(line - line.mean())


def flicker_power(count: int) -> F64:
    """Mean square of the orthonormal Fourier modes (count // 2 + 1) of `flicker`; exact."""
    period = _period(count)
    covariance = np.fft.irfft(period / 2 * _variance(period), period)[:count]
    # Of pairs of samples at each distance, those before and behind falling on the same mode.
    pairs = covariance * (1 - np.arange(count) / count)
    pairs[1:] += pairs[:0:-1]
    power = np.fft.rfft(pairs).real
    power[0] = 0.0
    return np.asarray(power)


def _period(count: int) -> int:
    return 1 << (SPAN * count - 1).bit_length()


def _variance(period: int) -> F64:
    """Variance of the cosine and of the sine of each mode of a periodic line."""
    mode = np.arange(period // 2 + 1)
    variance = np.zeros(len(mode))
    variance[1:-1] = 1 / (np.log(2) * mode[1:-1])
    return variance
