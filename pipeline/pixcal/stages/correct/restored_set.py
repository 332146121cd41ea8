"""A reduced fringe set whose samples are read without some effects."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.fringe_fit.tile_fit import Coding
from pixcal.model.arrays import F32, U16
from pixcal.simulation.effect import Effect
from pixcal.stages.reduced_set import ReducedSet
from pixcal.storage.cube import ArrayReader

STRETCH = 1.25  # range of the codes over that of the set: undoing may take samples beyond it
FRAME_BYTES = 40  # arrays of a frame while effects are undone on it


@dataclass
class RestoredSet(ReducedSet):
    """A set as `ReducedSet`, its samples freed of effects as they are read.

    Parameters
    ----------
    folder : ``RUN/reduce/reduced.zarr/<set name>``
    effects : in the order in which they are undone
    calibration : ``calibration.zarr``: samples were divided by its flat, after its dark signal was
        taken off
    exptime_s : (t,) float32, of each frame
    """

    effects: tuple[Effect, ...]
    calibration: Path
    exptime_s: F32

    @property
    def halo(self) -> int:
        """Pixels around a tile that are read with it."""
        return sum(effect.undo_halo for effect in self.effects)

    @property
    def more_bytes(self) -> int:
        """As in `ReducedSet.more_bytes`: a block with its surroundings, and a frame at work."""
        cy, cx = self.signal.chunks[1:]
        around = (cy + 2 * self.halo) * (cx + 2 * self.halo) / (cy * cx)
        return int(around * (2 * 2 * self.block + FRAME_BYTES * (1 + len(self.effects))))

    @property
    def coding(self) -> Coding:
        """Electrons of the codes that are read."""
        stored = super().coding
        below = (STRETCH - 1) / 2 * stored.fill * stored.scale
        return Coding(stored.scale * STRETCH, stored.offset - below, stored.fill)

    @cached_property
    def _maps_of_charge(self) -> dict[str, ArrayReader]:
        return {name: ArrayReader(self.calibration / name) for name in ("flat", "dark_rate")}

    def codes(self, tile: tuple[int, int], block: int, *, keep: bool = False) -> U16:
        """Codes (t, y, x) of one block of frames of a tile, of `coding`."""
        if keep:
            self.signal.keep((block, *tile))
        part, halo = self.ranges(tile), self.halo
        sides = zip(part, self.shape, strict=True)
        around = [(max(0, a - halo), min(n, b + halo)) for (a, b), n in sides]
        first = block * self.block
        frames = (first, min(first + self.block, self.n_frames))
        codes = self.signal.read(frames, *around)
        both = zip(part, around, strict=True)
        inside = tuple(slice(a - start, b - start) for (a, b), (start, _) in both)
        flat, rate = (self._maps_of_charge[n].read(*around) for n in ("flat", "dark_rate"))
        out = np.empty((len(codes), *(b - a for a, b in part)), np.uint16)
        for n, frame in enumerate(codes):
            dark = rate * self.exptime_s[first + n]
            out[n] = self._restored(frame, flat, dark)[inside]
        return out

    def blocks(self, tile: tuple[int, int]) -> Iterator[U16]:
        """Codes of a tile, block after block."""
        for block in range(self.n_blocks):
            yield self.codes(tile, block)

    def _restored(self, codes: NDArray[Any], flat: F32, dark: F32) -> U16:
        """Codes (y, x) of `coding` of a frame, from the stored ones."""
        stored, new = super().coding, self.coding
        missing = codes == stored.fill
        charge = stored.electrons(codes) * flat + dark
        # What lies there is not known; to its neighbours it is like the frame.
        charge[missing] = charge[~missing].mean() if not missing.all() else 0.0
        frames = np.asarray(charge[None], np.float32)
        for effect in self.effects:
            undone = effect.undo_samples(frames)
            assert undone is not None
            frames = undone
        signal = (frames[0] - dark) / flat
        wanted = np.rint((signal - np.float32(new.offset)) / np.float32(new.scale))
        missing |= ~((wanted >= 0) & (wanted < new.fill))
        return np.where(missing, new.fill, wanted).astype(np.uint16)
