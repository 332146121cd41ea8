"""Windows that follow the fringes of a frame, and the phase of the fringes in each window.

The frame is first divided by a smooth illumination. The model of each window is a quadratic
background and fringes whose contrast and phase may change linearly,
``b0 + b1 u + b2 v + b3 u² + b4 u v + b5 v² + (1, u, v) × (cos P, sin P)``, u and v from -1 to 1
across and along the fringes and P a smooth carrier. The normal equations of this model add up:
windows may be cut by any tiling of the frame.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from pixcal.kernels import kernel
from pixcal.kernels.normal_matrix import symmetric
from pixcal.model.arrays import F64, Mask
from pixcal.model.errors import InputError

Vector = tuple[float, float]

N_TERMS = 12
# where the terms of cos P and sin P begin; the first of each is that of the window's centre
COSINE, SINE = 6, 9
# upper triangle of the normal matrix, right-hand side, sum of squares, number of samples
N_SUMS = N_TERMS * (N_TERMS + 1) // 2 + N_TERMS + 2
# Fewest fringes across a window. Half an odd number: neighbours' points lie on crest and valley.
FRINGES_A_WINDOW = 2.5
# fewest pixels across a window: if fringes run along the columns, the model's seven functions
# across them need as many samples and more
MIN_WIDTH = 12.0


@dataclass(frozen=True)
class Windows:
    """Rectangles that tile a frame, their sides across and along the fringes."""

    frame: tuple[int, int]  # (y, x) size of the frame
    direction: Vector  # unit vector (x, y) across the fringes
    edge: Vector  # first edge across and along, px
    size: Vector  # of a window across and along, px
    shape: tuple[int, int]  # windows across and along

    @classmethod
    def lay(cls, frame: tuple[int, int], k: Vector, segment: int | None = None) -> Self:
        """Windows over a frame for a fringe vector (kx, ky), rad/px."""
        ny, nx = frame
        length = float(np.hypot(*k))
        ux, uy = k[0] / length, k[1] / length
        fringes = max(FRINGES_A_WINDOW, np.ceil(MIN_WIDTH * length / (2 * np.pi) - 0.5) + 0.5)
        width = 2 * np.pi * fringes / length
        corner_x = np.array([-0.5, nx - 0.5, -0.5, nx - 0.5])
        corner_y = np.array([-0.5, -0.5, ny - 0.5, ny - 0.5])
        across, along = ux * corner_x + uy * corner_y, ux * corner_y - uy * corner_x
        if np.ptp(across) < 2 * width:
            raise InputError(
                f"too few fringes: {np.ptp(across) * length / (2 * np.pi):.1f} across {nx} x {ny} "
                f"px, crests need {2 * fringes:.0f}; take a larger window"
            )
        if segment is None:
            segment = int(np.clip(np.ptp(along) / 8, 8, 128))
        n_across = int(np.ptp(across) / width)
        n_along = max(1, round(np.ptp(along) / segment))
        size = (float(np.ptp(across) / n_across), float(np.ptp(along) / n_along))
        # Slightly outwards, so that rounding does not exclude the outermost pixels.
        edge = (float(across.min()) - 1e-9, float(along.min()) - 1e-9)
        return cls(frame, (ux, uy), edge, size, (n_across, n_along))

    @cached_property
    def centres(self) -> tuple[F64, F64]:
        """y and x (across, along) of the windows' centres, px."""
        u = self.edge[0] + (np.arange(self.shape[0])[:, None] + 0.5) * self.size[0]
        v = self.edge[1] + (np.arange(self.shape[1])[None, :] + 0.5) * self.size[1]
        ux, uy = self.direction
        return uy * u + ux * v, ux * u - uy * v

    def touched(self, y: tuple[int, int], x: tuple[int, int]) -> tuple[tuple[int, int], ...]:
        """First and one past the last window, across and along, that a tile overlaps."""
        ux, uy = self.direction
        at_x = np.array([x[0], x[1] - 1, x[0], x[1] - 1])
        at_y = np.array([y[0], y[0], y[1] - 1, y[1] - 1])
        spans = []
        for n, at in enumerate((ux * at_x + uy * at_y, ux * at_y - uy * at_x)):
            number = np.floor((at - self.edge[n]) / self.size[n])
            # One more on each side, because of rounding at pixels on a border.
            spans.append((int(number.min()) - 1, int(number.max()) + 2))
        return tuple((max(0, a), min(n, b)) for (a, b), n in zip(spans, self.shape, strict=True))


@dataclass(frozen=True)
class CrestCarrier:
    """Carrier to demodulate a frame: polynomials ``sum c[i, j] Y^i X^j`` of scaled pixels."""

    phase: F64  # (n, n) of the phase, rad
    light: F64  # (n, n) of the natural logarithm of the illumination
    centre: Vector  # (y, x) where X = Y = 0, px
    scale: float  # pixels to a unit of X and Y

    @classmethod
    def straight(cls, k: Vector, frame: tuple[int, int]) -> Self:
        """Straight fringes of a vector (kx, ky), zero phase at the centre, and uniform light."""
        scale = max(frame) / 2
        slope = np.array([[0.0, k[0]], [k[1], 0.0]]) * scale
        return cls(slope, np.zeros((2, 2)), ((frame[0] - 1) / 2, (frame[1] - 1) / 2), scale)

    def scaled(self, y: F64, x: F64) -> tuple[F64, F64]:
        """Y and X at pixel coordinates."""
        return (y - self.centre[0]) / self.scale, (x - self.centre[1]) / self.scale

    def at(self, y: F64, x: F64) -> F64:
        """Phase at pixel coordinates, rad."""
        return np.asarray(polynomial.polyval2d(*self.scaled(y, x), self.phase))

    def vector(self, y: F64, x: F64) -> tuple[F64, F64]:
        """Fringe vector (kx, ky) at pixel coordinates, rad/px."""
        at = self.scaled(y, x)
        by_y, by_x = (polynomial.polyder(self.phase / self.scale, axis=n) for n in (0, 1))
        kx, ky = (np.asarray(polynomial.polyval2d(*at, c), float) for c in (by_x, by_y))
        return kx, ky


