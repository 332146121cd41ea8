"""Detector, light and frames of a bench, as arrays for `synthesis`."""

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels import optics
from pixcal.kernels.beams import MODULATED, Beam, Light
from pixcal.kernels.synthesis import BLOCK_ROWS, Stream, fill_normal, generator, turns
from pixcal.model.arrays import F32, F64, U8
from pixcal.model.bench import Bench, SimulatedDetector
from pixcal.model.flags import PixelFlag

# Rows and columns of the chip that share a generator. Other numbers would give another chip.
TILE = (64, 256)
Rows = tuple[int, int]
Piece = tuple[slice, slice]


@dataclass(frozen=True)
class DetectorMaps:
    """True maps of the pixels on rows of the window, each of shape (y, x)."""

    delta_x: F32  # offset along x, px
    delta_y: F32  # offset along y, px
    response: F32  # relative, mean 1
    bias: F32  # ADU
    dark_rate: F32  # e-/s
    read_noise: F32  # e- rms
    adu_per_e: F32  # the inverse of the gain, ADU/e-
    mask: U8  # `PixelFlag.HOT` and `PixelFlag.DEAD`

    def on(self, rows: Rows) -> "DetectorMaps":
        """The maps on a range of the rows (first, one after the last)."""
        return DetectorMaps(*(getattr(self, field.name)[slice(*rows)] for field in fields(self)))


def detector_maps(detector: SimulatedDetector, rows: Rows) -> DetectorMaps:
    """The detector's maps for rows of the window (first, one after the last)."""
    names = [field.name for field in fields(DetectorMaps)]
    shape = rows[1] - rows[0], detector.shape[1]
    maps = DetectorMaps(
        *(np.empty(shape, np.uint8 if name == "mask" else np.float32) for name in names)
    )
    for ty, tx, inside, window in _tiles(detector, rows):
        tile = _chip_tile(detector, ty, tx)
        for name in names:
            getattr(maps, name)[window] = getattr(tile, name)[inside]
    return maps


def chip_map(
    detector: SimulatedDetector,
    rows: Rows,
    effect: str,
    draw: Callable[[np.random.Generator], NDArray[Any]],
) -> F32:
    """Map (y, x) of an effect's random values on rows of the window (first, one after the last).

    ``effect`` identifies the random numbers; ``draw`` makes the values of a tile of the chip, of
    shape `TILE`, from a generator, so that a chip has the same values in every window.
    """
    out = np.empty((rows[1] - rows[0], detector.shape[1]), np.float32)
    name = zlib.crc32(effect.encode())
    for ty, tx, inside, window in _tiles(detector, rows):
        out[window] = draw(generator(detector.seed, Stream.EFFECT, name, ty, tx))[inside]
    return out


