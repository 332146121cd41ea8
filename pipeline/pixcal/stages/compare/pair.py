"""Two sides along one direction, read tile by tile: the sums, then the pixels."""

from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.stages.compare.agreement import Blocks, Grouping, Part, Projection, halve, part
from pixcal.stages.compare.sides import Side, SideTile, Tile, Vector

F64 = NDArray[np.float64]

COARSE = 256  # most blocks along the longer side that are kept in memory
SHOWN_BLOCKS = 16  # blocks along the longer side of the map of differences, or up to twice as many
LEAST_BLOCK = 4  # least side of its blocks, px
DISAGREE = 5.0  # sigma beyond which a pixel is listed
LISTED = 1000  # most pixels of a tile that are listed
PULLS = np.linspace(-50, 50, 2001)  # edges of the histogram of differences over their errors
PICTURE = 96  # bins a side of the histogram of one map against the other
REACH = 4.5  # its half width, in rms of the maps


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
        """Times that blocks are doubled, up to a quarter of the window's shorter side."""
        return max(0, int(np.log2(max(1.0, min(self.window) / 4))))

    @property
    def coarse(self) -> int:
        """Times that blocks are doubled inside a tile; a block of it is kept in memory."""
        most = int(np.log2(_power_of_two(min(self.first.chunk))))
        return min(most, max(0, int(np.ceil(np.log2(max(self.window) / COARSE)))))

    @property
    def shown(self) -> int:
        """Side of the blocks of the map of differences, px: a power of two."""
        side = _power_of_two(max(self.window) / SHOWN_BLOCKS)
        return max(side, LEAST_BLOCK, 1 << self.coarse)

    def tiles(self) -> list[Tile]:
        """The window cut along the chunks of the first side."""
        rows, columns = (
            [(a, min(a + step, n)) for a in range(0, n, step)]
            for n, step in zip(self.window, self.tile_side, strict=True)
        )
        return list(product(rows, columns))

    @property
    def tile_side(self) -> tuple[int, int]:
        """A chunk of the first side, cut to a power of two so that blocks do not cross tiles."""
        cy, cx = self.first.chunk
        return _power_of_two(cy), _power_of_two(cx)

    def read(self, tile: Tile) -> tuple[SideTile, SideTile]:
        """Both sides of a tile."""
        return self.first.read(tile, self.direction), self.second.read(tile, self.direction)

    def plan(self, runtime: Runtime) -> Runtime:
        """As many workers as the memory allows."""
        k = 2 + sum(
            len(s.shape.names) + 4
            for side in (self.first, self.second)
            for s in side.sets_along(self.direction)
        )
        maps = sum(len(side.sets) for side in (self.first, self.second))
        batches = max(_batches(self.first), _batches(self.second))
        pixels = int(np.prod(self.tile_side))
        # The modes and their sums over blocks; each set's maps; its batches as read and as used.
        task = pixels * (8 * (4 * k + 12 * maps) + 40 * batches)
        blocks = np.prod([-(-n // 2**self.coarse) for n in self.window])
        held = int(8 * (k + 4) * (3 * blocks + 2 * sum(self.window)))
        plan = make_plan(f"the comparison of {self.name}", task, held, runtime)
        return runtime.with_workers(plan.workers)


def _power_of_two(value: float) -> int:
    """The largest up to a value; 1 at least."""
    return 1 << max(0, int(np.log2(value)))


def _batches(side: Side) -> int:
    return max(len(s.batches or ()) for s in side.sets)


@dataclass(frozen=True)
class Outlying:
    """Which pixels to leave out: those whose difference is far off."""

    projection: Projection
    limit: float  # of the difference over its error

    def keep(self, values: F64, variance: F64) -> NDArray[np.bool_]:
        """Pixels to keep, from maps and modes (k, y, x) and the difference's variance."""
        return np.abs(pull(self.projection, values, variance)) <= self.limit


def pull(projection: Projection, values: F64, variance: F64) -> F64:
    """Difference of the maps, less their modes, over its error; NaN where there is none."""
    first, second = projection.residual(values)
    good = variance > 0
    return np.where(good, (second - first) / np.sqrt(np.where(good, variance, 1.0)), np.nan)


def _values(pair: Pair, tile: Tile) -> tuple[F64, F64]:
    """Maps and modes (k, y, x), and the variances (2, y, x); NaN where either side has none."""
    one, two = pair.read(tile)
    values = np.concatenate([one.delta[None], two.delta[None], one.modes, two.modes])
    noise = np.stack([one.variance, two.variance])
    lacking = ~(np.isfinite(values[:2]).all(axis=0) & (noise > 0).all(axis=0))
    noise[:, lacking] = np.nan
    return values, noise


@dataclass(frozen=True)
class PairSums:
    """Sums of one pass over both sides."""

    fine: tuple[Grouping, ...]  # blocks of 1, 2, 4, ... pixels, up to the coarse ones
    coarse: Blocks  # of the whole window
    columns: Blocks  # columns, rows: of one column or row each
    rows: Blocks
    levels: int  # times that blocks are doubled in all

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
        return self.coarse.along(1).along(2).grouping()

    def scales(self) -> list[tuple[int, Part]]:
        """Block side (px) and the maps at that scale; the last holds all larger scales."""
        groupings = list(self.fine[: self.levels + 1])
        blocks = self.coarse
        while len(groupings) <= self.levels:
            blocks = blocks.coarser()
            groupings.append(blocks.grouping())
        pairs = zip(groupings, [*groupings[1:], self.whole], strict=True)
        return [
            (1 << level, part(fine, coarse, self.projection, self.pixels))
            for level, (fine, coarse) in enumerate(pairs)
        ]

    def total(self) -> Part:
        """The maps at all scales."""
        return part(self.fine[0], self.whole, self.projection, self.pixels)

    def of_means(self, blocks: Blocks) -> Part:
        """The maps of the means of columns or rows."""
        return part(blocks.grouping(), self.whole, self.projection, self.pixels)

    def differences(self, blocks: Blocks) -> tuple[F64, F64]:
        """Mean difference, second less first, of each block and its error, px; NaN where empty."""
        first, second = self.projection.residual(blocks.values)
        there = blocks.count > 0
        count = np.where(there, blocks.count, np.nan)
        return (second - first) / count, np.sqrt(blocks.noise.sum(axis=0)) / count


def read_sums(pair: Pair, outlying: Outlying | None, runtime: Runtime) -> PairSums:
    """Read both sides once.

    Parameters
    ----------
    outlying : Outlying or None
        Pixels to leave out.
    """
    tiles = pair.tiles()
    results = run_tasks(
        partial(_sums_task, pair, outlying), tiles, runtime, label=f"sums {pair.name}"
    )
    fine = results[0][0]
    for more, _, _, _ in results[1:]:
        fine = tuple(a + b for a, b in zip(fine, more, strict=True))
    ny, nx = pair.window
    side = 1 << pair.coarse
    k = len(results[0][1].values)
    coarse = _empty(k, -(-ny // side), -(-nx // side))
    columns, rows = _empty(k, 1, nx), _empty(k, ny, 1)
    for ((y0, y1), (x0, x1)), (_, blocks, down, across) in zip(tiles, results, strict=True):
        at = np.s_[y0 // side : -(-y1 // side), x0 // side : -(-x1 // side)]
        for whole, piece, place in (
            (coarse, blocks, at),
            (columns, down, np.s_[:, x0:x1]),
            (rows, across, np.s_[y0:y1, :]),
        ):
            whole.values[:, *place] += piece.values
            whole.noise[:, *place] += piece.noise
            whole.count[place] += piece.count
    return PairSums(fine, coarse, columns, rows, pair.levels)


def _empty(k: int, ny: int, nx: int) -> Blocks:
    return Blocks(np.zeros((k, ny, nx)), np.zeros((2, ny, nx)), np.zeros((ny, nx)))


def _sums_task(
    pair: Pair, outlying: Outlying | None, tile: Tile
) -> tuple[tuple[Grouping, ...], Blocks, Blocks, Blocks]:
    values, noise = _values(pair, tile)
    good = np.isfinite(noise).all(axis=0)
    if outlying is not None:
        good &= outlying.keep(values, noise.sum(axis=0))
    pixels = Blocks(
        np.where(good, values, 0.0), np.where(good, noise, 0.0), np.asarray(good, float)
    )
    blocks, groupings = pixels, [pixels.grouping()]
    for _ in range(pair.coarse):
        blocks = blocks.coarser()
        groupings.append(blocks.grouping())
    return tuple(groupings), blocks, pixels.along(1), pixels.along(2)


@dataclass(frozen=True)
class Pixels:
    """The pixels one by one."""

    pulls: NDArray[np.int64]  # (bin,) histogram of differences over their errors, `PULLS`
    picture: NDArray[np.int64]  # (bin, bin) second map (y) against the first (x), within `reach`
    reach: float  # px
    far: tuple[tuple[int, int, float, float], ...]  # pixels beyond `DISAGREE`, farthest first
    beyond: int  # how many there are
    # squares, count: (y, x) sum of squared pulls of each coarse block and its pixels, those
    # beyond left out
    squares: F64
    count: F64

    @property
    def spread(self) -> float:
        """Robust standard deviation of the pulls: 1 for noise alone."""
        total = np.concatenate([[0], np.cumsum(self.pulls)]) / max(1, int(self.pulls.sum()))
        low, high = np.interp(ndtr([-1, 1]), total, PULLS)
        return float((high - low) / 2)


def read_pixels(pair: Pair, sums: PairSums, runtime: Runtime) -> Pixels:
    """Read both sides once more, with the modes known."""
    total = sums.total()
    reach = REACH * (max(total.first, total.second) / max(total.pixels, 1)) ** 0.5 or 1.0
    tiles = pair.tiles()
    pieces = run_tasks(
        partial(_pixels_task, pair, sums.projection, reach), tiles, runtime,
        label=f"pixels {pair.name}",
    )  # fmt: skip
    side = 1 << pair.coarse
    squares, count = (np.zeros(sums.coarse.count.shape) for _ in range(2))
    for ((y0, y1), (x0, x1)), piece in zip(tiles, pieces, strict=True):
        at = np.s_[y0 // side : -(-y1 // side), x0 // side : -(-x1 // side)]
        squares[at], count[at] = piece.squares, piece.count
    far = sorted((f for piece in pieces for f in piece.far), key=lambda f: -abs(f[2] / f[3]))
    return Pixels(
        np.sum([piece.pulls for piece in pieces], axis=0),
        np.sum([piece.picture for piece in pieces], axis=0),
        reach, tuple(far), sum(piece.beyond for piece in pieces), squares, count,
    )  # fmt: skip


def _pixels_task(pair: Pair, projection: Projection, reach: float, tile: Tile) -> Pixels:
    values, noise = _values(pair, tile)
    variance = noise.sum(axis=0)
    first, second = projection.residual(values)
    z = pull(projection, values, variance)
    good = np.isfinite(z)
    edges = np.linspace(-reach, reach, PICTURE + 1)
    picture, _, _ = np.histogram2d(second[good], first[good], (edges, edges))
    beyond = np.flatnonzero(good & (np.abs(np.where(good, z, 0.0)) > DISAGREE))
    farthest = beyond[np.argsort(-np.abs(z.ravel()[beyond]))][:LISTED]
    (y0, _), (x0, _) = tile
    far = []
    for y, x in zip(*np.unravel_index(farthest, z.shape), strict=True):
        difference, error = second[y, x] - first[y, x], variance[y, x] ** 0.5
        far.append((int(y + y0), int(x + x0), float(difference), float(error)))
    ends = np.clip(z[good], PULLS[0], PULLS[-1])
    near = good & (np.abs(np.where(good, z, 0.0)) <= DISAGREE)
    squares, count = np.where(near, z, 0.0) ** 2, np.asarray(near, float)
    for _ in range(pair.coarse):
        squares, count = halve(squares), halve(count)
    return Pixels(
        np.histogram(ends, PULLS)[0], picture.astype(np.int64), reach, tuple(far), len(beyond),
        squares, count,
    )  # fmt: skip


@dataclass(frozen=True)
class Places:
    """Where the sides differ: blocks of the window."""

    side: int  # of a block, px
    # mean, error: (y, x) mean difference of a block's pixels and its error, px; NaN where empty
    mean: F64
    error: F64
    squares: F64  # squares, count: (y, x) sum of squared pulls and pixels
    count: F64

    @classmethod
    def of(cls, pair: Pair, sums: PairSums, pixels: Pixels) -> "Places":
        """Put coarse blocks together."""
        blocks, squares, count = sums.coarse, pixels.squares, pixels.count
        for _ in range((pair.shown >> pair.coarse).bit_length() - 1):
            blocks, squares, count = blocks.coarser(), halve(squares), halve(count)
        return cls(pair.shown, *sums.differences(blocks), squares, count)

    @property
    def shift(self) -> F64:
        """Mean difference over its error."""
        return self.mean / self.error

    @property
    def scatter(self) -> F64:
        """Excess scatter of a block's pixels over noise, sigma; NaN where empty."""
        n = np.where(self.count > 0, self.count, np.nan)
        chance = 2 / (9 * n)
        return np.asarray(((self.squares / n) ** (1 / 3) - (1 - chance)) / np.sqrt(chance))
