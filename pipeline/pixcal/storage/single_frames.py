"""Frames of one file, one after the other, with its header."""

import tempfile
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pixcal.storage.frame_decoding import read_rows, unpack
from pixcal.storage.frame_file import FrameFile
from pixcal.storage.frames import inspect
from pixcal.storage.sources import SourceFile, reading

# Keywords that astropy sets itself, or that are not true of a calibrated frame.
_OF_SAMPLES = ("BSCALE", "BZERO", "BLANK", "BUNIT", "CHECKSUM", "DATASUM", "DATAMIN", "DATAMAX")


@dataclass(frozen=True)
class FramesOfFile:
    """The frames of a file; samples are read when they are asked for."""

    file: FrameFile

    @classmethod
    def open(cls, path: Path) -> "FramesOfFile":
        """A FITS, TIFF or PNG file; InputError if it cannot be read."""
        with reading(path):
            facts = path.stat()
        return cls(inspect(SourceFile(path, path.name, facts.st_size, facts.st_mtime_ns)))

    def frames(self) -> Iterator[NDArray[Any]]:
        """Samples (y, x) of each frame, ADU."""
        with tempfile.TemporaryDirectory() as folder:
            file = self.file
            if file.container != "plain":
                file = unpack(file, Path(folder) / "samples")
            for plane in range(file.shape[0]):
                out: NDArray[Any] = np.empty((1, *file.shape[1:]), file.coding.dtype)
                read_rows(file, [plane], (0, file.shape[1]), out, crc_alone=True)
                yield out[0]

    def header(self) -> fits.Header:
        """What the file says besides its samples; empty for TIFF and PNG."""
        kept = fits.Header()
        if self.file.container == "picture":
            return kept
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            header = fits.getheader(self.file.source.path, self.file.hdu)
            header.strip()
            for card in header.cards:
                # Cameras write cards that FITS does not allow; some cannot be mended.
                with suppress(fits.VerifyError, ValueError):
                    card.verify("silentfix")
                    if card.keyword not in _OF_SAMPLES:
                        kept.append(fits.Card(card.keyword, card.value, card.comment))
        return kept
