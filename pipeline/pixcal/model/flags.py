"""Named flags of pixels, one bit each, as in the ``MASK`` extension of the products."""

from enum import IntFlag


class PixelFlag(IntFlag):
    """Why a pixel's offset is not given. Zero is a good pixel."""

    HOT = 1  # dark signal far above that of the other pixels
    DEAD = 2  # response far below (or above) that of the neighbours
    NOISY = 4  # noise in bias or dark frames far above the read noise; telegraph noise included
    # saturated in more than two, and a thousandth, of its samples (which have no weight)
    SATURATED = 8
    NONLINEAR = 16  # departs from the straight line over a ladder of flats
    NO_DATA = 32  # samples are missing or not finite
    BAD_FIT = 64  # the fringe model does not describe the pixel (chi-square, or no contrast)
