"""Charge that collected charge turns away from the pixels' boundaries into their neighbours.

Electrons in a pixel repel those that follow, so that the boundaries around it move inwards: by an
amount in proportion to the charge, smaller with distance, along the line from the charge. Of the
light that falls between the old and the new boundary the neighbour gets the charge. A charge that
grows steadily through the exposure acts with half of its final value on average (Antilogus et al.
2014, JINST 9 C03048; Guyonnet et al. 2015, A&A 575, A41; Astier et al. 2019, A&A 629, A36).

Nothing moves where the charge is the same everywhere, and no charge is lost.
"""

from typing import Any

import numpy as np
from numba import njit

from pixcal.model.arrays import F32, F64

REACH = 2  # pixels on either side of a boundary whose charge acts on it


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


def area_changes(falloff_px: float) -> F64:
    """Area that a pixel gains by a charge in its neighbour: a_ij of Astier et al. 2019.

    In flats the covariance of two pixels is this, times the shift by an electron, times the mean
    charge squared. Of charges at rows and columns ``-REACH`` to ``REACH``, in units of the shift by
    an electron in px; of those at the rim only the nearer boundaries count.
    """
    size = 2 * REACH + 1
    right = np.pad(boundary_shifts(falloff_px), ((0, 0), (1, 0)))
    left = right[:, ::-1]
    across = right + left
    area: F64 = across + across.T
    assert area.shape == (size, size)
    return area


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _push(charge: Any, shifts: Any, along_x: bool, out: Any) -> None:
    """Mean shift of the boundaries after each pixel, of a frame with a margin of `REACH`."""
    ny, nx = out.shape
    high, wide = shifts.shape
    for y in range(ny):
        for x in range(nx):
            out[y, x] = 0
        for i in range(high):
            for j in range(wide):
                s = np.float32(0.5 * shifts[i, j])
                dy, dx = (i, j + 1) if along_x else (j + 1, i)
                for x in range(nx):
                    out[y, x] += s * charge[y + dy, x + dx]


def _pushes(charge: F32, shifts: F64) -> tuple[F32, F32]:
    """Mean shift of the boundaries to the right of and below each pixel (y, x)."""
    around = np.pad(charge, REACH, "edge")
    push_x, push_y = np.empty_like(charge), np.empty_like(charge)
    _push(around, shifts, True, push_x)
    _push(around, shifts, False, push_y)
    return push_x, push_y


def moved_charge(charge: F32, shifts: F64, along_y: float = 1.0) -> F32:
    """What each pixel gains, (y, x) e-; its sum is zero.

    Within `REACH` of the first and last row it is right only if these are edges of the window.

    Parameters
    ----------
    charge : (y, x) float32
        e-, as if boundaries stayed. Beyond the edges it goes on as it is at
        them; through the edges nothing moves.
    shifts : from `boundary_shifts`, times the shift by an electron (px)
    along_y : shift of the boundaries between rows over that of those between columns
    """
    charge = np.ascontiguousarray(charge, np.float32)
    push_x, push_y = _pushes(charge, shifts)
    half, out = np.float32(0.5), np.zeros_like(charge)
    flow = half * (charge[:, :-1] + charge[:, 1:]) * push_x[:, :-1]
    out[:, 1:] -= flow
    out[:, :-1] += flow
    flow = half * (charge[:-1] + charge[1:]) * (push_y[:-1] * np.float32(along_y))
    out[1:] -= flow
    out[:-1] += flow
    return out


def boundary_pushes(charge: F32, shifts: F64) -> tuple[F32, F32]:
    """Mean shift (px) of the boundaries to the right of and below each pixel, in frames (t, y, x).

    The charge is in e-; shifts are as in `moved_charge`.
    """
    x, y = zip(*(_pushes(frame, shifts) for frame in charge), strict=True)
    return np.stack(x), np.stack(y)


def shared_noise(
    charge: F32,
    pushes: tuple[F32, F32],
    shifts: F64,
    step: tuple[int, int],
    axes: tuple[float, float] = (1.0, 1.0),
) -> F32:
    """Covariance (t, y, x) of the shot noise of each pixel and the one at a step from it, e-².

    To first order in the shift, for any scene; zero where either lies within `REACH` of the edges.

    Parameters
    ----------
    charge : (t, y, x) float32
        Mean charge, e-.
    pushes : from `boundary_pushes`
    shifts : as in `moved_charge`
    step : rows and columns
    axes : factors of the shifts of boundaries between columns and between rows
    """
    out = np.zeros_like(charge)
    (dy, dx), (_, ny, nx) = step, charge.shape
    rows = _between(ny, dy)
    columns = _between(nx, dx)
    if rows.start < rows.stop and columns.start < columns.stop:
        v, u = _moved(rows, dy), _moved(columns, dx)
        gain = _gain(charge, pushes, shifts, (rows, columns), (dy, dx), axes)
        back = _gain(charge, pushes, shifts, (v, u), (-dy, -dx), axes)
        out[:, rows, columns] = gain * charge[:, v, u] + back * charge[:, rows, columns]
    return out


def _between(size: int, step: int) -> slice:
    return slice(REACH + max(0, -step), size - REACH - max(0, step))


def _moved(part: slice, by: int) -> slice:
    return slice(part.start + by, part.stop + by)


def _gain(
    q: F32,
    pushes: tuple[F32, F32],
    shifts: F64,
    part: tuple[slice, slice],
    step: tuple[int, int],
    axes: tuple[float, float],
) -> F32:
    """Derivative of what pixels gain by the charge of the one at a step from each."""

    def slope(y: int, x: int, axis: int) -> np.float32:
        i, j = y + REACH, x + REACH - 1
        inside = 0 <= i < shifts.shape[0] and 0 <= j < shifts.shape[1]
        return np.float32(0.25 * axes[axis] * shifts[i, j] if inside else 0)

    (dy, dx), (rows, columns) = step, part
    above, left = _moved(rows, -1), _moved(columns, -1)
    here = q[:, rows, columns]
    total: F32 = slope(dy, dx, 0) * (here + q[:, rows, _moved(columns, 1)])
    total -= slope(dy, dx + 1, 0) * (here + q[:, rows, left])
    total += slope(dx, dy, 1) * (here + q[:, _moved(rows, 1), columns])
    total -= slope(dx, dy + 1, 1) * (here + q[:, above, columns])
    across, along = (np.float32(0.5 * factor) for factor in axes)
    # The neighbour across a boundary also widens what the shift of the boundary takes.
    if (dy, dx) == (0, 1):
        total += across * pushes[0][:, rows, columns]
    elif (dy, dx) == (0, -1):
        total -= across * pushes[0][:, rows, left]
    elif (dy, dx) == (1, 0):
        total += along * pushes[1][:, rows, columns]
    elif (dy, dx) == (-1, 0):
        total -= along * pushes[1][:, above, columns]
    return total
