"""A fringe set as the fit describes it, to be simulated again."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pixcal.estimators.maps.corrected import corrected_offsets, phase_change, straight_modes
from pixcal.estimators.maps.structure import OffsetModel, smooth_surface, true_offsets
from pixcal.kernels.crosstalk import filled
from pixcal.model.arrays import F32, F64, Mask
from pixcal.simulation.effect import Effect, FittedFrames, FringeMaps
from pixcal.stages.diagnose.undone import FitOfFrames, undone_on_samples

# degree, over a window, of the logarithm of the contrast of two Gaussian beams (their intensities'
# ratio is the exponential of a quadratic form)
TWO_BEAMS = 2


@dataclass(frozen=True)
class FittedSet:
    """What was fitted of a fringe set."""

    theta: F64  # (3, y, x) NaN in bad pixels
    delta: F64  # delta, sigma: (y, x) offset and its error, px; NaN in bad pixels
    sigma: F64
    k: tuple[float, float]  # rad/px
    origin: tuple[int, int]
    flat: F64 | None = None  # (y, x)
    name: str = ""  # of the set
    # light, contrast: (y, x) what mean and contrast of the fringes are times those that were
    # measured
    light: F32 | float = 1.0
    contrast: F32 | float = 1.0
    frames: FittedFrames | None = None

    def without(self, effects: Sequence[Effect]) -> "FittedSet":
        """The same with effects undone that act on maps: offsets as fitted with them known."""
        maps = before = self.maps
        for effect in sorted(effects, key=lambda e: e.turn, reverse=True):
            maps = self.undone(effect, maps) or maps
        if maps is before:
            return self._untouched
        size = float(np.hypot(*self.k))
        delta = corrected_offsets(
            self.delta,
            self.sigma,
            phase_change(before.theta, maps.theta),
            straight_modes(before.theta, self.k),
            size,
        )
        good = np.asarray(np.isfinite(self.theta).all(axis=0))
        light = light_surface(maps.theta, good) / light_surface(before.theta, good)
        contrast = contrast_surface(maps.theta, good) / contrast_surface(before.theta, good)
        return replace(
            self,
            delta=delta,
            flat=maps.flat,
            light=light.astype(np.float32),
            contrast=contrast.astype(np.float32),
        )

    @cached_property
    def _untouched(self) -> "FittedSet":
        # One for all benches whose effects leave the maps alone: its model of offsets is kept.
        return replace(self, flat=None)

    @cached_property
    def maps(self) -> FringeMaps:
        """As fitted; bad pixels are like those around them."""
        theta = filled(self.theta, self.k)
        return FringeMaps(theta, self.k, self.origin, self.flat, self.name, self.frames)

    def undone(self, effect: Effect, maps: FringeMaps) -> FringeMaps | None:
        """Maps without an effect, as a fit of the same frames gives them; None where none tell."""
        return effect.undo(maps) or undone_on_samples(effect, maps, self._fit, beyond=True)

    @cached_property
    def _fit(self) -> FitOfFrames | None:
        return None if self.frames is None else FitOfFrames.of(self.maps, self.frames.g)

    @cached_property
    def offsets(self) -> OffsetModel:
        """Offsets that can be true."""
        return true_offsets(self.delta, self.sigma, np.arctan2(*self.maps.theta[1:]))


def light_surface(theta: F64, good: Mask) -> F64:
    """Mean light (y, x) of a fit's maps, smooth over the window."""
    return smooth_surface(np.where(good, theta[0], np.nan), good)


def contrast_surface(theta: F64, good: Mask) -> F64:
    """Contrast (y, x) of a fit's maps as two Gaussian beams can make it over a window."""
    alpha = np.hypot(*theta[1:])
    used = good & (alpha > 0) & (theta[0] > 0)
    contrast = np.divide(alpha, theta[0], out=np.full_like(alpha, np.nan), where=used)
    log = np.log(contrast)
    return np.asarray(np.exp(smooth_surface(log, used, TWO_BEAMS)))
