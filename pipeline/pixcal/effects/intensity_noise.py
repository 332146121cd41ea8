"""Power of the laser, or of its coupling into the fibres, changing from frame to frame."""

from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.evidence import Evidence
from pixcal.kernels.scene import FrameStates
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.recording import Recording


@dataclass(frozen=True)
class IntensityNoise(Effect):
    """Intensity B and amplitude A of every frame, multiplied by the same random factor.

    White from frame to frame, or correlated over ``correlation_s`` (a first-order autoregression,
    which is what a damped random walk is at equal steps).
    """

    name = "intensity_noise"
    title = "intensity changing from frame to frame"
    stage = Stage.LIGHT
    domains = ("time",)
    strengths = ("rms",)
    sources = (
        "Rousset et al., section on simulations: 2 % fluctuations of the laser (design/paper.txt)",
    )

    rms: float = quantity(0.02, low=0, high=0.5, doc="relative, of the mean intensity")
    correlation_s: float = quantity(0.0, unit="s", low=0, high=1e6, doc="0: white")

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        """As in `Effect.states`."""
        drawn = recording.rng(self.name).standard_normal(recording.count)
        keep = np.exp(-recording.period_s / self.correlation_s) if self.correlation_s else 0.0
        walk = np.empty(recording.count)
        last = drawn[0] if len(drawn) else 0.0
        for n, step in enumerate(drawn):
            last = keep * last + np.sqrt(1 - keep**2) * step if n else step
            walk[n] = last
        factor = np.maximum(1 + self.rms * walk, 0.0)
        return replace(states, level=states.level * factor, amplitude=states.amplitude * factor)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Scatter of B over the frames of all sets, less what the noise of the samples gives."""
        variance = information = lagged = weight = chance = 0.0
        times = []
        for found in evidence.fringes.values():
            b = found.free[:, 0]
            noise = found.free_covariance[:, 0, 0] / b.mean() ** 2
            x = b / b.mean() - 1
            n = len(x)
            measured = float((x @ x) / (n - 1) - noise.mean())
            # Variance of a sample variance: of the excess with its own scatter, and of nothing.
            total = max(measured, 0.0) + noise.mean()
            w = n / (2 * total**2)
            variance, information = variance + w * measured, information + w
            chance += n / (2 * noise.mean() ** 2)
            lagged += float(x[1:] @ x[:-1])
            weight += float(n - 1)
            times.append(float(np.median(np.diff(found.time_s))) if n > 1 else 0.0)
        if not information:
            return None
        variance /= information
        significance = variance * np.sqrt(chance)
        rms = float(np.sqrt(max(variance, 0.0)))
        error = float(1 / (2 * max(rms, information**-0.25) * np.sqrt(information)))
        keep = float(np.clip(lagged / weight / variance, 0.0, 0.999)) if rms else 0.0
        keep_error = float(np.sqrt((1 - keep**2) / weight))
        period = float(np.mean(times))
        correlation, correlation_error = 0.0, period
        if keep > 3 * keep_error and period > 0:
            correlation = -period / np.log(keep)
            correlation_error = correlation**2 / (period * keep) * keep_error
            # Neighbours that resemble each other tell less of their scatter.
            error *= float(np.sqrt((1 + keep**2) / (1 - keep**2)))
        return Estimate(
            cls(min(rms, 0.5), correlation),
            {"rms": error, "correlation_s": correlation_error},
            float(significance),
            "scatter of the mean intensity from frame to frame beyond the noise of the samples",
            {"neighbours": keep},
        )
