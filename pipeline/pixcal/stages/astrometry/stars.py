"""The telescope and its stars, each observed and fitted at several dithered positions."""

import math
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.star_centroids import Star
from pixcal.kernels.psf import Psf, diffraction_psf
from pixcal.model.acquisition import Detector as Declared
from pixcal.model.arrays import C128, F64
from pixcal.model.errors import InputError
from pixcal.model.options import Astrometry as Config
from pixcal.stages.astrometry.detector import PixelPositions
from pixcal.stages.tiles import Part, Range, spans
from pixcal.storage.cube import ArrayWriter, create_group, create_map

FULL_WELL_E = 50_000.0  # if the acquisition declares none (paper, table 1)
WINDOW = 4.0  # half of the default window, in lambda / D: three dark rings
SAMPLINGS = (0.4, 40.0)  # range of pixels per lambda / D of the table of the pattern
BATCH = 16  # stars of a task
MAX_LOST = 0.1  # largest share of the position information in masked pixels at a usable place
# errors of a star at a place: with pixels on a perfect grid or at mapped positions; without and
# with photon noise; and the first two as predicted by `star_centroids.Star.weights`
KINDS = ("perfect", "measured", "perfect_photons", "measured_photons", "linear", "linear_measured")
TILE = 512  # approximate side of a task's part of the map, px
SHOWN = 96  # most blocks along the longer side of the whole detector's pictures
MIN_BLOCK = 8  # least side of such a block, px: its rms needs a few independent places
GRIDS = ("perfect", "measured")


@dataclass(frozen=True)
class Telescope:
    """A telescope and its detector's pixels."""

    diameter_m: float
    focal_length_m: float
    wavelength_nm: float
    obscuration: float
    pitch_um: float

    def __post_init__(self) -> None:
        low, high = SAMPLINGS
        if not low <= self.sampling <= high:
            raise InputError(
                f"--focal-length, --wavelength, --diameter: {self.sampling:.3g} px per "
                f"lambda/D, not between {low:g} and {high:g}; change one of them"
            )

    @property
    def sampling(self) -> float:
        """Pixels in lambda / D; Nyquist's limit is 2."""
        image = self.wavelength_nm * 1e-3 * self.focal_length_m / self.diameter_m
        return image / self.pitch_um

    @property
    def uas_per_px(self) -> float:
        """Plate scale, µas."""
        return self.pitch_um * 1e-6 / self.focal_length_m * 180 / np.pi * 3600e6

    def psf(self, window: int | None) -> tuple[Psf, int]:
        """The pattern in the detector's pixels, and half of the window's side, px."""
        half = max(2, math.ceil(WINDOW * self.sampling)) if window is None else window // 2
        return diffraction_psf(self.sampling, self.obscuration, half), half

    def facts(self) -> dict[str, float]:
        """For the JSON."""
        return asdict(self) | {"uas_per_px": self.uas_per_px, "px_per_lambda_over_d": self.sampling}


def exposures(psf: Psf, electrons: float, detector: Declared) -> int:
    """Number of exposures of a star such that no pixel saturates."""
    return max(1, math.ceil(electrons * psf.peak / (detector.full_well_e or FULL_WELL_E)))


def star(psf: Psf, half: int, electrons: float, background: float, detector: Declared) -> Star:
    """A star with the given electrons over all exposures, each with its read noise."""
    read_variance = exposures(psf, electrons, detector) * detector.read_noise_e**2
    return Star(psf, half, electrons, background, read_variance)


def observe(detector: PixelPositions, star: Star, config: Config, runtime: Runtime) -> F64:
    """Errors (star, position, kind, component), px, of stars; NaN if unused or if a fit fails."""
    batches = [range(n, min(n + BATCH, config.stars)) for n in range(0, config.stars, BATCH)]
    core = core_weights(star, detector.axes)
    task = partial(_batch, detector, star, config, core)
    return np.concatenate(run_tasks(task, batches, runtime, label="stars"))


def core_weights(star: Star, axes: F64) -> F64:
    """Weight of each pixel in the centroid of a centred star, (component, y, x), sum 1."""
    weights = -star.weights(np.zeros(2))
    return np.asarray(np.einsum("ka,abyx,kb->kyx", axes, weights, axes))


def _batch(detector: PixelPositions, star: Star, config: Config, core: F64, stars: range) -> F64:
    return np.stack([observe_star(detector, star, config, core, n) for n in stars])


