"""Charge that a particle deposits along its straight track through the sensitive layer.

The charge is uniform along the track and diffuses on its way to the pixels' gates, which blurs the
track by a Gaussian.
"""

import math
from typing import Any

import numpy as np

from pixcal.kernels import inner, kernel
from pixcal.model.arrays import F32, F64

STEPS_PER_PX = 4  # points of a track per pixel of its length
GRAZING = 0.02  # least cosine to the layer's normal, so tracks are at most 50 depths long
_RANGE = 4.0


@kernel()
def add_tracks(charge: F32, tracks: F64, sigma: float, first_row: int) -> None:
    """Add the charge of tracks to that of a frame (y, x), e-, in place; outside it is lost.

    ``tracks``: (n, 5) row and column of a track's start, its length along each (px), its charge
    (e-). ``sigma``: width of the blur, px. ``first_row``: of the frame, in the tracks' coordinates.
    """
    reach = math.ceil(_RANGE * sigma)
    along_y, along_x = np.empty(2 * reach + 2), np.empty(2 * reach + 2)
    for y0, x0, dy, dx, electrons in tracks:
        points = math.ceil(STEPS_PER_PX * math.hypot(dy, dx)) + 1
        for n in range(points):
            y, x = y0 + (n + 0.5) / points * dy, x0 + (n + 0.5) / points * dx
            row, column = math.floor(y) - reach - first_row, math.floor(x) - reach
            _shares(along_y, row + first_row - y, sigma)
            _shares(along_x, column - x, sigma)
            for i in range(max(-row, 0), min(len(along_y), charge.shape[0] - row)):
                for j in range(max(-column, 0), min(len(along_x), charge.shape[1] - column)):
                    share = electrons / points * along_y[i] * along_x[j]
                    charge[row + i, column + j] += share


@inner()
def _shares(shares: Any, away: float, sigma: float) -> None:
    """Shares of a Gaussian in successive pixels, the first at ``away`` from its centre."""
    below = math.erf((away - 0.5) / (math.sqrt(2.0) * sigma))
    for n in range(len(shares)):
        upto = math.erf((away + n + 0.5) / (math.sqrt(2.0) * sigma))
        shares[n] = (upto - below) / 2
        below = upto


def draw_tracks(
    rng: np.random.Generator,
    count: int,
    area_px: tuple[int, int],
    margin_px: int,
    depth_px: float,
    electrons_per_px: float,
    straggling: float,
) -> F64:
    """Tracks (count, 5), as in `add_tracks`, of an isotropic flux of particles from a half space.

    area_px, margin_px : rows and columns where tracks begin, and the margin around them
    depth_px : of the sensitive layer
    electrons_per_px : most probable charge per pixel width of track length
    straggling : relative width of the distribution of charge (Moyal's form of Landau's)
    """
    # An isotropic flux through a plane is proportional to the cosine of the angle.
    cosine = np.sqrt(rng.random(count))
    length = depth_px / np.maximum(cosine, GRAZING)
    across = np.sqrt(np.maximum(length**2 - depth_px**2, 0))
    turn = 2 * np.pi * rng.random(count)
    # Minus the logarithm of a squared normal has Moyal's distribution, apart from its origin.
    moyal = -np.log(np.maximum(rng.standard_normal(count) ** 2, 1e-300))
    charge = electrons_per_px * length * np.maximum(1 + straggling * moyal, 0)
    y, x = (rng.random(count) * (size + 2 * margin_px) - margin_px - 0.5 for size in area_px)
    return np.stack([y, x, across * np.sin(turn), across * np.cos(turn), charge], axis=1)
