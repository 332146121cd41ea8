"""A swept fringe set, and the effects to correct on its maps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.fringe_fit.tile_fit import Coding
from pixcal.estimators.fringe_fit.tile_sums import Carrier
from pixcal.estimators.maps.corrected import phase_change
from pixcal.kernels.crosstalk import FILL_REACH, filled
from pixcal.model.arrays import F32, F64, U8, U16, Mask
from pixcal.model.errors import InputError
from pixcal.model.flags import PixelFlag
from pixcal.simulation.effect import Effect, FringeMaps
from pixcal.simulation.fringe_maps import FittedFrames
from pixcal.stages.diagnose.fitted_set import corrected_on_samples
from pixcal.stages.evidence import fitted_theta
from pixcal.stages.reduced_set import ReducedSet
from pixcal.stages.tiles import Part
from pixcal.stages.treatment import Treatment
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.manifest import read_json

HALVES = 2  # parts of the frames that are corrected separately
BEYOND = 8  # pixels assumed to exist beyond an open side
# flags of pixels whose fit does not give their light
UNKNOWN = int(PixelFlag.SATURATED | PixelFlag.NO_DATA)

# top, bottom, left and right of the window, rows counted from the top
Sides = tuple[bool, bool, bool, bool]
CLOSED: Sides = (False, False, False, False)
STRETCH = 1.25  # range of the codes over that of the set, which corrected samples may exceed
FRAME_BYTES = 40  # arrays of a frame while effects are undone on it


@dataclass(frozen=True)
class Swept:
    """A swept fringe set, and the effects to correct on its maps."""

    folder: Path  # `sweep.zarr/<set name>`
    source: ReducedSet  # for the tiles
    treatments: tuple[Treatment, ...]  # in order of correction
    k: tuple[float, float]  # fringe vector at the centre, rad/px
    flat: Path | None  # map by which samples were divided
    read_noise: float  # e-
    # effects corrected on samples, as if the detector ended with the window
    samples: tuple[Effect, ...] = ()
    raw: Path | None = None  # the sweep before this correction
    exptime_s: float = 0.0
    # sides at which the detector extends beyond the window: top, bottom, left, right
    open_sides: Sides = CLOSED

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects to correct, in order."""
        return tuple(t.effect for t in self.treatments)

    @property
    def n_batches(self) -> int:
        """Batches of the sweep."""
        return int(ArrayReader(self.folder / "batch_count").shape[0])

    @property
    def has_halves(self) -> bool:
        """Whether there are batches in both halves of the frames."""
        counts = ArrayReader(self.folder / "batch_count").read()
        middle = len(counts) // 2
        return bool(counts[:middle].any() and counts[middle:].any())

    @property
    def carrier(self) -> Carrier:
        """Carrier of the phases."""
        facts = read_json(self.folder / "scout.json")
        return Carrier(tuple(facts["k"]), tuple(facts["reference"]))

    @cached_property
    def frames(self) -> FittedFrames:
        """The frames that were fitted."""
        g, dk, time = (ArrayReader(self.folder / name).read() for name in ("g", "dk", "time"))
        period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        rows, free = (0, self.source.shape[0]), bool(np.any(dk))
        return FittedFrames(g, rows, self.read_noise, self.exptime_s, period, free)

    @property
    def halo(self) -> int:
        """Pixels around a tile that are read with it."""
        return FILL_REACH + sum(effect.undo_halo for effect in (*self.effects, *self.samples))

    def around(self, y: tuple[int, int], x: tuple[int, int]) -> Part:
        """A tile with its halo, which extends beyond the window at open sides only."""
        ny, nx = self.source.shape
        top, bottom, left, right = (BEYOND * is_open for is_open in self.open_sides)
        rows = (max(-top, y[0] - self.halo), min(ny + bottom, y[1] + self.halo))
        return rows, (max(-left, x[0] - self.halo), min(nx + right, x[1] + self.halo))

    def within(self, part: Part) -> Part:
        """The overlap of a part with the window."""
        (y0, y1), (x0, x1) = part
        ny, nx = self.source.shape
        return (max(0, y0), min(ny, y1)), (max(0, x0), min(nx, x1))

    def inside(self, y: tuple[int, int], x: tuple[int, int]) -> tuple[slice, slice]:
        """Position of a tile in its surroundings."""
        rows, columns = self.around(y, x)
        return slice(y[0] - rows[0], y[1] - rows[0]), slice(x[0] - columns[0], x[1] - columns[0])


