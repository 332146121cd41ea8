"""Windows that tile a frame along its fringes, and the polynomials that follow phase and light."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

from pixcal.model.arrays import F64
from pixcal.model.errors import InputError

Vector = tuple[float, float]

# Fewest across a window. Half an odd number: points of neighbours lie on crest and valley.
FRINGES_A_WINDOW = 2.5
# fewest pixels across a window: where fringes run along the columns, the model's seven functions
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
        # A hair outwards: the outermost pixels must not fall out by rounding.
        edge = (float(across.min()) - 1e-9, float(along.min()) - 1e-9)
        return cls(frame, (ux, uy), edge, size, (n_across, n_along))

    @property
    def layout(self) -> F64:
        """As `pixcal.kernels.demodulation.window_sums` takes it."""
        return np.array([*self.direction, *self.edge, *self.size])

    @cached_property
    def centres(self) -> tuple[F64, F64]:
        """y and x (across, along) of the windows' centres, px."""
        u = self.edge[0] + (np.arange(self.shape[0])[:, None] + 0.5) * self.size[0]
        v = self.edge[1] + (np.arange(self.shape[1])[None, :] + 0.5) * self.size[1]
        ux, uy = self.direction
        return uy * u + ux * v, ux * u - uy * v

    def touched(self, y: tuple[int, int], x: tuple[int, int]) -> tuple[tuple[int, int], ...]:
        """First window, and the one after the last, across and along, that a tile touches."""
        ux, uy = self.direction
        at_x = np.array([x[0], x[1] - 1, x[0], x[1] - 1])
        at_y = np.array([y[0], y[0], y[1] - 1, y[1] - 1])
        spans = []
        for n, at in enumerate((ux * at_x + uy * at_y, ux * at_y - uy * at_x)):
            number = np.floor((at - self.edge[n]) / self.size[n])
            # One more on each side for what rounding does to pixels on a border.
            spans.append((int(number.min()) - 1, int(number.max()) + 2))
        return tuple((max(0, a), min(n, b)) for (a, b), n in zip(spans, self.shape, strict=True))


@dataclass(frozen=True)
class Smooth:
    """A polynomial ``sum c[i, j] Y^i X^j`` of scaled pixel coordinates."""

    coefficients: F64  # (n, n)
    centre: Vector  # (y, x) where X = Y = 0, px
    scale: float  # pixels to a unit of X and Y

    @classmethod
    def plane(cls, slope: Vector, frame: tuple[int, int]) -> Self:
        """A plane of slope (x, y) a pixel, zero at the frame's centre."""
        scale = max(frame) / 2
        c = np.array([[0.0, slope[0] * scale], [slope[1] * scale, 0.0]])
        return cls(c, ((frame[0] - 1) / 2, (frame[1] - 1) / 2), scale)

    def scaled(self, y: F64, x: F64) -> tuple[F64, F64]:
        """Y and X at pixel coordinates."""
        return (y - self.centre[0]) / self.scale, (x - self.centre[1]) / self.scale

    def on(self, y: F64, x: F64) -> F64:
        """Value at pixel coordinates."""
        return np.asarray(polynomial.polyval2d(*self.scaled(y, x), self.coefficients))

    def gradient(self, y: F64, x: F64) -> tuple[F64, F64]:
        """Derivatives (by x, by y) at pixel coordinates, 1/px."""
        at = self.scaled(y, x)
        by_y, by_x = (polynomial.polyder(self.coefficients / self.scale, axis=n) for n in (0, 1))
        values = [np.asarray(polynomial.polyval2d(*at, c), float) for c in (by_x, by_y)]
        return values[0], values[1]

    def plus(self, powers: list[tuple[int, int]], values: NDArray[Any]) -> "Smooth":
        """The polynomial with terms added to it."""
        size = max(max(powers)[0] + 1, len(self.coefficients))
        total = np.zeros((size, size))
        total[: len(self.coefficients), : len(self.coefficients)] = self.coefficients
        np.add.at(total, tuple(np.transpose(powers)), values)
        return replace(self, coefficients=total)


@dataclass(frozen=True)
class CrestCarrier:
    """What a frame is demodulated with."""

    phase: Smooth  # rad
    light: Smooth  # natural logarithm of the illumination; coordinates scaled as those of `phase`

    @classmethod
    def straight(cls, k: Vector, frame: tuple[int, int]) -> Self:
        """Straight fringes of a vector (kx, ky) and even light."""
        return cls(Smooth.plane(k, frame), Smooth.plane((0.0, 0.0), frame))
