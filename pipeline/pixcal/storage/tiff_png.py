"""Frames in TIFF and PNG files, read by Pillow: greyscale, one frame per page.

Such files have no FITS header. Exposure times are taken from ``headers.csv``
(`pixcal.storage.sources`), else from the EXIF tag ExposureTime.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import ExifTags, Image

from pixcal.model.errors import InputError
from pixcal.storage.frame_file import FrameFile, SampleFormat
from pixcal.storage.header_values import Header, exposure_s, temperature_c, time_stamp_mjd
from pixcal.storage.sources import SourceFile

# modes of Pillow that hold one sample a pixel, and how `unpack_picture` writes them
_CODINGS = {
    "L": SampleFormat(8),
    "I;16": SampleFormat(16, bzero=1 << 15),
    "I;16L": SampleFormat(16, bzero=1 << 15),
    "I;16B": SampleFormat(16, bzero=1 << 15),
    "I": SampleFormat(32),
    "F": SampleFormat(-32),
}

_PLANAR, _SEPARATE = 284, 2  # TIFF tag PlanarConfiguration, and its value for separate planes


def is_picture(start: bytes) -> bool:
    """Whether a file with this beginning is TIFF or PNG."""
    # PNG; TIFF and BigTIFF in both byte orders
    return start.startswith((b"\x89PNG\r\n\x1a\n", b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"))


def inspect_picture(source: SourceFile) -> FrameFile:
    """Frames of a TIFF or PNG file: one per page, all of one size."""
    with _opened(source.path) as picture:
        pages = getattr(picture, "n_frames", 1)
        kinds = set()
        for page in range(pages):
            picture.seek(page)
            kinds.add((picture.size, picture.mode))
        if len(kinds) > 1:
            raise InputError(
                f"{source.path}: pages of different sizes or types; a file holds frames of one "
                "size, so remove previews and thumbnails"
            )
        (((nx, ny), mode),) = kinds
        if mode not in _CODINGS:
            remedy = "record raw frames, without colour or palette"
            if getattr(picture, "tag_v2", {}).get(_PLANAR) == _SEPARATE:
                remedy = (
                    "tifffile writes a stack of 3 or 4 frames as planes of colours; write it again "
                    "with photometric='minisblack'"
                )
            raise InputError(
                f"{source.path}: samples of Pillow's mode {mode}; frames are greyscale of 8, 16 or "
                f"32 bits: {remedy}"
            )
        header = Header((key, content, "") for key, content in source.header)
        exif = _exposure_s(picture)
    listed = exposure_s((header,))
    return FrameFile(
        source,
        "picture",
        hdu=0,
        offset=0,
        shape=(pages, ny, nx),
        coding=_CODINGS[mode],
        mjd=time_stamp_mjd((header,)),
        exptime_s=exif if listed is None else listed,
        temperature_c=temperature_c((header,)),
    )


def unpack_picture(file: FrameFile, out: BinaryIO) -> None:
    """Write the pages of a file as the big-endian samples of a FITS cube."""
    with _opened(file.source.path) as picture:
        for page in range(file.shape[0]):
            picture.seek(page)
            samples = np.asarray(picture)
            if samples.shape != file.shape[1:]:
                raise InputError(f"{file.source.path}: changed while it was being read; run again")
            if file.coding.bzero:
                samples = (samples ^ np.uint16(file.coding.bzero)).view(np.int16)
            out.write(samples.astype(file.coding.stored.newbyteorder(">")).tobytes())


def picture_bytes(file: FrameFile) -> int:
    """Memory that `unpack_picture` takes: Pillow's page, and three copies of it."""
    return (4 << 20) + 4 * file.data_bytes // file.shape[0]


def _exposure_s(picture: Image.Image) -> float | None:
    exif = picture.getexif()
    tags = exif.get_ifd(ExifTags.IFD.Exif)
    value = tags.get(ExifTags.Base.ExposureTime, exif.get(ExifTags.Base.ExposureTime))
    try:
        return None if value is None else float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """A file opened by Pillow; errors of its decoders become one line."""
    try:
        with Image.open(path, formats=("TIFF", "PNG")) as picture:
            yield picture
    except InputError:
        raise
    except Exception as error:  # the decoders raise a dozen kinds, all of which mean one thing
        reason = " ".join(str(error).replace(os.fspath(path), "it").split())
        raise InputError(
            f"{path}: cannot be decoded ({reason or type(error).__name__}); copy it again, or "
            "remove it"
        ) from error