def observe_star(
    detector: PixelPositions, star: Star, config: Config, core: F64, number: int
) -> F64:
    """Errors (position, kind, component) of one star, px; ``core`` is that of `core_weights`."""
    half, axes = star.half, detector.axes
    rng = np.random.default_rng([detector.seed, 2, number])
    # The whole window lies on the detector.
    first = np.full(2, half - 0.5)
    last = np.array(detector.shape[::-1]) - half - 0.5
    middle = rng.uniform(first, last)
    reach = config.dither_px
    low, high = np.maximum(first, middle - reach), np.minimum(last, middle + reach)
    at = rng.uniform(low, high, (config.positions, 2))
    at[0] = middle
    pixel = np.floor(at + 0.5).astype(int)
    corner, end = pixel.min(axis=0) - half, pixel.max(axis=0) + half + 1
    patch = detector.patch((corner[1], end[1]), (corner[0], end[0]))
    cuts = [np.s_[..., y : y + star.side, x : x + star.side] for x, y in (pixel - half - corner)]
    good = np.stack([patch.good[cut] for cut in cuts])
    # Displacements (position, (x, y), y, x): true ones, and those of the maps.
    true, known = (
        np.einsum("nkyx,ka->nayx", np.stack([offsets[cut] for cut in cuts]), axes)
        for offsets in (patch.true, patch.known)
    )
    place = at - pixel
    mean = star.expected(place, true)
    noise = np.sqrt(star.read_variance) * rng.standard_normal(mean.shape)
    noisy = rng.poisson(np.maximum(mean, 0.0)) + noise
    errors = [
        star.fit(data, grid, good)[:, :2] - place
        for data in (mean, noisy)
        for grid in (np.zeros_like(known), known)
    ]
    weights = np.stack([star.weights(p, g) for p, g in zip(place, good, strict=True)])
    errors += [np.einsum("nabyx,nbyx->na", weights, moved) for moved in (true, true - known)]
    along = np.einsum("jna,ka->njk", np.stack(errors), axes)
    along[(np.einsum("kyx,nyx->nk", core, ~good) > MAX_LOST).any(axis=1)] = np.nan
    return np.asarray(along)


# Error of a centroid at every position, to first order, by convolution


@dataclass(frozen=True)
class ErrorMaps:
    """Error of a star at the centre of every pixel whose window is on the detector."""

    # (grid, component, y, x) sum of squares over blocks, px², with pixels assumed on a perfect
    # grid, or at mapped positions
    squares: F64
    places: F64  # (y, x) number of valid pixels of the blocks
    block: int  # side of the blocks, px

    @property
    def mean_square(self) -> F64:
        """Mean over the whole detector, (grid, component), px²; NaN without valid pixels."""
        return np.asarray(self.squares.sum(axis=(2, 3)) / (self.places.sum() or np.nan))

    @property
    def rms(self) -> F64:
        """Rms of each block, (grid, component, y, x), px; NaN without valid pixels."""
        return np.sqrt(self.squares / np.where(self.places > 0, self.places, np.nan))


def tile_side(shape: tuple[int, int]) -> tuple[int, int]:
    """Side of a task's tile, and of the blocks it is divided into, px."""
    block = max(MIN_BLOCK, -(-max(shape) // SHOWN))
    return block * max(1, TILE // block), block


def error_maps(folder: Path, detector: PixelPositions, star: Star, runtime: Runtime) -> ErrorMaps:
    """Write the error at every pixel as arrays (y, x), px, and sum the squares.

    ``perfect_<component>`` and ``measured_<component>`` are NaN at invalid pixels.
    """
    ny, nx = detector.shape
    side, block = tile_side(detector.shape)
    create_group(folder)
    chunks = min(side, ny), min(side, nx)
    names = [f"{grid}_{component.name}" for grid in GRIDS for component in detector.components]
    writers = [create_map(folder / name, (ny, nx), chunks, units="pixel") for name in names]
    tiles = list(product(spans(ny, side), spans(nx, side)))
    parts = run_tasks(partial(_tile, detector, star, writers), tiles, runtime, label="error maps")
    for writer in writers:
        writer.finish()
    columns = -(-nx // side)
    sums = np.block([parts[n : n + columns] for n in range(0, len(parts), columns)])
    squares = sums[:-1].reshape(len(GRIDS), -1, *sums.shape[1:])
    return ErrorMaps(squares, sums[-1], block)


def _tile(detector: PixelPositions, star: Star, writers: list[ArrayWriter], tile: Part) -> F64:
    """Write a part of the maps; sums over its blocks (map + 1, y, x): squares, valid pixels."""
    _, block = tile_side(detector.shape)
    errors = place_errors(detector, star, *tile)
    maps = errors.reshape(-1, *errors.shape[2:])
    for writer, values in zip(writers, maps, strict=True):
        writer.write((tile[0][0], tile[1][0]), values.astype(np.float32))
    good = np.isfinite(maps[:1])
    sums = np.concatenate([np.where(good, maps, 0.0) ** 2, good.astype(float)])
    rows = np.add.reduceat(sums, range(0, sums.shape[1], block), axis=1)
    return np.asarray(np.add.reduceat(rows, range(0, sums.shape[2], block), axis=2))


def place_errors(detector: PixelPositions, star: Star, y: Range, x: Range) -> F64:
    """Errors (grid, component, y, x), px, of stars at the centres of given pixels."""
    half, (ny, nx) = star.half, detector.shape
    patch = detector.patch((y[0] - half, y[1] + half), (x[0] - half, x[1] + half))
    shape = (y[1] - y[0], x[1] - x[0])
    size = tuple(next_fast_len(n + 2 * half, real=True) for n in shape)
    axes = detector.axes
    weights = np.einsum("ka,abyx,lb->klyx", axes, star.weights(np.zeros(2)), axes)
    kernels = np.conj(rfft2(weights, size))

    def sums(kernel: C128, values: F64) -> F64:
        """Weighted sums of the values around each place, by convolution."""
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