def usable(theta: F64, mask: U8) -> Mask:
    """Pixels (y, x) with a usable fitted signal, even if flagged."""
    return np.asarray(np.isfinite(theta).all(axis=0) & (mask & UNKNOWN == 0))


def maps_of(swept: Swept, part: Part) -> tuple[FringeMaps, Mask, Mask]:
    """Maps of a part, unknown pixels interpolated; pixels with an offset, and with known light."""
    there = swept.within(part)
    theta = fitted_theta(swept.folder, there, swept.carrier.reference)
    mask = ArrayReader(swept.folder / "mask").read(*there)
    known = usable(theta, mask)
    good = known & (mask == 0)
    theta[:, ~known] = np.nan
    theta = filled(padded(theta, swept, part), swept.k)
    flat = None
    if swept.flat is not None:
        flat = padded(ArrayReader(swept.flat).read(*there).astype(float), swept, part, 1.0)
    origin = part[0][0], part[1][0]
    maps = FringeMaps(theta, swept.k, origin, flat, swept.folder.name, swept.frames)
    return maps, padded(good, swept, part, False), padded(known, swept, part, False)


def without_sample_effects(swept: Swept, part: Part) -> tuple[FringeMaps, Mask]:
    """Maps of a part as fitted without effects on samples; pixels (y, x) with an offset."""
    maps, good, _ = maps_of(replace(swept, folder=swept.raw or swept.folder), part)
    for effect in swept.samples:
        maps = corrected_on_samples(effect, maps) or maps
    return maps, good


def border_change(swept: Swept, part: Part) -> F64:
    """Change (y, x) of the phase by charge from beyond open sides, rad."""
    there = swept.within(part)
    if there == part or not any(effect.undo_halo for effect in swept.samples):
        return np.zeros([b - a for a, b in part])
    y0, x0 = (t[0] - p[0] for t, p in zip(there, part, strict=True))
    closed = without_sample_effects(replace(swept, open_sides=CLOSED), there)[0].theta
    at = np.s_[:, y0 : y0 + closed.shape[1], x0 : x0 + closed.shape[2]]
    change = phase_change(closed, without_sample_effects(swept, part)[0].theta[at])
    return np.asarray(padded(change, swept, part, 0.0))


def padded(values: NDArray[Any], swept: Swept, part: Part, fill: float = np.nan) -> NDArray[Any]:
    """Values (..., y, x) of a part, given those within the window; the rest is filled."""
    pads = [(0, 0)] * (values.ndim - 2)
    pads += [(t[0] - p[0], p[1] - t[1]) for p, t in zip(part, swept.within(part), strict=True)]
    return np.pad(values, pads, constant_values=fill)


def corrected(maps: FringeMaps, effects: Sequence[Effect]) -> tuple[FringeMaps, list[F64]]:
    """Maps corrected for effects, and the change (y, x) of the phase by each, rad."""
    # Refuse an effect that does not return finite maps of the same pixels.
    steps = []
    for effect in effects:
        after = effect.undo(maps)
        theta = after.theta if isinstance(after, FringeMaps) else np.empty(0)
        if after is None or theta.shape != maps.theta.shape or not np.isfinite(theta).all():
            raise InputError(
                f"effect {effect.name!r}: undo does not return finite maps of the same shape; "
                "fix its file"
            )
        steps.append(phase_change(maps.theta, after.theta))
        maps = after
    return maps, steps


@dataclass
class RestoredSet(ReducedSet):
    """A `ReducedSet` whose samples are corrected for ``effects``, in order, when read.

    ``folder``: ``RUN/reduce/reduced.zarr/<set name>``. ``calibration``: source of the flat and dark
    that were applied to samples. ``exptime_s``: (t,).
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
        """As in `ReducedSet.more_bytes`: a block with its surroundings, and a frame in progress."""
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
        """Codes (t, y, x), in `coding`, of one block of frames in a tile."""
        if keep:
            self.signal.keep((block, *tile))
        part, halo = self.ranges(tile), self.halo
        sides = zip(part, self.shape, strict=True)
        around = [(max(0, a - halo), min(n, b + halo)) for (a, b), n in sides]
        first = block * self.block
        codes = self.signal.read((first, min(first + self.block, self.n_frames)), *around)
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
        # Missing samples act on their neighbours like the mean of the frame.
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
