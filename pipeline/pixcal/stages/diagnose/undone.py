"""How much light there was before the effects that act on samples.

The nominal bench is measured from frames that have the effects in them; simulated with the same
effects, it must start from the light as it was before they acted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.model.bench import SimulatedDetector
from pixcal.simulation.effect import Effect

PHASES = 16
"""Of a fringe that is undone sample by sample."""
ACROSS = 9
"""Pixels along the side of a frame whose level is undone."""

F64 = NDArray[np.float64]


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
