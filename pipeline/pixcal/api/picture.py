"""A figure of the report, for a notebook."""

from dataclasses import dataclass, field
from pathlib import Path

from pixcal.model.config import StrPath


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
        # The name by which IPython asks.
        return self.png

    def save(self, path: StrPath) -> Path:
        """Write the picture to a file, whose name should end in ``.png``."""
        file = Path(path)
        file.write_bytes(self.png)
        return file
