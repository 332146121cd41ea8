"""Planes through tiles' phases, and sums to fit any shape of the fringes.

Over a tile, any shape of the fringes is a polynomial of low degree about its centre, with an error
far below the noise. Sums over pixels with these polynomials are computed once; every shape then
needs a few numbers per tile, without reading a map again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np

from pixcal.estimators.fringe_fit.fringes import grid, monomials, plane_wave, powers, wrapped
from pixcal.estimators.fringe_fit.gauge import FRINGE_MODES
from pixcal.model.arrays import F32, F64, Mask

MAX_PIXELS = 1024  # pixels to which a tile's plane is fitted
# that of the polynomial for tests of shapes, which a window of one tile must also represent
DEGREE = 5
SCALE_PX = 64.0  # unit of coordinates from the tile's centre: half a tile
POWERS = powers(DEGREE)
NODES = 6  # points along each axis at which functions are evaluated


@dataclass(frozen=True)
class TilePlane:
    """Smooth phase of a tile: ``phase + kx * (x - cx) + ky * (y - cy)``."""

    centre: tuple[float, float]  # (cy, cx) in pixels of the window
    phase: float  # at the centre, rad, relative to the carrier; known up to turns until unwrapped
    kx: float  # kx, ky: local fringe vector minus the carrier, rad/px
    ky: float
    sigma: float  # 1-sigma error of `phase`; infinite without good pixels
    ratio: float  # median of iota / alpha

    def on(self, shape: tuple[int, ...]) -> F64:
        """The plane on the tile's pixels."""
        y, x = grid(shape)
        return np.asarray(self.phase + self.kx * x + self.ky * y)


