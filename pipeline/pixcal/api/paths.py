"""Files and folders as callers name them."""

from os import PathLike

StrPath = str | PathLike[str]
"""A path in any form; an opened `pixcal.Run` is one as well."""