def tile_sums(
    signal: NDArray[Any],
    good: Mask,
    start: tuple[int, int],
    windows: Windows,
    carrier: CrestCarrier,
) -> tuple[tuple[int, int], F64]:
    """Indices of the first window that a tile overlaps, and sums (across, along, N_SUMS).

    ``signal, good``: e- and samples to use (y, x), from pixel ``start`` (y, x) of the frame on.
    """
    y, x = ((at, at + n) for at, n in zip(start, signal.shape, strict=True))
    (i0, i1), (j0, j1) = windows.touched(y, x)
    sums = np.zeros((i1 - i0, j1 - j0, N_SUMS))
    layout = np.array([*windows.direction, *windows.edge, *windows.size])
    frame = np.array([carrier.centre[1], carrier.centre[0], carrier.scale])
    _add(signal, good, start, layout, (i0, j0), (carrier.phase, carrier.light), frame, sums)
    return (i0, j0), sums


@kernel(inline="always")
def _horner(coefficients: F64, x: float) -> float:
    value = 0.0
    for n in range(coefficients.size - 1, -1, -1):
        value = value * x + coefficients[n]
    return value


@kernel()
def _add(
    signal: Any,
    good: Any,
    start: Any,
    layout: F64,
    first: Any,
    polynomials: Any,
    frame: F64,
    sums: F64,
) -> None:
    """Add a tile's samples to ``sums``, whose [0, 0] is window ``first``."""
    # ``layout``: direction cosines (x, y), first edge and size of windows across and along, px.
    # ``polynomials`` of phase and light: ``c[i, j] Y^i X^j``, (X, Y) being (x, y) less
    # ``frame[:2]``, over ``frame[2]``.
    ux, uy, edge_u, edge_v, width, length = layout
    carrier, light = polynomials
    row, light_row = np.empty(carrier.shape[0]), np.empty(light.shape[0])
    term = np.empty(N_TERMS)
    for n in range(signal.shape[0]):
        y = float(start[0] + n)
        scaled = (y - frame[1]) / frame[2]
        for j in range(row.size):
            row[j] = _horner(carrier[:, j], scaled)
        for j in range(light_row.size):
            light_row[j] = _horner(light[:, j], scaled)
        for m in range(signal.shape[1]):
            if not good[n, m]:
                continue
            x = float(start[1] + m)
            across = (ux * x + uy * y - edge_u) / width
            along = (ux * y - uy * x - edge_v) / length
            i, j = int(np.floor(across)), int(np.floor(along))
            u, v = 2 * (across - i) - 1, 2 * (along - j) - 1
            place = sums[i - first[0], j - first[1]]
            scaled = (x - frame[0]) / frame[2]
            phase = _horner(row, scaled)
            c, s = np.cos(phase), np.sin(phase)
            term[0], term[1], term[2] = 1.0, u, v
            term[3], term[4], term[5] = u * u, u * v, v * v
            term[6], term[7], term[8] = c, u * c, v * c
            term[9], term[10], term[11] = s, u * s, v * s
            value = float(signal[n, m]) * np.exp(-_horner(light_row, scaled))
            at = 0
            for p in range(N_TERMS):
                for q in range(p, N_TERMS):
                    place[at] += term[p] * term[q]
                    at += 1
            for p in range(N_TERMS):
                place[at + p] += term[p] * value
            place[at + N_TERMS] += value * value
            place[at + N_TERMS + 1] += 1.0


def solve_windows(sums: F64) -> tuple[F64, F64, F64]:
    """Phase, error (infinite if unknown) and light of each window, from sums (window, N_SUMS).

    Delta in ``cos(P + delta)`` at the centre, ±pi rad; error by the scatter about the model, rad.
    """
    count = sums[:, -1]
    phase, background = np.zeros(len(sums)), np.zeros(len(sums))
    sigma = np.full(len(sums), np.inf)
    use = np.flatnonzero(count >= 3 * N_TERMS)
    size = N_TERMS * (N_TERMS + 1) // 2
    normal = symmetric(sums[use, :size])
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-300))
    normal /= scale[:, :, None] * scale[:, None, :]
    # Below rounding errors of good windows; windows that it changes get unusably large errors.
    normal += 1e-13 * np.eye(N_TERMS)
    inverse = np.linalg.inv(normal)
    right = sums[use, size : size + N_TERMS] / scale
    solved = np.einsum("nij,nj->ni", inverse, right)
    rest = sums[use, -2] - np.einsum("ni,ni->n", solved, right)
    # Limited by the digits of a difference of two large numbers.
    variance = np.maximum(rest, 1e-15 * sums[use, -2]) / (count[use] - N_TERMS)
    theta, pair = solved / scale, [COSINE, SINE]
    covariance = inverse[:, pair][:, :, pair] / (scale[:, pair, None] * scale[:, None, pair])
    a, b = theta[:, COSINE], theta[:, SINE]
    square = np.maximum(a * a + b * b, 1e-300)
    slope = np.stack([b, -a], axis=1) / square[:, None]
    error = variance * np.einsum("ni,nij,nj->n", slope, covariance, slope)
    phase[use], background[use] = np.arctan2(-b, a), theta[:, 0]
    sigma[use] = np.where(error > 0, np.sqrt(np.abs(error)), np.inf)
    return phase, sigma, background
