"""Error of a star's centroid at every position, to first order, by convolution.

A star in the middle of each pixel; its error is the sum of the displacements around it, weighted
as `centroids.Star.weights` says. Masked pixels have no part in it, and the
others their weight (exact but for how they share it).
"""

from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.star_centroids import Star
from pixcal.model.arrays import C128, F64
from pixcal.stages.astrometry.detector import PixelPositions
from pixcal.stages.astrometry.stars import MAX_LOST
from pixcal.storage.cube import ArrayWriter, create_group, create_map

TILE = 512  # side of a task's part of the map, about, px
SHOWN = 96  # most blocks along the longer side of the pictures of the whole detector
# least side of such a block, px: a few independent places, for its rms to mean something
MIN_BLOCK = 8
GRIDS = ("perfect", "measured")


@dataclass(frozen=True)
class ErrorMaps:
    """Error of a star in the middle of every pixel whose window lies on the detector."""

    # (grid, component, y, x) sum of squares over blocks, px²: pixels taken for a perfect grid,
    # or where the maps say
    squares: F64
    places: F64  # (y, x) pixels of the blocks that count
    block: int  # side of the blocks, px

    @property
    def mean_square(self) -> F64:
        """Over the whole detector, (grid, component), px²; NaN where no place counts."""
        return np.asarray(self.squares.sum(axis=(2, 3)) / (self.places.sum() or np.nan))

    @property
    def rms(self) -> F64:
        """Of each block, (grid, component, y, x), px; NaN where no place counts."""
        return np.sqrt(self.squares / np.where(self.places > 0, self.places, np.nan))


def tile_side(shape: tuple[int, int]) -> tuple[int, int]:
    """Side of a task's tile, and of the blocks it is divided into, px."""
    block = max(MIN_BLOCK, -(-max(shape) // SHOWN))
    return block * max(1, TILE // block), block


def error_maps(folder: Path, detector: PixelPositions, star: Star, runtime: Runtime) -> ErrorMaps:
    """Write the error at every place as arrays (y, x), px, and sum it up.

    ``perfect_<component>`` and ``measured_<component>`` are NaN at places that do not count.
    """
    ny, nx = detector.shape
    side, block = tile_side(detector.shape)
    create_group(folder)
    chunks = min(side, ny), min(side, nx)
    names = [f"{grid}_{component.name}" for grid in GRIDS for component in detector.components]
    writers = [create_map(folder / name, (ny, nx), chunks, units="pixel") for name in names]
    corners = list(product(range(0, ny, side), range(0, nx, side)))
    task = partial(_tile, detector, star, writers, side, block)
    parts = run_tasks(task, corners, runtime, label="error maps")
    for writer in writers:
        writer.finish()
    columns = -(-nx // side)
    sums = np.block([parts[n : n + columns] for n in range(0, len(parts), columns)])
    squares = sums[:-1].reshape(len(GRIDS), -1, *sums.shape[1:])
    return ErrorMaps(squares, sums[-1], block)


def _tile(
    detector: PixelPositions,
    star: Star,
    writers: list[ArrayWriter],
    side: int,
    block: int,
    corner: tuple[int, int],
) -> F64:
    """Write a part of the maps; sums over its blocks (map + 1, y, x) of squares and of places."""
    y, x = ((a, min(a + side, n)) for a, n in zip(corner, detector.shape, strict=True))
    errors = place_errors(detector, star, y, x)
    maps = errors.reshape(-1, *errors.shape[2:])
    for writer, values in zip(writers, maps, strict=True):
        writer.write(corner, values.astype(np.float32))
    good = np.isfinite(maps[:1])
    sums = np.concatenate([np.where(good, maps, 0.0) ** 2, good.astype(float)])
    rows = np.add.reduceat(sums, range(0, sums.shape[1], block), axis=1)
    return np.asarray(np.add.reduceat(rows, range(0, sums.shape[2], block), axis=2))


def place_errors(
    detector: PixelPositions, star: Star, y: tuple[int, int], x: tuple[int, int]
) -> F64:
    """Errors (grid, component, y, x), px, of stars in the middle of some pixels."""
    half, (ny, nx) = star.half, detector.shape
    patch = detector.patch((y[0] - half, y[1] + half), (x[0] - half, x[1] + half))
    shape = (y[1] - y[0], x[1] - x[0])
    size = tuple(next_fast_len(n + 2 * half, real=True) for n in shape)
    axes = detector.axes
    weights = np.einsum("ka,abyx,lb->klyx", axes, star.weights(np.zeros(2)), axes)
    kernels = np.conj(rfft2(weights, size))

    def sums(kernel: C128, values: F64) -> F64:
        """Sum of the values about each place, (kernel of sums) weighted."""
        spectrum = np.einsum("kl...,l...->k...", kernel, rfft2(values, size))
        return np.asarray(irfft2(spectrum, size)[:, : shape[0], : shape[1]])

    errors = np.stack(
        [sums(kernels, displacement) for displacement in (patch.true, patch.true - patch.known)]
    )
    rows, columns = np.arange(*y)[:, None], np.arange(*x)[None, :]
    counts = (rows >= half) & (rows < ny - half) & (columns >= half) & (columns < nx - half)
    if not patch.good.all():
        diagonal = np.stack([[kernels[k, k]] for k in range(len(axes))])
        kept = -sums(diagonal, patch.good.astype(float)[None])
        counts = counts & (kept >= 1 - MAX_LOST).all(axis=0)
        errors /= np.maximum(kept, 1 - MAX_LOST)
    return np.where(counts, errors, np.nan)