def tile_plane(
    phase: F32,
    sigma: F32,
    ratio: F32,
    good: Mask,
    slope: tuple[float, float],
    centre: tuple[float, float],
) -> TilePlane:
    """Plane through a tile's phases (at most a thousand of them).

    phase, sigma, ratio : (y, x) relative to the carrier and its error, rad; iota / alpha
    slope, centre : of the phase along x and y, rad/px, to within a turn; (y, x) of the tile, px
    """
    picked = np.flatnonzero(good)
    if not len(picked):
        return TilePlane(centre, 0.0, 0.0, 0.0, np.inf, 1.0)
    error = float(np.median(sigma.ravel()[picked]) / np.sqrt(len(picked)))
    picked = picked[:: -(-len(picked) // MAX_PIXELS)]
    rows, columns = np.divmod(picked, phase.shape[1])
    y, x = (grid(phase.shape)[n].ravel() for n in (0, 1))
    y, x = y[rows], x[columns]
    phasor = np.exp(1j * (phase[rows, columns] - slope[0] * x - slope[1] * y))
    middle = np.angle(phasor.sum())
    rest = np.angle(phasor * np.exp(-1j * middle))
    step = np.array([rest.mean(), 0.0, 0.0])
    if len(rest) >= 12:
        step = np.linalg.lstsq(np.stack([np.ones(len(x)), x, y], axis=1), rest, rcond=None)[0]
    return TilePlane(
        centre,
        float(np.angle(np.exp(1j * (middle + step[0])))),
        slope[0] + float(step[1]),
        slope[1] + float(step[2]),
        error,
        float(np.median(ratio[rows, columns])),
    )


def unwrap(planes: Sequence[TilePlane], grid_shape: tuple[int, int]) -> list[TilePlane]:
    """Add multiples of 2π to planes, outwards from the centre, so that neighbouring tiles agree."""
    # Tiles without a joined neighbour are joined to the nearest tile across the gap.
    rows, columns = grid_shape
    table = np.array(planes, dtype=object).reshape(rows, columns)
    result = table.copy()
    usable = np.array([np.isfinite(p.sigma) for p in planes]).reshape(rows, columns)
    done = np.zeros((rows, columns), bool)
    if not usable.any():
        return list(planes)
    y, x = np.ogrid[:rows, :columns]
    distance = np.hypot(y - rows // 2, x - columns // 2)
    seed = np.unravel_index(int(np.argmin(np.where(usable, distance, np.inf))), (rows, columns))
    queue = [(int(seed[0]), int(seed[1]))]
    done[seed] = True

    def join(here: tuple[int, ...], there: tuple[int, ...]) -> None:
        result[there] = _joined(result[here], table[there])
        done[there] = True
        queue.append((there[0], there[1]))

    while queue:
        i, j = queue.pop(0)
        for ni, nj in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
            if not (0 <= ni < rows and 0 <= nj < columns) or done[ni, nj] or not usable[ni, nj]:
                continue
            join((i, j), (ni, nj))
        if not queue and (left := np.argwhere(usable & ~done)).size:
            reached = np.argwhere(done)
            apart = ((left[:, None] - reached) ** 2).sum(axis=2)
            n, m = np.unravel_index(int(np.argmin(apart)), apart.shape)
            join(tuple(reached[m].tolist()), tuple(left[n].tolist()))
    return list(result.ravel())


def _joined(here: TilePlane, there: TilePlane) -> TilePlane:
    """A plane plus a multiple of 2π, to continue an unwrapped one."""
    dy, dx = there.centre[0] - here.centre[0], there.centre[1] - here.centre[1]
    expected = here.phase + (here.kx + there.kx) / 2 * dx + (here.ky + there.ky) / 2 * dy
    turns = np.rint((expected - there.phase) / (2 * np.pi))
    return replace(there, phase=float(there.phase + 2 * np.pi * turns))


@lru_cache(maxsize=8)
def polynomials(shape: tuple[int, ...]) -> F64:
    """The terms (term, y * x) on the pixels of a tile."""
    y, x = grid(shape)
    return monomials(y / SCALE_PX, x / SCALE_PX, DEGREE).reshape(len(POWERS), -1)


@cache
def _nodes() -> tuple[F64, F64, F64]:
    """Points (y, x) in units of `SCALE_PX`, and the matrix from values there to coefficients."""
    t = np.cos((2 * np.arange(NODES) + 1) * np.pi / (2 * NODES))
    y, x = (v.ravel() for v in np.meshgrid(t, t, indexing="ij"))
    return y, x, np.asarray(np.linalg.pinv(monomials(y, x, DEGREE).T), float)


def expand(function: Callable[[F64, F64], F64], centres: F64) -> F64:
    """Coefficients (tile, ..., term) of functions of (y, x) px about tile centres (tile, 2)."""
    y, x, fit = _nodes()
    at_y = (centres[:, :1] + SCALE_PX * y).ravel()
    at_x = (centres[:, 1:] + SCALE_PX * x).ravel()
    values = np.asarray(function(at_y, at_x))
    values = values.reshape(*values.shape[:-1], len(centres), len(y))
    terms = values @ fit.T
    # Rounding must not count as a term: on a single row, a mode along y is exactly zero.
    terms[np.abs(terms) < 1e-13 * np.abs(terms).max(axis=-1, keepdims=True)] = 0.0
    return np.moveaxis(terms, -2, 0)


# modes of a tile: the polynomials, then fringes degenerate with free intensities
N_LOCAL = len(POWERS) + len(FRINGE_MODES)
_PLANE = 7


@dataclass(frozen=True)
class Carrier:
    """The reference plane wave of phases: ``k . (r - reference)``."""

    k: tuple[float, float]  # (kx, ky), rad/px
    reference: tuple[float, float]  # (y, x), px

    def phase(self, y: F64, x: F64) -> F64:
        """Phase (rad) at coordinates, which broadcast."""
        ry, rx = self.reference
        return np.asarray(self.k[0] * (x - rx) + self.k[1] * (y - ry))


@dataclass(frozen=True)
class TileSums:
    """Least squares of tiles' modes, one entry per tile; phases are relative to the planes."""

    planes: list[TilePlane]
    normal: F64  # (tile, mode, mode)
    # (tile, mode, 1 + batch) of the whole run's phases, then of the batches' relative to it
    right: F64
    square: F64  # (tile,) weighted square of the whole run's phases
    pixels: F64  # (tile,) with weight

    @classmethod
    def width(cls, n_batches: int) -> int:
        """Numbers that `row` writes."""
        return _PLANE + 2 + N_LOCAL * (N_LOCAL + 1 + n_batches)

    @classmethod
    def of_rows(cls, rows: F64) -> "TileSums":
        """Sums of tiles from the rows (tile, number) that `row` wrote."""
        n = len(rows)
        planes = [TilePlane((y, x), *facts) for y, x, *facts in rows[:, :_PLANE].tolist()]
        square, pixels = rows[:, _PLANE], rows[:, _PLANE + 1]
        rest = rows[:, _PLANE + 2 :]
        normal = rest[:, : N_LOCAL**2].reshape(n, N_LOCAL, N_LOCAL)
        right = rest[:, N_LOCAL**2 :].reshape(n, N_LOCAL, -1)
        return cls(planes, normal, right, square, pixels)


def local_modes(carrier: Carrier, plane: TilePlane, shape: tuple[int, ...]) -> F64:
    """The modes (mode, y * x) of a tile."""
    cy, cx = plane.centre
    at_centre = float(carrier.phase(np.asarray(cy), np.asarray(cx))) + plane.phase
    wave = plane_wave(shape, (carrier.k[0] + plane.kx, carrier.k[1] + plane.ky), at_centre).ravel()
    c, s = wave.real, wave.imag
    modes = np.empty((N_LOCAL, wave.size))
    modes[: -len(FRINGE_MODES)] = polynomials(shape)
    # In the order of FRINGE_MODES (`pixcal.estimators.fringe_fit.gauge.fringe_modes`).
    modes[-4], modes[-3] = plane.ratio * c, plane.ratio * s
    modes[-2], modes[-1] = c * c - s * s, 2 * c * s
    return modes


def sum_row(
    phase: F32, sigma: F32, good: Mask, batches: F32, carrier: Carrier, plane: TilePlane
) -> F64:
    """The sums of one tile, as a row of `TileSums.of_rows`.

    ``phase, sigma``: (y, x) relative to the carrier and error, rad. ``batches``: (batch, y, x)
    relative to the whole run, rad; NaN in gaps. ``plane``: smooth phase of the tile.
    """
    modes = local_modes(carrier, plane, phase.shape)
    usable = (good & np.isfinite(phase)).ravel()
    weight = np.where(usable, 1 / np.where(usable, sigma.ravel(), 1.0).astype(float) ** 2, 0.0)
    rest = np.where(usable, wrapped(phase - plane.on(phase.shape)).ravel(), 0.0)
    root = np.sqrt(weight)
    modes *= root
    normal, right = modes @ modes.T, np.empty((N_LOCAL, 1 + len(batches)))
    right[:, 0] = modes @ (root * rest)
    # Small numbers, mainly noise: float32 is enough, and takes a third of the time.
    several = np.where(usable, batches.reshape(len(batches), phase.size), np.float32(0))
    several[np.isnan(several)] = 0
    right[:, 1:] = (modes.astype(np.float32) * root.astype(np.float32)) @ several.T
    square = float(weight @ rest**2)
    facts = [*plane.centre, plane.phase, plane.kx, plane.ky, plane.sigma, plane.ratio]
    return np.concatenate(
        [np.array([*facts, square, float(usable.sum())]), normal.ravel(), right.ravel()]
    )
