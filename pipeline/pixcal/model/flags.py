"""Named flags of pixels, one bit each, as in the ``MASK`` extension of the products."""

from enum import IntFlag


class PixelFlag(IntFlag):
    """Reasons why a pixel has no offset; zero is a good pixel.

    Masks are uint8: one bit, 128, is left.
    """

    HOT = 1
    DEAD = 2
    NOISY = 4
    SATURATED = 8
    NONLINEAR = 16
    NO_DATA = 32
    BAD_FIT = 64

    @property
    def words(self) -> str:
        """The name as words."""
        return (self.name or "").lower().replace("_", " ")

    @property
    def meaning(self) -> str:
        """Description of a pixel with this flag."""
        return _MEANINGS[self.value]


_MEANINGS = {
    1: "dark signal far above that of the other pixels",
    2: "response far below (or above) that of the neighbours",
    4: "noise in bias or dark frames far above the read noise; telegraph noise included",
    8: "more than two samples, and more than one in a thousand, are saturated, or the flats are",
    16: "deviates from a straight line over the exposure-time steps",
    32: "samples are missing or not finite",
    64: "the fringe model does not describe the pixel (chi-square, or no contrast)",
}
