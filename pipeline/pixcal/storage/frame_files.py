"""What a file of frames holds, whatever its format: FITS, TIFF or PNG."""

from pixcal.model.errors import InputError
from pixcal.storage import fits_in
from pixcal.storage.fits_in import FrameFile
from pixcal.storage.header_table import NAME
from pixcal.storage.pictures import inspect_picture, is_picture
from pixcal.storage.sources import SourceFile


def inspect(source: SourceFile) -> FrameFile:
    """Read what a file says of its frames, and hold it against the file's length.

    Raises
    ------
    InputError
        Naming the file: of no format that is known, damaged, or of frames that cannot be used.
    """
    with source.open() as handle:
        start = handle.read(8)
    if is_picture(start):
        return inspect_picture(source)
    if source.header:
        raise InputError(
            f"{source.path}: {NAME} names it, but FITS files have headers of their own; remove it "
            f"from {NAME}"
        )
    return fits_in.inspect(source)
