"""Patterns in maps of offsets that the figures measure: modes, teeth, crests, chance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from truth import harmonics, plane, without

F64 = NDArray[np.float64]


def sloping_harmonics(shape: tuple[int, int], vector: tuple[float, float]) -> F64:
    """The same, and with strengths that grow along x and y (12, y, x).

    A moving fringe vector that is held constant leaves the latter (physics note, section 2).
    """
    waves, slopes = harmonics(shape, vector), plane(shape)
    return np.asarray((slopes[:, None] * waves).reshape(-1, *shape))


def teeth(values: F64, period: int) -> F64:
    """Mean (period,) of rows (y, x) that are whole periods apart, less the mean of all.

    Two rows and columns at the window's edges are left out.
    """
    inner = values[2:-2, 2:-2]
    row = (np.arange(len(inner)) + 2) % period
    means = np.array([np.nanmean(inner[row == n]) for n in range(period)])
    return np.asarray(means - means.mean())


@dataclass(frozen=True)
class Crest:
    """Second-order surface of a map about the window's middle."""

    # xx, xy, yy: px per px²: the surface is ``xx u² + xy u v + yy v²``, u and v along x and y
    xx: float
    xy: float
    yy: float
    reach: float  # peak to peak of the surface over the window, less a plane, px

    @classmethod
    def of(cls, values: F64) -> "Crest":
        """Fitted to a map (y, x); NaN are left out."""
        ny, nx = values.shape
        v, u = np.indices(values.shape, dtype=float)
        u, v = u - (nx - 1) / 2, v - (ny - 1) / 2
        basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v])
        good = np.isfinite(values)
        found = np.linalg.lstsq(basis[:, good].T, values[good], rcond=None)[0]
        surface = without(np.tensordot(found, basis, 1), plane((ny, nx)))
        xx, xy, yy = found[3:].tolist()
        return cls(xx, xy, yy, float(np.ptp(surface)))

    @property
    def ridge_deg(self) -> float:
        """Direction of the crest's line, degrees from x, in ±90: where the surface bends least."""
        bending = np.array([[self.xx, self.xy / 2], [self.xy / 2, self.yy]])
        values, vectors = np.linalg.eigh(bending)
        x, y = vectors[:, np.argmin(np.abs(values))]
        return float((np.degrees(np.arctan2(y, x)) + 90) % 180 - 90)

    def fibre_offset(self, distance: float, pitch: float, axis: int) -> tuple[float, float]:
        """Foot of the fibres' centre from the window's middle that bends fringes so, mm.

        To leading order the straight model leaves ``-q_a q² / (2 D²)`` on the fringe axis a, q from
        the foot: about a point far from it, its second order is
        ``(3 c_a u_a² + 2 c_b u_a u_b + c_a u_b²) p / (2 D²)``, c the offset. ``distance, pitch``:
        mm. ``axis``: 0 where the fringe vector is along x, 1 along y.
        """
        scale = pitch / (2 * distance**2)
        along, across = (self.xx, self.yy) if axis == 0 else (self.yy, self.xx)
        own, other = (3 * along + across) / 10 / scale, self.xy / 2 / scale
        return (own, other) if axis == 0 else (other, own)


@dataclass(frozen=True)
class Whiteness:
    """Whether a map of errors is due to chance alone; each in units of its chance scatter."""

    # neighbours_x, neighbours_y: correlation of neighbours
    neighbours_x: float
    neighbours_y: float
    # rows, columns: scatter of the means of rows and of columns, above what pixels let expect
    rows: float
    columns: float
    peak: float  # chance of a peak as high as the highest of the power spectrum

    @classmethod
    def of(cls, errors: F64) -> "Whiteness":
        """Of a map (y, x) without gaps."""
        e = (errors - errors.mean()) / errors.std()
        ny, nx = e.shape
        power = np.abs(np.fft.fft2(e)) ** 2 / e.size
        # A real map has each frequency twice; what the modes take out is not there.
        independent = e.size / 2
        return cls(
            neighbours_x=float(np.sum(e[:, 1:] * e[:, :-1]) / np.sqrt(ny * (nx - 1))),
            neighbours_y=float(np.sum(e[1:] * e[:-1]) / np.sqrt((ny - 1) * nx)),
            rows=float((np.sum(e.mean(axis=1) ** 2) * nx - (ny - 1)) / np.sqrt(2 * (ny - 1))),
            columns=float((np.sum(e.mean(axis=0) ** 2) * ny - (nx - 1)) / np.sqrt(2 * (nx - 1))),
            peak=float(-np.expm1(independent * np.log1p(-np.exp(-power.max())))),
        )
