"""Charge that collected charge deflects across pixel boundaries into neighbours.

Electrons in a pixel repel those that follow, so that the boundaries around it move inwards, in
proportion to the charge, less with distance, along the line from the charge. The neighbour collects
the light that falls between the old and the new boundary. A charge that
grows steadily through the exposure acts with half of its final value on average (Antilogus et al.
2014, JINST 9 C03048; Guyonnet et al. 2015, A&A 575, A41; Astier et al. 2019, A&A 629, A36).

Nothing moves where the charge is the same everywhere, and no charge is lost.
"""

from typing import Any

import numpy as np

from pixcal.kernels import kernel
from pixcal.model.arrays import F32, F64

# Pixels on either side of a boundary whose charge acts on it. With two, the shift under broad
# fringes would be a quarter too small, and harmonics contradict the noise of neighbours.
REACH = 4


def boundary_shifts(falloff_px: float) -> F64:
    """Shift of the boundary between a pixel and the next one along x, by the charges around it.

    The shift falls by a factor e in ``falloff_px``. Of charges at rows ``-REACH`` to ``REACH`` and
    columns ``1 - REACH`` to ``REACH`` from the pixel: (2 REACH + 1, 2 REACH) in units of the shift
    by the pixel's own charge, positive to the right.
    """
    y = np.arange(-REACH, REACH + 1)[:, None]
    x = 0.5 - np.arange(1 - REACH, REACH + 1)[None, :]
    distance = np.hypot(y, x)
    shift: F64 = -np.exp(-(distance - 0.5) / falloff_px) * x / distance
    return shift


# Loops, where a slice could be assigned: that takes seconds to compile.
@kernel()
def _push(charge: Any, shifts: Any, wide: Any, right: Any, below: Any) -> None:
    """Mean shift of the boundaries on two sides of each pixel of a frame; ``wide`` is scratch."""
    ny, nx = charge.shape
    for y in range(ny + 2 * REACH):
        inside = charge[min(max(y - REACH, 0), ny - 1)]
        for x in range(nx + 2 * REACH):
            wide[y, x] = inside[min(max(x - REACH, 0), nx - 1)]
    high, wide_by = shifts.shape
    for axis in range(2):
        for y in range(ny):
            out = below[y] if axis else right[y]
            for x in range(nx):
                out[x] = 0
            for i in range(high):
                for j in range(wide_by):
                    s = np.float32(0.5 * shifts[i, j])
                    dy, dx = (j + 1, i) if axis else (i, j + 1)
                    row = wide[y + dy, dx : dx + nx]
                    for x in range(nx):
                        out[x] += s * row[x]


def moved_charge(charge: F32, shifts: F64, along_y: float = 1.0, light: F32 | None = None) -> F32:
    """Charge that each pixel of frames (y, x) or (t, y, x) gains, e-; its sum is zero.

    Within `REACH` of the first and last row it is right only if these are edges of the window.

    charge : (y, x) or (t, y, x) e-, as if boundaries stayed. Beyond the edges it continues
    unchanged; nothing moves through the edges.
    shifts : from `boundary_shifts`, times the shift by an electron (px)
    along_y : shift of the boundaries between rows over that of those between columns
    light : part of the charge that falls on boundaries too; else all
    """
    lit = charge if light is None else light
    charge = np.ascontiguousarray(charge, np.float32)
    out = np.zeros_like(charge)
    ny, nx = charge.shape[-2:]
    wide = np.empty((ny + 2 * REACH, nx + 2 * REACH), np.float32)
    right, below = np.empty((2, ny, nx), np.float32)
    half, factor = np.float32(0.5), np.float32(along_y)
    for pushing, q, gain in zip(*(a.reshape(-1, ny, nx) for a in (charge, lit, out)), strict=True):
        _push(pushing, shifts, wide, right, below)
        flow = half * (q[:, :-1] + q[:, 1:]) * right[:, :-1]
        gain[:, 1:] -= flow
        gain[:, :-1] += flow
        flow = half * (q[:-1] + q[1:]) * below[:-1] * factor
        gain[1:] -= flow
        gain[:-1] += flow
    return out


