"""A fringe set as fitted, for simulation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from pixcal.estimators.maps.corrected import (
    MIN_SIGNAL,
    corrected_offsets,
    median_fringe,
    phase_change,
    straight_modes,
)
from pixcal.estimators.maps.structure import OffsetModel, true_offsets
from pixcal.estimators.maps.two_beams import contrast_surface, light_surface
from pixcal.kernels.beams import LightMaps, with_margin
from pixcal.kernels.crosstalk import filled
from pixcal.model.arrays import F32, F64
from pixcal.simulation.effect import Effect, FringeMaps
from pixcal.simulation.fringe_maps import FittedFrames

ACROSS = 9  # side (pixels) of the uniform frames on which effects are undone
MAP_PHASES = 12  # phases, evenly spread over a fringe, at which an effect on samples is undone
_PHASES = 2 * np.pi * np.arange(MAP_PHASES) / MAP_PHASES
_EVEN = np.stack([np.ones(MAP_PHASES), np.cos(_PHASES), np.sin(_PHASES)], axis=1)
TURNS = 5  # iterations of the fits of pixels and frames: each gains a factor of three or more


def levels_before(levels: F64, effects: Sequence[Effect]) -> F64:
    """Levels (e-) of uniform frames after the effects on samples are undone."""
    frames = np.broadcast_to(levels[:, None, None], (len(levels), ACROSS, ACROSS))
    samples = start = np.asarray(frames, np.float32)
    for effect in sorted(effects, key=lambda e: e.sort_key, reverse=True):
        corrected = effect.undo_samples(samples)
        samples = samples if corrected is None else corrected
    return levels if samples is start else np.asarray(samples[:, ACROSS // 2, ACROSS // 2], float)


def corrected_on_samples(
    effect: Effect, maps: FringeMaps, fit: "FitOfFrames | None" = None, *, beyond: bool = False
) -> FringeMaps | None:
    """Maps fitted to noise-free frames after an effect on them was undone.

    None if the effect does not act on samples.

    fit : of the frames that the maps were fitted to; default: evenly spread phases
    beyond : fringes continue beyond the edges of the maps, as in a simulation; by default the
        effect is undone on frames that end there
    """
    flat = np.ones(maps.theta.shape[1:]) if maps.flat is None else maps.flat
    margin = effect.undo_halo if beyond else 0
    light = with_margin(LightMaps(*(maps.theta * flat).astype(np.float32)), margin)
    wide = np.stack([light.iota, light.alpha_sin, light.alpha_cos])
    charge = np.einsum("tm,myx->tyx", _EVEN, wide).astype(np.float32)
    corrected = effect.undo_samples(charge)
    if corrected is None:
        return None
    rows, columns = (slice(margin, margin + n) for n in flat.shape)
    change = (corrected.astype(float) - charge)[:, rows, columns]
    fit = FitOfFrames.of(maps, _EVEN) if fit is None else fit
    return replace(maps, theta=maps.theta + fit.taken_up(change) / flat)


@dataclass(frozen=True)
class FitOfFrames:
    """The part of a phase-dependent change that a joint fit of pixels and frames absorbs.

    If phases are few or unevenly spread, harmonics of a change leak into the maps: directly by the
    fit of the pixels, and by the parameters of the frames that are fitted jointly.
    """

    psi: F64  # (y, x) phase of the pixels, rad
    # by_pixel, by_frames: (3, MAP_PHASES, y, x) weights that sum a change at each phase into the
    # maps: the change of the pixel itself, and the change of all pixels against the phase of their
    # own fringe
    by_pixel: F32
    by_frames: F32

    @classmethod
    def of(cls, maps: FringeMaps, g: F64) -> Self:
        """From the maps and the frame parameters (B, A cos phi, A sin phi), (t, 3)."""
        light = (maps.theta * (1.0 if maps.flat is None else maps.flat)).reshape(3, -1)
        weight = 1 / np.maximum(g @ light, MIN_SIGNAL)
        frames = _taken_by_frames(g, light)
        normal = np.einsum("ti,tj,tp->pij", g, g, weight, optimize=True)
        own = np.einsum("ti,tk,tp->pik", g, _between(_phase(g)), weight, optimize=True)
        other = np.einsum("ti,tjk,tp,jp->pik", g, frames, weight, light, optimize=True)
        shape = 3, MAP_PHASES, *maps.theta.shape[1:]
        by_pixel, by_frames = (
            np.moveaxis(np.linalg.solve(normal, right), 0, -1).reshape(shape).astype(np.float32)
            for right in (own, -other)
        )
        return cls(np.arctan2(*maps.theta[1:]), by_pixel, by_frames)

    def taken_up(self, change: F64) -> F64:
        """Change (3, y, x) of the maps by a change (phase, y, x) of samples, in the same unit."""
        orders = np.arange(MAP_PHASES // 2 + 1)[:, None, None]
        turned = np.fft.rfft(change, axis=0) * np.exp(-1j * orders * self.psi)
        of_all = np.fft.irfft(turned.mean(axis=(1, 2)), MAP_PHASES)
        return np.asarray(
            np.einsum("mtyx,tyx->myx", self.by_pixel, change)
            + np.einsum("mtyx,t->myx", self.by_frames, of_all)
        )


def _phase(g: F64) -> F64:
    return np.arctan2(g[:, 2], g[:, 1])


def _between(phase: F64) -> F64:
    """Weights (..., MAP_PHASES) that interpolate to given phases with all harmonics."""
    apart = phase[..., None] - _PHASES
    orders = np.arange(1, MAP_PHASES // 2).reshape(-1, *[1] * apart.ndim)
    last = np.cos(MAP_PHASES // 2 * apart)
    return np.asarray((1 + 2 * np.cos(orders * apart).sum(axis=0) + last) / MAP_PHASES)


def _taken_by_frames(g: F64, light: F64) -> F64:
    """Part of a change at each phase (MAP_PHASES) that parameters (t, 3) of frames absorb."""
    psi, usual = median_fringe(light, 2 * MAP_PHASES)
    weight = 1 / np.maximum(g @ usual, MIN_SIGNAL)
    of_pixels = np.einsum("tp,ti,tj->pij", weight, g, g)
    of_frames = np.einsum("tp,ip,jp->tij", weight, usual, usual)
    change = _between(psi + _phase(g)[:, None])
    taken = np.zeros((len(g), 3, MAP_PHASES))
    for _ in range(TURNS):
        rest = change - np.einsum("ip,tik->tpk", usual, taken)
        theta = np.linalg.solve(of_pixels, np.einsum("tp,ti,tpk->pik", weight, g, rest))
        rest = change - np.einsum("ti,pik->tpk", g, theta)
        taken = np.linalg.solve(of_frames, np.einsum("tp,ip,tpk->tik", weight, usual, rest))
    return taken


@dataclass(frozen=True)
class FittedSet:
    """Fitted quantities of a fringe set."""

    theta: F64  # (3, y, x) NaN in bad pixels
    delta: F64  # delta, sigma: (y, x) offset and its error, px; NaN in bad pixels
    sigma: F64
    k: tuple[float, float]  # rad/px
    origin: tuple[int, int]
    flat: F64 | None = None  # (y, x)
    name: str = ""  # of the set
    # light, contrast: (y, x) mean and contrast of the fringes relative to those measured
    light: F32 | float = 1.0
    contrast: F32 | float = 1.0
    frames: FittedFrames | None = None

    def without(self, effects: Sequence[Effect]) -> "FittedSet":
        """The set with effects on maps undone: offsets as fitted with the effects known."""
        maps = before = self.maps
        for effect in sorted(effects, key=lambda e: e.sort_key, reverse=True):
            maps = self.corrected(effect, maps) or maps
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
        contrast, contrast_before = (contrast_surface(m.theta, good) for m in (maps, before))
        light = light_surface(maps.theta[0], contrast, good)
        light /= light_surface(before.theta[0], contrast_before, good)
        contrast /= contrast_before
        return replace(
            self,
            delta=delta,
            flat=maps.flat,
            light=light.astype(np.float32),
            contrast=contrast.astype(np.float32),
        )

    @cached_property
    def _untouched(self) -> "FittedSet":
        # Benches whose effects do not change the maps share one set: its offset model is cached.
        return replace(self, flat=None)

    @cached_property
    def maps(self) -> FringeMaps:
        """Fitted maps; bad pixels are filled from their neighbours."""
        theta = filled(self.theta, self.k)
        return FringeMaps(theta, self.k, self.origin, self.flat, self.name, self.frames)

    def corrected(self, effect: Effect, maps: FringeMaps) -> FringeMaps | None:
        """Maps without an effect, as a fit of the same frames gives them; None if unknown."""
        return effect.undo(maps) or corrected_on_samples(effect, maps, self._fit, beyond=True)

    @cached_property
    def _fit(self) -> FitOfFrames | None:
        return None if self.frames is None else FitOfFrames.of(self.maps, self.frames.g)

    @cached_property
    def offsets(self) -> OffsetModel:
        """Model of the possible true offsets."""
        return true_offsets(self.delta, self.sigma, np.arctan2(*self.maps.theta[1:]))