def _tiles(detector: SimulatedDetector, rows: Rows) -> Iterator[tuple[int, int, Piece, Piece]]:
    """Tiles of the chip under rows of the window: number, common pixels in tile and in rows."""
    (row, column), width = detector.origin, detector.shape[1]
    y0, y1, x0, x1 = row + rows[0], row + rows[1], column, column + width
    for ty in range(y0 // TILE[0], -(-y1 // TILE[0])):
        for tx in range(x0 // TILE[1], -(-x1 // TILE[1])):
            top, left = ty * TILE[0], tx * TILE[1]
            y = slice(max(y0, top), min(y1, top + TILE[0]))
            x = slice(max(x0, left), min(x1, left + TILE[1]))
            yield ty, tx, (_shift(y, top), _shift(x, left)), (_shift(y, y0), _shift(x, x0))


def _shift(part: slice, by: int) -> slice:
    return slice(part.start - by, part.stop - by)


def _chip_tile(d: SimulatedDetector, ty: int, tx: int) -> DetectorMaps:
    """Maps of one whole tile of the chip, so that every window has the same pixels."""

    def normal(stream: Stream, rms: float) -> F32:
        values = np.empty(TILE, np.float32)
        fill_normal(generator(d.seed, stream, ty, tx), values)
        return values * np.float32(rms)

    rng = generator(d.seed, Stream.DEFECT, ty, tx)
    chance = rng.random(TILE)
    dead, hot = chance < d.dead_fraction, chance >= 1 - d.hot_fraction
    response = np.maximum(1 + normal(Stream.RESPONSE, d.prnu_rms), 0)
    response[dead] = 0
    dark = np.full(TILE, d.dark_e_s, np.float32)
    dark[hot] += d.hot_rate_e_s * (0.5 + 0.5 * rng.standard_exponential(np.count_nonzero(hot)))
    columns = generator(d.seed, Stream.BIAS_COLUMN, tx).standard_normal(TILE[1])
    column_bias = (d.bias_adu + d.bias_column_rms_adu * columns).astype(np.float32)
    stitch_x, stitch_y = _stitches(d, ty, tx)
    return DetectorMaps(
        delta_x=normal(Stream.DELTA_X, d.delta_rms_px) + stitch_x,
        delta_y=normal(Stream.DELTA_Y, d.delta_rms_px) + stitch_y,
        response=response,
        bias=normal(Stream.BIAS, d.bias_pixel_rms_adu) + column_bias,
        dark_rate=dark,
        read_noise=np.full(TILE, d.read_noise_e, np.float32),
        adu_per_e=np.full(TILE, 1.0 / d.gain_e_per_adu, np.float32),
        mask=np.where(dead, PixelFlag.DEAD, np.where(hot, PixelFlag.HOT, 0)).astype(np.uint8),
    )


def _stitches(d: SimulatedDetector, ty: int, tx: int) -> tuple[F32, F32]:
    """Offsets (dx, dy), px, of the stitching blocks in a tile of the chip."""
    y = np.arange(ty * TILE[0], (ty + 1) * TILE[0]) // d.stitch_px[0]
    x = np.arange(tx * TILE[1], (tx + 1) * TILE[1]) // d.stitch_px[1]
    # Each row of blocks has one generator, drawn along the row, so that tiles agree.
    drawn = {
        int(block): generator(d.seed, Stream.STITCH, int(block)).standard_normal((x[-1] + 1, 2))
        for block in np.unique(y)
    }
    shifts = np.stack([drawn[int(block)][x] for block in y]).astype(np.float32)
    shifts *= np.float32(d.stitch_rms_px)
    return shifts[..., 0], shifts[..., 1]


def geometry(bench: Bench, number: int) -> optics.Geometry:
    """True geometry of a fringe set, from the first pixel of the window."""
    d, o, scan = bench.detector, bench.optics_of(number), bench.frames.fringes[number]
    pitch = d.pitch_um * 1e-3
    return optics.Geometry(
        wavelength=o.wavelength_nm * 1e-6,
        pitch=pitch,
        centre_x=d.chip_centre_px[0] * pitch + o.offset_mm[0],
        centre_y=d.chip_centre_px[1] * pitch + o.offset_mm[1],
        distance=o.distance_mm,
        baseline_x=scan.baseline_mm[0],
        baseline_y=scan.baseline_mm[1],
        baseline_z=scan.baseline_z_mm,
    )


def fibre_light(bench: Bench, number: int, rows: Rows) -> tuple[F64, F64]:
    """Separate Gaussian beams A and B (y, x), on a perfect grid, relative to the peak of A."""
    g, o = geometry(bench, number), bench.optics_of(number)
    x = np.arange(bench.detector.shape[1])
    y = np.arange(*rows)[:, None]
    light = []
    for side, pointing in ((-0.5, o.pointing_a_mm), (0.5, o.pointing_b_mm)):
        peak = (
            (g.centre_x + side * g.baseline_x + pointing[0]) / g.pitch,
            (g.centre_y + side * g.baseline_y + pointing[1]) / g.pitch,
        )
        light.append(optics.gaussian_beam(x, y, peak, o.beam_radius_mm / g.pitch))
    return light[0], o.power_ratio * light[1]


def electrons_per_unit(bench: Bench, number: int) -> float:
    """Electrons per unit of `fibre_light`, so that the window's brightest fringe has peak_e."""
    ny, visibility = bench.detector.shape[0], bench.optics_of(number).visibility
    brightest = 0.0
    for row in range(0, ny, BLOCK_ROWS):
        a, b = fibre_light(bench, number, (row, min(row + BLOCK_ROWS, ny)))
        bright = a + b + 2 * visibility * np.sqrt(a * b)
        brightest = max(brightest, float(bright.max()))
    return bench.frames.fringes[number].peak_e / brightest


def fringe_light(
    bench: Bench, number: int, rows: Rows, maps: DetectorMaps, electrons: float
) -> Light:
    """The two fibres' beams at the pixels' true positions, with straight fringes.

    ``maps`` are those of ``rows``; ``electrons`` is from `electrons_per_unit`.
    """
    a, b = (np.sqrt(electrons * light) for light in fibre_light(bench, number, rows))
    x = np.arange(bench.detector.shape[1]) + maps.delta_x.astype(np.float64)
    y = np.arange(*rows)[:, None] + maps.delta_y.astype(np.float64)
    psi = optics.paraxial_phase(x, y, geometry(bench, number))
    beams = Beam(a, psi, MODULATED), Beam(b, 0.0)
    return Light(beams, bench.optics_of(number).visibility)


@dataclass(frozen=True)
class FrameStates:
    """States of a fringe set's frames; arrays over the frames."""

    phi: F64  # phase, rad
    level: F64  # B, mean 1
    amplitude: F64  # A, mean 1
    dkx: F64  # change of the fringe vector along x, rad/px, about the window's centre
    dky: F64  # change of the fringe vector along y, rad/px

    def turns(
        self, frame: int, shape: tuple[int, int], rows: Rows, margin: int = 0
    ) -> tuple[F32, F32]:
        """Phase of a frame along columns and rows, for `synthesis.illuminate`.

        ``margin``: number of further pixels at either end.
        """
        x = np.arange(-margin, shape[1] + margin) - (shape[1] - 1) / 2
        y = np.arange(rows[0] - margin, rows[1] + margin) - (shape[0] - 1) / 2
        return turns(self.dkx[frame] * x), turns(self.phi[frame] + self.dky[frame] * y)


def frame_states(bench: Bench, number: int) -> FrameStates:
    """Draw the phases of a set's frames; a larger number keeps those of the first frames."""
    scan = bench.frames.fringes[number]
    if scan.phase_law == "ramp":
        phi = np.mod(scan.phase_step_rad * np.arange(scan.count), 2 * np.pi)
    else:
        rng = generator(bench.seed, Stream.PHASE, number)
        phi = 2 * np.pi * rng.random(scan.count)
    steady, still = np.ones(scan.count), np.zeros(scan.count)
    return FrameStates(phi, steady, steady, still, still)
