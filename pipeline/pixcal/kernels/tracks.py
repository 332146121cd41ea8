"""Charge that a particle leaves along its straight way through the sensitive layer.

The charge is laid down evenly along the track and spreads on its way to the pixels' gates, which
blurs the track by a Gaussian.
"""

import math

import numpy as np
from scipy.special import erf

from pixcal.model.arrays import F32, F64

STEPS_PER_PX = 4  # points of a track that stand for a pixel of its length
GRAZING = 0.02  # least cosine to the layer's normal: no track is longer than 50 times the depth
_RANGE = 4.0


def add_tracks(charge: F32, tracks: F64, sigma: float, first_row: int) -> None:
    """Add the charge of tracks to a frame (y, x), e-; what falls beside it is lost.

    Parameters
    ----------
    charge : (y, x) e-, changed in place
    tracks : (n, 5) row and column where a track begins, its length along each (px), its charge (e-)
    sigma : width of the blur, px
    first_row : of the frame, among those that the tracks are counted in
    """
    reach = math.ceil(_RANGE * sigma)
    edges = np.arange(2 * reach + 3) - 0.5
    for *start, dy, dx, electrons in tracks:
        points = math.ceil(STEPS_PER_PX * math.hypot(dy, dx)) + 1
        at = start + np.outer((np.arange(points) + 0.5) / points, [dy, dx])
        first = np.floor(at).astype(int) - reach
        # Shares of a Gaussian in the rows, and in the columns, from the first on.
        away = first[:, :, None] + edges - at[:, :, None]
        along_y, along_x = np.diff(erf(away / (math.sqrt(2.0) * sigma)) / 2).swapaxes(0, 1)
        rows, columns = (first[:, n, None] + np.arange(2 * reach + 2) for n in (0, 1))
        rows -= first_row
        along_y[(rows < 0) | (rows >= charge.shape[0])] = 0
        along_x[(columns < 0) | (columns >= charge.shape[1])] = 0
        where = np.clip(rows, 0, len(charge) - 1)[:, :, None]
        there = where, np.clip(columns, 0, charge.shape[1] - 1)[:, None, :]
        np.add.at(charge, there, electrons / points * along_y[:, :, None] * along_x[:, None, :])


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
