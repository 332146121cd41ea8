"""Amplifier glow: an effect of one's own, from outside pixcal."""

from dataclasses import dataclass

import numpy as np

from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage


@dataclass(frozen=True)
class Glow(Effect):
    """Light of the read-out amplifier beside the first pixel, in every frame."""

    name, title, acts_at = "glow", "amplifier glow", Stage.LIGHT
    domains, strengths = ("space", "intensity"), ("rate",)
    sources = ("a guess, to be measured",)

    rate: float = quantity(200.0, unit="e-/s", low=0, doc="at the first pixel")
    reach_px: float = quantity(15.0, unit="px", above=0, doc="where it has fallen to 1/e")

    def pattern(self, y, x):
        """The glow over that at the first pixel, by row and column of the window."""
        return np.exp(-np.hypot(y, x) / self.reach_px)

    def photons(self, mean, shot):
        """Mean electrons of a frame before shot noise: the glow is added."""
        y, x = np.ogrid[slice(*shot.rows), : mean.shape[1]]
        glow = self.rate * shot.recording.exptime_s * self.pattern(y, x)
        return mean + glow.astype(np.float32)

    @classmethod
    def estimate(cls, evidence):
        """From darks: the part of their mean that falls off from the first pixel."""
        darks = [stack for stack in evidence.of_kind("dark") if stack.exptime_s > 0]
        if not darks:
            return None
        stack = max(darks, key=lambda s: s.exptime_s)
        seen = (stack.adu.mean(axis=0) - evidence.bias) * evidence.gain / stack.exptime_s
        y, x = np.ogrid[: seen.shape[0], : seen.shape[1]]
        pattern = cls().pattern(y + evidence.origin[0], x + evidence.origin[1])
        basis = np.stack([np.ones_like(pattern), pattern])[:, evidence.good].T
        fit, *_ = np.linalg.lstsq(basis, seen[evidence.good])
        scatter = np.std(seen[evidence.good] - basis @ fit)
        error = float(scatter * np.sqrt(np.linalg.inv(basis.T @ basis)[1, 1]))
        rate = float(fit[1])
        return Estimate(
            cls(rate=max(rate, 0.0)),
            {"rate": error},
            rate / error,
            f"darks of {stack.exptime_s:g} s: light that falls off from the first pixel",
        )
