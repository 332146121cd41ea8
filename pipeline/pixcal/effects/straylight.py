"""Light that does not interfere: laser light scattered in the bench, with a smooth pattern."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.polynomial.legendre import legvander

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.beams import Light
from pixcal.kernels.scene import DetectorMaps, Rows
from pixcal.model.arrays import F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, FringeMaps, LightStart, Stage
from pixcal.simulation.forward import Scalable
from pixcal.simulation.recording import Recording

DEGREE = 8  # of the polynomials of a measured pattern


@lru_cache(maxsize=8)
def _polynomials(places: bytes) -> F64:
    """Legendre polynomials (place, order) at places (float64) from -1 to 1."""
    return np.asarray(legvander(np.frombuffer(places), DEGREE))


@dataclass(frozen=True)
class StrayPattern(Scalable):
    """Stray light as measured in one fringe set, on a part of the detector."""

    strengths = ("coefficients",)

    set: str = quantity(doc="name of the fringe set")
    rows: tuple[int, int] = quantity(doc="first row of the part, and the one after the last")
    columns: tuple[int, int] = quantity(doc="first column, and the one after the last")
    coefficients: tuple[float, ...] = quantity(
        low=-20, high=20, doc="coefficients of Legendre products in log(1 + share), by total degree"
    )

    def share(self, rows: F64, columns: F64) -> F64:
        """Share (y, x) of the fibres' light, never negative; outside the part, that at its edge."""
        (y0, y1), (x0, x1) = self.rows, self.columns
        y = np.clip(2 * (rows - y0) / max(y1 - y0 - 1, 1) - 1, -1, 1)
        x = np.clip(2 * (columns - x0) / max(x1 - x0 - 1, 1) - 1, -1, 1)
        orders = [(i, n - i) for n in range(DEGREE + 1) for i in range(n + 1)]
        products = np.zeros((DEGREE + 1, DEGREE + 1))
        for at, value in zip(orders, self.coefficients, strict=False):
            products[at] = value
        grid = np.linspace(-1, 1, 33)
        inside, terms = (
            _polynomials(down.tobytes()) @ products @ _polynomials(along.tobytes()).T
            for down, along in ((grid, grid), (y, x))
        )
        return np.asarray(np.expm1(np.maximum(terms - inside.min(), 0.0)))


@dataclass(frozen=True)
class Straylight(Effect):
    """Incoherent light in the fringe frames, relative to the light of the fibres."""

    name = "straylight"
    title = "scattered light that does not interfere"
    acts_at = Stage.LIGHT
    order = 8
    domains = ("space",)
    strengths = ("share", "slope_per_px", "bump", "patterns")
    smooth_degree = 2  # degree that two Gaussian beams cause in the logarithm of the visibility
    frames_needed = ("axis",)
    sources = (
        "Rousset et al., eq. 3: straylight is a part of the mean term B iota",
        "Harvey et al. 2012, Opt. Eng. 51, 013402: a clean surface of 2 nm rms scatters "
        "(4 pi 2 / 633)^2 = 0.16 %; black walls reflect a few per cent of the light "
        "that misses the detector",
    )

    share: float = quantity(0.02, low=0, high=10)
    """ratio to the light of the fibres in the first pixel of the window"""
    slope_per_px: tuple[float, float] = quantity((4e-5, -2e-5), unit="1/px", low=-1, high=1)
    """gradient of the share along x and y"""
    bump: float = quantity(0.0, low=0, high=10)
    """peak share of a round spot"""
    bump_centre_px: tuple[float, float] = quantity((0.0, 0.0), unit="px", low=-1e5, high=1e5)
    """centre of the spot, column and row of the window"""
    bump_radius_px: float = quantity(30.0, unit="px", above=0, high=1e5)
    """standard deviation of the spot"""
    patterns: tuple[StrayPattern, ...] = quantity(())
    """measured pattern of each set"""

    def pattern(self, rows: Rows, columns: Rows, of: str = "") -> F64:
        """Share (y, x) in a set on rows and columns of the window (first, one after the last)."""
        y, x = np.arange(*rows, dtype=float), np.arange(*columns, dtype=float)
        share = self.share + self.slope_per_px[0] * x + self.slope_per_px[1] * y[:, None]
        if self.bump:
            dx, dy = x - self.bump_centre_px[0], y[:, None] - self.bump_centre_px[1]
            share = share + self.bump * np.exp(-(dx**2 + dy**2) / (2 * self.bump_radius_px**2))
        for pattern in self.patterns:
            if pattern.set == of:
                share = share + pattern.share(y, x)
        return np.asarray(np.maximum(share, 0.0))

    def light(self, light: Light, recording: Recording, rows: Rows, maps: DetectorMaps) -> Light:
        if recording.kind != "fringes":
            return light
        share = self.pattern(rows, (0, maps.response.shape[1]), recording.set_name)
        return light.with_incoherent(share * light.power)

    def predict(self, maps: FringeMaps) -> FringeMaps:
        """As in `Effect.predict`: only iota changes."""
        return replace(maps, theta=np.stack([maps.theta[0] * self._more(maps), *maps.theta[1:]]))

    def undo(self, maps: FringeMaps) -> FringeMaps:
        return replace(maps, theta=np.stack([maps.theta[0] / self._more(maps), *maps.theta[1:]]))

    def _more(self, maps: FringeMaps) -> F64:
        (row, column), (ny, nx) = maps.origin, maps.theta.shape[1:]
        return 1 + self.pattern((row, row + ny), (column, column + nx), maps.name)

    @classmethod
    def starts(cls, evidence: Evidence) -> list[LightStart]:
        """A separate pattern for each set, of any smooth shape."""
        nothing = (0.0,) * ((DEGREE + 1) * (DEGREE + 2) // 2)
        patterns = []
        for f in evidence.fringes.values():
            (y, x), (ny, nx) = f.origin, f.good.shape
            patterns.append(StrayPattern(f.name, (y, y + ny), (x, x + nx), nothing))
        start = cls(0.0, (0.0, 0.0), patterns=tuple(patterns))
        return [LightStart(start, ("patterns",), "smooth pattern of any shape")]
