"""Polynomials fitted around each value of a line: the filter of Savitzky and Golay.

As that of scipy.signal, which takes seconds to import on a first run.
"""

import numpy as np
from scipy.linalg import lstsq
from scipy.ndimage import convolve1d

from pixcal.model.arrays import F64


def middle_weights(half: int, order: int) -> F64:
    """Weights (2 half + 1,) of values in a polynomial that is fitted to them, at its middle."""
    place = np.arange(half, -half - 1, -1.0)
    powers = place ** np.arange(order + 1)[:, None]
    return np.asarray(lstsq(powers, np.eye(order + 1)[0], cond=1e-14)[0])


def local_fit(values: F64, half: int, order: int) -> F64:
    """Each of the values (n,) by a polynomial fitted to it and ``half`` on either side.

    At the ends it is the last polynomial that has all its values.
    """
    fit = convolve1d(values, middle_weights(half, order), mode="constant")
    length = 2 * half + 1
    place = np.arange(length)
    fit[:half] = np.polyval(np.polyfit(place, values[:length], order), place[:half])
    fit[-half:] = np.polyval(np.polyfit(place, values[-length:], order), place[-half:])
    return np.asarray(fit)