def mean_boundary_shifts(charge: F32, shifts: F64) -> tuple[F32, F32]:
    """Mean shift (px) of the boundaries to the right of and below each pixel, in frames (t, y, x).

    The charge is in e-; shifts are as in `moved_charge`.
    """
    ny, nx = charge.shape[1:]
    wide = np.empty((ny + 2 * REACH, nx + 2 * REACH), np.float32)
    push_x, push_y = np.empty(charge.shape, np.float32), np.empty(charge.shape, np.float32)
    for frame, right, below in zip(charge, push_x, push_y, strict=True):
        _push(frame, shifts, wide, right, below)
    return push_x, push_y


def shared_noise(
    charge: F32,
    pushes: tuple[F32, F32],
    shifts: F64,
    step: tuple[int, int],
    axes: tuple[float, float] = (1.0, 1.0),
) -> F32:
    """Covariance (t, y, x) of the shot noise of each pixel and the one at a step from it, e-².

    To first order in the shift, for any scene; zero where either lies within `REACH` of the edges.

    ``charge``: (t, y, x) mean charge, e-; ``pushes``: from `mean_boundary_shifts`; ``shifts``: as
    in `moved_charge`; ``step``: rows and columns; ``axes``: factors of the shifts of boundaries
    between columns and between rows.
    """
    out = np.zeros_like(charge)
    (dy, dx), (right, below), (ny, nx) = step, pushes, charge.shape[1:]
    rows = max(REACH, REACH - dy), ny - max(REACH, REACH + dy)
    columns = max(REACH, REACH - dx), nx - max(REACH, REACH + dx)

    def at(values: F32, y: int, x: int) -> F32:
        return values[:, rows[0] + y : rows[1] + y, columns[0] + x : columns[1] + x]

    def gain(y: int, x: int, slopes: F64) -> F32:
        """Derivative of the gain of the pixels at a step by the charge of their partners."""
        own, total = at(charge, y, x), np.zeros_like(at(charge, y, x))
        pushing = at(right, y, x), at(right, y, x - 1), at(below, y, x), at(below, y - 1, x)
        for (v, u), push, (by_shift, by_charge) in zip(_SIDES, pushing, slopes.T, strict=True):
            if by_shift:
                total += np.float32(by_shift) * (own + at(charge, y + v, x + u))
            if by_charge:
                total += np.float32(by_charge) * push
        return total

    there, back = _slopes(shifts, dy, dx, axes), _slopes(shifts, -dy, -dx, axes)
    shared = gain(0, 0, there) * at(charge, dy, dx) + gain(dy, dx, back) * at(charge, 0, 0)
    at(out, 0, 0)[:] = shared
    return out


_SIDES = (0, 1), (0, -1), (1, 0), (-1, 0)  # pixels across the boundaries of a pixel


def _slopes(shifts: F64, dy: int, dx: int, axes: tuple[float, float]) -> F64:
    """Derivative of the charge a pixel gains through its boundaries by the charge of another."""
    # Two factors (2, 4) for the boundaries to the right, to the left, below and above: of the
    # charge on both sides, as the other pixel moves the boundary; and of the boundary's shift, as
    # the other pixel, if it is the neighbour across, changes that charge.

    def slope(y: int, x: int, axis: int) -> float:
        i, j = y + REACH, x + REACH - 1
        inside = 0 <= i < shifts.shape[0] and 0 <= j < shifts.shape[1]
        return 0.25 * axes[axis] * shifts[i, j] if inside else 0.0

    by_shift = slope(dy, dx, 0), -slope(dy, dx + 1, 0), slope(dx, dy, 1), -slope(dx, dy + 1, 1)
    signs = axes[0] / 2, -axes[0] / 2, axes[1] / 2, -axes[1] / 2
    by_charge = [n if (dy, dx) == side else 0.0 for n, side in zip(signs, _SIDES, strict=True)]
    return np.array([by_shift, by_charge])
