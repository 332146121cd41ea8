"""From phases to the fringes' geometry: planes of tiles, unwrapped, and what is fitted to them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.fringe_fit.fringes import grid
from pixcal.model.arrays import F32, F64, Mask

MAX_PIXELS = 1024  # pixels that a tile's plane is laid through


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
    """Plane through a tile's phases (through a thousand of them, when there are more).

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
    """Add whole turns to planes, outwards from the middle, so that neighbouring tiles agree.

    Tiles that no neighbour joins are joined to the nearest tile across the gap.
    """
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
    """A plane on the turn that another, unwrapped, leads to."""
    dy, dx = there.centre[0] - here.centre[0], there.centre[1] - here.centre[1]
    expected = here.phase + (here.kx + there.kx) / 2 * dx + (here.ky + there.ky) / 2 * dy
    turns = np.rint((expected - there.phase) / (2 * np.pi))
    return replace(there, phase=float(there.phase + 2 * np.pi * turns))
