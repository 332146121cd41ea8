"""Two sides along one direction, read tile by tile: first the sums, then the pixels."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.arrays import F64, I64
from pixcal.stages.compare.agreement import Grouping, Part, Projection, double, halve
from pixcal.stages.compare.sides import Side, Vector
from pixcal.stages.tiles import Part as Tile
from pixcal.stages.tiles import spans

COARSE = 256  # most blocks along the longer side that are kept in memory
SHOWN_BLOCKS = 16  # blocks along the longer side of the map of differences, or up to twice as many
MIN_BLOCK = 4  # least side of its blocks, px
DISAGREE = 5.0  # sigma above which a pixel is listed
LISTED = 1000  # most pixels of a tile that are listed
PULLS = np.linspace(-50, 50, 2001)  # edges of the histogram of differences over their errors
PICTURE = 96  # bins per side of the histogram of one map against the other
REACH = 4.5  # half width of that histogram, in rms of the maps


@dataclass(frozen=True)
class Pair:
    """Two sides along one direction."""

    first: Side  # first, second: of the same window
    second: Side
    name: str  # `delta_x`, `delta_y` or `delta_fringe`
    direction: Vector  # unit vector (x, y)

    @property
    def window(self) -> tuple[int, int]:
        """(y, x), px."""
        return self.first.window

    @property
    def levels(self) -> int:
        """Number of doublings of the block side, up to a quarter of the window's shorter side."""
        return max(0, int(np.log2(max(1.0, min(self.window) / 4))))

    @property
    def coarse(self) -> int:
        """Number of doublings of the block side inside a tile; these blocks stay in memory."""
        most = int(np.log2(min(self.tile_side)))
        return min(most, max(0, int(np.ceil(np.log2(max(self.window) / COARSE)))))

    @property
    def shown(self) -> int:
        """Side of the blocks of the map of differences, px: a power of two."""
        return max(_power_of_two(max(self.window) / SHOWN_BLOCKS), MIN_BLOCK, 1 << self.coarse)

    @property
    def tile_side(self) -> tuple[int, int]:
        """A chunk of the first side, cut to a power of two so that blocks do not cross tiles."""
        cy, cx = self.first.chunk
        return _power_of_two(cy), _power_of_two(cx)

    def tiles(self) -> list[Tile]:
        """The window in tiles, row by row."""
        rows, columns = map(spans, self.window, self.tile_side)
        return list(product(rows, columns))

    def together(self, pieces: Sequence[F64]) -> F64:
        """Pieces (..., y, x) of all tiles, joined."""
        columns = -(-self.window[1] // self.tile_side[1])
        rows = range(0, len(pieces), columns)
        return np.block([list(pieces[n : n + columns]) for n in rows])

    def read(self, tile: Tile) -> F64:
        """Sums over blocks of one pixel (k + 3, y, x); zero if either side has no offset."""
        sides = [side.read(tile, self.direction) for side in (self.first, self.second)]
        maps, variances = (np.stack([side[n] for side in sides]) for n in (0, 1))
        good = np.isfinite(maps).all(axis=0) & (variances > 0).all(axis=0)
        modes = [side[2] for side in sides]
        sums = np.concatenate([maps, *modes, variances, np.ones((1, *good.shape))])
        return np.where(good, sums, 0.0)

    def plan(self, runtime: Runtime) -> Runtime:
        """As many workers as the memory allows."""
        k = 2 + sum(
            len(s.shape.names) + 4
            for side in (self.first, self.second)
            for s in side.sets_along(self.direction)
        )
        sets = (*self.first.sets, *self.second.sets)
        batches = max(len(s.batches or ()) for s in sets)
        # Modes and their sums over blocks; maps of each set; batches as read and as used.
        task = int(np.prod(self.tile_side)) * (8 * (4 * k + 12 * len(sets)) + 40 * batches)
        blocks = np.prod([-(-n // 2**self.coarse) for n in self.window])
        held = int(8 * (k + 4) * (3 * blocks + 2 * sum(self.window)))
        return within_memory(f"the comparison of {self.name}", task, held, runtime)


def _power_of_two(value: float) -> int:
    """Largest power of two up to a value; at least 1."""
    return 1 << max(0, int(np.log2(value)))


def pulls(projection: Projection, sums: F64) -> F64:
    """Difference of the maps without modes, over its error (y, x); NaN without data."""
    *_, difference = projection.difference(sums[:-3])
    variance = np.where(sums[-1] > 0, sums[-3] + sums[-2], np.nan)
    return np.asarray(difference / np.sqrt(variance))


@dataclass(frozen=True)
class PairSums:
    """Sums of one pass over both sides."""

    fine: list[Grouping]  # blocks of 1, 2, 4, ... pixels, up to the coarse ones
    coarse: F64  # (k + 3, y, x) of the whole window
    profiles: dict[str, F64]  # (k + 3, n) of the `columns` and of the `rows`
    levels: int  # total number of doublings of the block side

    @property
    def pixels(self) -> int:
        """Good pixels."""
        return self.fine[0].groups

    @cached_property
    def projection(self) -> Projection:
        """The modes, fitted to all good pixels."""
        return Projection.of(self.fine[0])

    @cached_property
    def whole(self) -> Grouping:
        """All pixels as one group."""
        return Grouping.of(self.coarse.sum(axis=(1, 2))[:, None])

    def scales(self) -> list[tuple[int, Part]]:
        """Block side (px) and the maps at that scale; the last holds all larger scales."""
        further, _ = double(self.coarse, max(0, self.levels + 1 - len(self.fine)))
        groupings = [*self.fine, *further[1:]][: self.levels + 1]
        parts = [self.part(*both) for both in pairwise([*groupings, self.whole])]
        return [(1 << level, part) for level, part in enumerate(parts)]

    def part(self, fine: Grouping, coarse: Grouping) -> Part:
        """The maps between two scales."""
        return self.projection.part(fine, coarse, self.pixels)

    def total(self) -> Part:
        """The maps at all scales."""
        return self.part(self.fine[0], self.whole)

    def differences(self, sums: F64) -> tuple[F64, F64]:
        """Mean difference, second minus first, of each block, and its error, px; NaN if empty."""
        *_, difference = self.projection.difference(sums[:-3])
        count = np.where(sums[-1] > 0, sums[-1], np.nan)
        return difference / count, np.sqrt(sums[-3] + sums[-2]) / count


def read_sums(
    pair: Pair, runtime: Runtime, keep: tuple[Projection, float] | None = None
) -> PairSums:
    """Read both sides once, without pixels whose difference, modes removed, exceeds ``keep``."""
    task = partial(_sums_task, pair, keep)
    results = run_tasks(task, pair.tiles(), runtime, label=f"sums {pair.name}")
    groupings, *pieces = zip(*results, strict=True)
    fine = [
        Grouping(sum(groups), np.sum(products, axis=0), np.sum(noise, axis=0))
        for groups, products, noise in (zip(*level) for level in zip(*groupings))  # noqa: B905
    ]
    coarse, columns, rows = (pair.together(p) for p in pieces)
    profiles = {"columns": columns.sum(axis=1), "rows": rows.sum(axis=2)}
    return PairSums(fine, coarse, profiles, pair.levels)


def _sums_task(
    pair: Pair, keep: tuple[Projection, float] | None, tile: Tile
) -> tuple[list[Grouping], F64, F64, F64]:
    pixels = pair.read(tile)
    if keep is not None:
        projection, limit = keep
        pixels = np.where(np.abs(pulls(projection, pixels)) <= limit, pixels, 0.0)
    columns, rows = pixels.sum(axis=1, keepdims=True), pixels.sum(axis=2, keepdims=True)
    return *double(pixels, pair.coarse), columns, rows


class Pixels(NamedTuple):
    """The pixels one by one."""

    pulls: I64  # (bin,) histogram of differences over their errors, `PULLS`
    picture: I64  # (bin, bin) second map (y) against the first (x), within `reach`
    far: list[tuple[int, int, float, float]]  # y, x, difference, error of pixels beyond `DISAGREE`
    beyond: int  # number of these; the farthest of each tile are listed
    # (2, y, x) sum of squared pulls and number of pixels of each coarse block, without those beyond
    squares: F64
    reach: float  # px

    @property
    def spread(self) -> float:
        """Robust standard deviation of the pulls: 1 for noise alone."""
        total = np.concatenate([[0], np.cumsum(self.pulls)]) / max(1, int(self.pulls.sum()))
        low, high = np.interp(ndtr([-1, 1]), total, PULLS)
        return float((high - low) / 2)


def read_pixels(pair: Pair, sums: PairSums, runtime: Runtime) -> Pixels:
    """Read both sides again, with the modes known."""
    total = sums.total()
    reach = REACH * (max(total.first, total.second) / max(total.pixels, 1)) ** 0.5 or 1.0
    task = partial(_pixels_task, pair, sums.projection, reach)
    pieces = run_tasks(task, pair.tiles(), runtime, label=f"pixels {pair.name}")
    histograms, pictures, listed, beyond, squares, _ = zip(*pieces, strict=True)
    far = sorted((f for some in listed for f in some), key=lambda f: -abs(f[2] / f[3]))
    return Pixels(sum(histograms), sum(pictures), far, sum(beyond), pair.together(squares), reach)


def _pixels_task(pair: Pair, projection: Projection, reach: float, tile: Tile) -> Pixels:
    sums = pair.read(tile)
    first, second, difference = projection.difference(sums[:-3])
    error, z = np.sqrt(sums[-3] + sums[-2]), pulls(projection, sums)
    good = sums[-1] > 0
    edges = np.linspace(-reach, reach, PICTURE + 1)
    picture, _, _ = np.histogram2d(second[good], first[good], (edges, edges))
    far = np.abs(z) > DISAGREE
    (y0, _), (x0, _) = tile
    listed = [
        (y0 + int(y), x0 + int(x), float(difference[y, x]), float(error[y, x]))
        for y, x in sorted(np.argwhere(far).tolist(), key=lambda at: -abs(z[*at]))[:LISTED]
    ]
    squares = np.where(good & ~far, [z**2, np.ones_like(z)], 0.0)
    for _ in range(pair.coarse):
        squares = halve(squares)
    histogram = np.histogram(np.clip(z[good], PULLS[0], PULLS[-1]), PULLS)[0]
    return Pixels(histogram, picture.astype(int), listed, int(far.sum()), squares, reach)
