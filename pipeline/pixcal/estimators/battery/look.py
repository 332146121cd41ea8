"""One fringe set as the statistics look at it: residuals in units of their noise, maps, frames."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.evidence import Evidence, FringeEvidence
from pixcal.estimators.structure import clipped, smooth_surface

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

WILD = 8.0
"""Standard deviations beyond which a residual counts as an outlier and no more."""


@dataclass(frozen=True)
class Look:
    """A fringe set of some evidence, and what several statistics need of it.

    Attributes
    ----------
    found : FringeEvidence
    evidence : Evidence
    """

    found: FringeEvidence
    evidence: Evidence

    @property
    def good(self) -> Mask:
        """Pixels (y, x) that are looked at."""
        return self.found.good

    @cached_property
    def wild(self) -> F32:
        """Residuals (t, y, x) over their noise, outliers included; NaN without weight."""
        return np.asarray(self.found.residual / np.sqrt(self.found.variance), np.float32)

    @cached_property
    def residual(self) -> F32:
        """Residuals (t, y, x) over their noise; zero for outliers and where there is no weight."""
        calm = np.nan_to_num(self.wild, nan=0.0)
        calm[np.abs(calm) > WILD] = 0
        return np.asarray(calm * self.good, np.float32)

    @cached_property
    def level(self) -> F32:
        """Model (t, pixel) of the good pixels, e-."""
        return np.asarray(self.found.model[:, self.good])

    @cached_property
    def level_bins(self) -> tuple[NDArray[np.intp], F64]:
        """Bin (t, pixel) of every sample by its level, and the middle of each bin, e-."""
        low, high = np.quantile(self.level[:: max(1, len(self.level) // 40)], (0.005, 0.995))
        edges = np.linspace(low, high, LEVELS + 1)
        scale = np.float32(LEVELS / max(high - low, 1e-9))
        bins = ((self.level - np.float32(low)) * scale).astype(np.intp)
        return np.clip(bins, 0, LEVELS - 1, out=bins), (edges[1:] + edges[:-1]) / 2

    @cached_property
    def psi(self) -> F64:
        """Phase (y, x) of the pixels, rad."""
        return np.asarray(np.arctan2(self.found.theta[1], self.found.theta[2]))

    @cached_property
    def maps(self) -> dict[str, F64]:
        """Offset (px), contrast and light (relative), (y, x) about zero; NaN in bad pixels."""
        theta, good = self.found.theta, self.good
        iota = np.where(good, theta[0], np.nan)
        contrast = np.where(good, np.hypot(theta[1], theta[2]), np.nan) / iota
        light = iota / smooth_surface(iota, good)
        return {
            "offset": clipped(np.where(good, self.found.delta, np.nan)),
            "contrast": clipped(contrast / np.nanmedian(contrast) - 1),
            "light": clipped(light - 1),
        }

    @cached_property
    def frames(self) -> dict[str, F64]:
        """Per frame (t,): intensity and contrast (relative), turns of the fringe vector edge to
        edge along and across it (rad)."""
        b, a_cos, a_sin, dkx, dky = self.found.free.T
        contrast = np.hypot(a_cos, a_sin) / b
        ny, nx = self.good.shape
        kx, ky = self.found.k
        size = float(np.hypot(kx, ky))
        span = float(np.hypot(kx * nx, ky * ny)) / size
        return {
            "intensity": b / b.mean() - 1,
            "contrast": contrast / contrast.mean() - 1,
            "turn_along": (kx * dkx + ky * dky) / size * span,
            "turn_across": (kx * dky - ky * dkx) / size * span,
        }


LEVELS = 8
"""Bins of level."""
