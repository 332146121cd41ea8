"""A folder in memory: arrays and files for use within one process.

A stage writes to it as to a folder on disk, so that frames in memory are processed like frames in
files. Its contents are neither compressed nor sealed.
"""

import errno
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class MemoryPath:
    """A file or folder in memory, which is freed with the last path to it."""

    at: str = ""
    _kept: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def __str__(self) -> str:
        return f"memory{self.at}"

    def __truediv__(self, name: str) -> "MemoryPath":
        return MemoryPath(f"{self.at}/{name}", self._kept)

    @property
    def name(self) -> str:
        """Last part of the path."""
        return self.at.rpartition("/")[2]

    @property
    def parent(self) -> "MemoryPath":
        """The folder it is in."""
        return MemoryPath(self.at.rpartition("/")[0], self._kept)

    def exists(self) -> bool:
        """Whether the file or array exists."""
        return self.at in self._kept

    def keep(self, content: Any) -> None:
        """Store a file (bytes) or an array."""
        self._kept[self.at] = content

    @property
    def array(self) -> "MemoryArray":
        """The array stored at this path."""
        stored = self._kept[self.at]
        assert isinstance(stored, MemoryArray)
        return stored

    def read_bytes(self) -> bytes:
        """Content of a file; FileNotFoundError if it does not exist."""
        content = self._kept.get(self.at)
        if not isinstance(content, bytes):
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self))
        return content

    def read_text(self, encoding: str) -> str:
        """Content of a file as text."""
        return self.read_bytes().decode(encoding)

    def open(self, _mode: str) -> BytesIO:
        """A file to be read."""
        return BytesIO(self.read_bytes())


class MemoryBuild:
    """Build of a stage in memory; as `pixcal.storage.artefact.Build`, without an artefact."""

    def __init__(self, folder: MemoryPath) -> None:
        self.folder = self.cubes = folder
        self.scratch = folder / "scratch"

    def journal(self) -> set[str]:
        """Nothing was done before."""
        return set()

    def note(self, step: str) -> None:
        """Nothing is resumed."""


@dataclass(frozen=True)
class MemoryArray:
    """An array in whole chunks, as in `pixcal.storage.cube`."""

    values: "NDArray[Any]"
    chunks: tuple[int, ...]
    fill_value: Any
    attrs: dict[str, Any]

    def write(self, start: Sequence[int], data: "NDArray[Any]") -> None:
        """Write a block."""
        self.values[tuple(slice(s, s + n) for s, n in zip(start, data.shape, strict=True))] = data

    def chunk(self, index: Sequence[int]) -> "NDArray[Any]":
        """A chunk, padded at the edges; not to be changed."""
        sides = zip(index, self.chunks, strict=True)
        part = self.values[tuple(slice(i * c, (i + 1) * c) for i, c in sides)]
        if part.shape == self.chunks:
            return part
        import numpy as np  # here: for a fast `pixcal --help`

        whole = np.full(self.chunks, self.fill_value, self.values.dtype)
        whole[tuple(map(slice, part.shape))] = part
        return whole
