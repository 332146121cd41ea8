"""Named flags of pixels, one bit each, as in the ``MASK`` extension of the products."""

from enum import IntFlag


class PixelFlag(IntFlag):
    """Why a pixel's offset is not given. Zero is a good pixel."""

    HOT = 1
    """Dark signal far above that of the other pixels."""
    DEAD = 2
    """Response far below (or above) that of the neighbours."""
    NOISY = 4
    """Noise in bias or dark frames far above the read noise; telegraph noise included."""
    SATURATED = 8
    """Saturated in more than two, and a thousandth, of its samples (which have no weight)."""
    NONLINEAR = 16
    """Departs from the straight line over a ladder of flats."""
    NO_DATA = 32
    """Samples are missing or not finite."""
    BAD_FIT = 64
    """The fringe model does not describe the pixel (chi-square, or no contrast)."""
