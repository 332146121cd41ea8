"""Charge that a particle leaves along its straight way through the sensitive layer.

The charge is laid down evenly along the track and spreads on its way to the pixels' gates, which
blurs the track by a Gaussian.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from pixcal.model.arrays import F32, F64

STEPS_PER_PX = 4  # points of a track that stand for a pixel of its length
GRAZING = 0.02  # least cosine to the layer's normal: no track is longer than 50 times the depth
_RANGE = 4.0


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _spread(centre: float, first: int, sigma: float, out: Any) -> None:
    """Share of a Gaussian at ``centre`` in the pixels from ``first`` on."""
    scale = 1 / (math.sqrt(2.0) * sigma)
    before = math.erf((first - 0.5 - centre) * scale)
    for i in range(out.size):
        after = math.erf((first + i + 0.5 - centre) * scale)
        out[i] = 0.5 * (after - before)
        before = after


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def add_tracks(charge: F32, tracks: F64, sigma: float, first_row: int) -> None:
    """Add the charge of tracks to a frame (y, x), e-; what falls beside it is lost.

    Parameters
    ----------
    charge : (y, x) float32, e-, changed in place
    tracks : (n, 5) row and column where a track begins, its length along each (px), its charge (e-)
    sigma : width of the blur, px
    first_row : of the frame, among those that the tracks are counted in
    """
    ny, nx = charge.shape
    reach = math.ceil(_RANGE * sigma)
    along_y, along_x = np.empty(2 * reach + 2), np.empty(2 * reach + 2)
    for n in range(len(tracks)):
        y0, x0, dy, dx, electrons = tracks[n]
        points = math.ceil(STEPS_PER_PX * math.hypot(dy, dx)) + 1
        for p in range(points):
            y, x = y0 + dy * (p + 0.5) / points, x0 + dx * (p + 0.5) / points
            top, left = math.floor(y) - reach, math.floor(x) - reach
            below = top - first_row
            if below >= ny or left >= nx or below + along_y.size <= 0 or left + along_x.size <= 0:
                continue
            _spread(y, top, sigma, along_y)
            _spread(x, left, sigma, along_x)
            for i in range(max(0, -below), min(along_y.size, ny - below)):
                part = electrons / points * along_y[i]
                for j in range(max(0, -left), min(along_x.size, nx - left)):
                    charge[below + i, left + j] += part * along_x[j]


def draw_tracks(
    rng: np.random.Generator,
    count: int,
    area_px: tuple[int, int],
    margin_px: int,
    depth_px: float,
    electrons_per_px: float,
    straggling: float,
) -> F64:
    """Tracks (count, 5), as in `add_tracks`, of particles that arrive evenly from a half space.

    Parameters
    ----------
    area_px, margin_px : rows and columns that tracks begin in, and how far beside them
    depth_px : of the sensitive layer
    electrons_per_px : most probable charge for a length as long as a pixel is wide
    straggling : relative width of the distribution of charge (Moyal's form of Landau's)
    """
    # A flux that is even in direction meets a plane with the cosine of the angle.
    cosine = np.sqrt(rng.random(count))
    length = depth_px / np.maximum(cosine, GRAZING)
    across = np.sqrt(np.maximum(length**2 - depth_px**2, 0))
    turn = 2 * np.pi * rng.random(count)
    # Minus the logarithm of the square of a normal has Moyal's distribution, apart from its zero.
    moyal = -np.log(np.maximum(rng.standard_normal(count) ** 2, 1e-300))
    charge = electrons_per_px * length * np.maximum(1 + straggling * moyal, 0)
    y, x = (rng.random(count) * (size + 2 * margin_px) - margin_px - 0.5 for size in area_px)
    return np.stack([y, x, across * np.sin(turn), across * np.cos(turn), charge], axis=1)
