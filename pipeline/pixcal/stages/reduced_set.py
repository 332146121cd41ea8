"""One fringe set of ``RUN/reduce``, as input of the estimators."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pixcal.estimators.fringe_fit.tile_fit import Coding, Tile
from pixcal.model.arrays import F64, U8, U16
from pixcal.stages.tiles import STRIP, Index, Part, Strip, extent, grid, indices, map_chunk, strips
from pixcal.storage.cube_place import cubes_of
from pixcal.storage.cube_reader import ArrayReader, CachedReader
from pixcal.storage.place import Local, Place


@dataclass
class ReducedSet:
    """A reduced cube, ``RUN/reduce/reduced.zarr/<set name>``, and how its samples are weighted."""

    folder: Local

    @property
    def more_bytes(self) -> int:
        """Bytes per pixel, besides its codes, while `codes` and `blocks` read a block of frames."""
        return 0

    @cached_property
    def place(self) -> Place:
        """Where the set's arrays are: ``folder``, or elsewhere if reduce was asked to."""
        store = self.folder.parent
        return cubes_of(store.parent) / store.name / self.folder.name

    @cached_property
    def signal(self) -> CachedReader:
        """Stored codes (time, y, x)."""
        return CachedReader(self.place / "signal")

    @cached_property
    def _maps(self) -> dict[str, ArrayReader]:
        """Readers of the maps (y, x), opened once, because opening is slow at a URL."""
        names = ("read_variance", "shot_factor", "mask")
        return {name: ArrayReader(self.place / name) for name in names}

    @property
    def shape(self) -> tuple[int, int]:
        """(y, x) size of the window."""
        return self.signal.shape[1], self.signal.shape[2]

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self.signal.shape[0]

    @property
    def block(self) -> int:
        """Frames of a chunk."""
        return self.signal.chunks[0]

    @property
    def n_blocks(self) -> int:
        """Chunks along time."""
        return -(-self.n_frames // self.block)

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of tiles (columns of chunks)."""
        return grid(self.shape)

    def tiles(self) -> list[Index]:
        """Row and column of every tile, row by row."""
        return indices(self.shape)

    def strips(self) -> list[Strip]:
        """The same in groups: neighbours in a row whose maps share a chunk."""
        return strips(self.tiles(), STRIP)

    @property
    def map_chunks(self) -> tuple[int, int]:
        """Rows and columns of a chunk of maps (y, x)."""
        return map_chunk(self.shape)

    @property
    def coding(self) -> Coding:
        """Electrons of the stored codes."""
        attrs = self.signal.attrs
        return Coding(
            float(attrs["scale_factor"]), float(attrs["add_offset"]), int(attrs["_FillValue"])
        )

    def time_s(self) -> F64:
        """Time of each frame, s."""
        return ArrayReader(self.place / "time").read().astype(float)

    def ranges(self, tile: Index) -> Part:
        """((y0, y1), (x0, x1)) of a tile, given its row and column."""
        return extent(self.shape, tile)

    def tile(self, tile: Index) -> Tile:
        """Variance and good pixels of a tile."""
        y, x = self.ranges(tile)
        return Tile(
            y,
            x,
            self._maps["read_variance"].read(y, x).astype(np.float32),
            self._maps["shot_factor"].read(y, x).astype(np.float32),
            self.mask(tile) == 0,
        )

    def mask(self, tile: Index) -> U8:
        """Flags of a tile's pixels."""
        y, x = self.ranges(tile)
        return self._maps["mask"].read(y, x).astype(np.uint8)

    def codes(self, tile: Index, block: int, *, keep: bool = False) -> U16:
        """Codes (t, y, x) of one block of frames of a tile."""
        index = (block, *tile)
        chunk = self.signal.keep(index) if keep else self.signal.read_chunk(index)
        return self._inside(chunk, tile, block)

    def blocks(self, tile: Index) -> Iterator[U16]:
        """Codes of a tile, block after block; each is overwritten by the next."""
        # Fresh memory for every chunk would cost more than decoding it.
        buffer = np.empty(self.signal.chunks, self.signal.dtype)
        for block in range(self.n_blocks):
            yield self._inside(self.signal.read_chunk((block, *tile), buffer), tile, block)

    def _inside(self, chunk: U16, tile: Index, block: int) -> U16:
        """The part of a chunk inside the window and the run."""
        y, x = self.ranges(tile)
        n = min(self.block, self.n_frames - block * self.block)
        return np.ascontiguousarray(chunk[:n, : y[1] - y[0], : x[1] - x[0]])
