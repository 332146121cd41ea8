"""Light and maps as they were before the effects that act on samples.

The nominal bench is measured from frames that have the effects in them; simulated with the same
effects, it must start from the light as it was before they acted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.model.arrays import F64
from pixcal.model.bench import SimulatedDetector
from pixcal.simulation.effect import Effect, FringeMaps

PHASES = 16
"""Of a fringe that is undone sample by sample."""
MAP_PHASES = 12
"""Frames, spread over a fringe, of which an effect on samples is undone."""
LEAST_SIGNAL = 1.0
"""Of a sample (e-), below which its shot noise is not taken."""
ACROSS = 9
"""Pixels along the side of a frame whose level is undone."""


@dataclass(frozen=True)
class IntensityBeforeEffects:
    """Levels of light as they were before effects that are undone on samples, over those after."""

    effects: Sequence[Effect]
    detector: SimulatedDetector

    def fringes(self, light: float, contrast: float) -> tuple[float, float]:
        """Of the mean (e-) of fringes, and of their contrast.

        As the fit finds them, whose weights let harmonics of the phase have a part in both.
        """
        cosine = np.cos(2 * np.pi * np.arange(PHASES) / PHASES)
        measured = light * (1 + contrast * cosine)
        samples = self.levels(measured)
        if samples is measured or not contrast > 0:
            return 1.0, 1.0
        weight = (np.maximum(measured, 0) + self.detector.read_noise_e**2 + 1) ** -0.5
        design = np.stack([np.ones(PHASES), cosine], axis=1) * weight[:, None]
        mean, amplitude = np.linalg.lstsq(design, samples * weight, rcond=None)[0]
        return mean / light, amplitude / mean / contrast

    def levels(self, levels: F64) -> F64:
        """Even frames of these levels (e-) without the effects."""
        frames = np.broadcast_to(levels[:, None, None], (len(levels), ACROSS, ACROSS))
        found = start = np.asarray(frames, np.float32)
        for effect in sorted(self.effects, key=lambda e: e.turn, reverse=True):
            undone = effect.undo_samples(found)
            found = found if undone is None else undone
        if found is start:
            return levels
        return np.asarray(found[:, ACROSS // 2, ACROSS // 2], float)


def undone_on_samples(effect: Effect, maps: FringeMaps) -> FringeMaps | None:
    """Maps that a fit finds in frames without noise that an effect was undone on.

    None where the effect is not one of samples.
    """
    phi = 2 * np.pi * np.arange(MAP_PHASES) / MAP_PHASES
    frames = np.stack([np.ones(MAP_PHASES), np.cos(phi), np.sin(phi)])
    flat = np.ones(maps.theta.shape[1:]) if maps.flat is None else maps.flat
    charge = np.einsum("mt,myx->tyx", frames, maps.theta * flat)
    undone = effect.undo_samples(charge.astype(np.float32))
    if undone is None:
        return None
    weight = 1 / np.maximum(charge, LEAST_SIGNAL)
    normal = np.einsum("mt,nt,tyx->yxmn", frames, frames, weight)
    right = np.einsum("mt,tyx->yxm", frames, weight * undone)
    theta = np.moveaxis(np.linalg.solve(normal, right[..., None])[..., 0], -1, 0)
    return replace(maps, theta=theta)
