"""A map of offsets with its errors, flags and header, and a picture as PNG."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pixcal.model.arrays import F32, U8, Mask
from pixcal.model.config import StrPath

if TYPE_CHECKING:
    from astropy.nddata import CCDData


@dataclass(frozen=True)
class Picture:
    """A figure as a PNG; a notebook shows it.

    Attributes
    ----------
    png : bytes
        Contents of a PNG file.
    """

    png: bytes = field(repr=False)

    def _repr_png_(self) -> bytes:
        # IPython calls this method.
        return self.png

    def save(self, path: StrPath) -> Path:
        """Write the picture to a file, whose name should end in ``.png``."""
        file = Path(path)
        file.write_bytes(self.png)
        return file


@dataclass(frozen=True)
class OffsetMap:
    """A map of offsets: the contents of the product of the same name.

    Attributes
    ----------
    name : str
        ``delta_x``, ``delta_y`` or ``delta_fringe``.
    delta, sigma : (y, x) float32
        Offset from the perfect grid and its 1-sigma error, px; NaN where masked. Positive: the
        pixel responds at larger x (y).
    mask : (y, x) uint8
        Bits of `pixcal.PixelFlag`; 0 is a good pixel.
    header : dict
        Primary header of the FITS file: fringe vectors, frames, the modes that were removed.
    """

    name: str
    delta: F32 = field(repr=False)
    sigma: F32 = field(repr=False)
    mask: U8 = field(repr=False)
    header: dict[str, Any] = field(repr=False)

    @property
    def good(self) -> Mask:
        """(y, x): pixels that have an offset."""
        return np.equal(self.mask, 0)

    def ccddata(self) -> "CCDData":
        """The map as astropy's ``CCDData``: with its errors, mask, flags and header."""
        from astropy.nddata import CCDData, StdDevUncertainty  # here: slow to import

        return CCDData(
            self.delta,
            unit="pixel",
            uncertainty=StdDevUncertainty(self.sigma),
            mask=~self.good,
            flags=self.mask,
            meta=dict(self.header),
        )

    def picture(self) -> Picture:
        """The map with the means of its columns and rows, as the report shows it."""
        # Here: matplotlib takes longer to import than all else.
        from pixcal.report.drawing import png
        from pixcal.report.map_figures import offsets
        from pixcal.report.map_summary import ArraySource, summarise

        delta, sigma = (summarise(ArraySource(values)) for values in (self.delta, self.sigma))
        return Picture(png(offsets(self.name, delta, sigma)))
