"""Bias frames and flats that a bench needs, from the cost of wrong weights."""

from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np

from pixcal.model.arrays import F64
from pixcal.model.bench import Bench
from pixcal.stages.budget.expected import SetBound, sample_variance
from pixcal.stages.budget.information import TURN

NEGLIGIBLE = 1e-3  # relative increase in frames allowed for the noise of calibration frames


@dataclass(frozen=True)
class WeightErrors:
    """Cost of wrong weights: relative increase of the frames needed, per squared relative error.

    Weights ``(1 + e(u)) / variance`` add the variance of e over the phases, by their information.
    """

    # per e-² of a constant error of a sample's variance, from a wrong bias or read noise
    offset: float
    scale: float  # per squared relative error of the light, from a wrong flat

    @classmethod
    def of(cls, iota: float, alpha: float, variance: float) -> "WeightErrors":
        """For a pixel; parameters as `phase_information`."""
        u = 2 * np.pi * (np.arange(TURN * 8) + 0.5) / (TURN * 8)
        light = iota + alpha * np.sin(u)
        noise = light + variance
        weight = np.cos(u) ** 2 / noise
        weight /= weight.sum()

        def scatter(values: F64) -> float:
            return float(weight @ values**2 - (weight @ values) ** 2)

        return cls(scatter(1 / noise), scatter(light / noise))


def bias_frames_needed(errors: WeightErrors, variance: float) -> int:
    """Bias frames needed for a cost below `NEGLIGIBLE` of the fringe frames."""
    # A pixel's iota absorbs its bias. The remaining cost is from weights with a wrong level and, if
    # each pixel's read noise is measured from the same frames, a wrong read noise.
    n = 2
    while errors.offset * (variance / n + 2 * variance**2 / (n - 1)) > NEGLIGIBLE:
        n += 1
    return n


def flat_error(bench: Bench) -> float | None:
    """Relative error of a pixel's flat from the planned flats of the bench; None without any."""
    f = bench.frames
    if not f.flats or f.flat_rate_e_s is None:
        return None
    variance = sample_variance(bench)
    levels = [(step.count, f.flat_rate_e_s * step.exptime_s) for step in f.flats]
    weight = sum(count * level**2 / (level + variance) for count, level in levels if level > 0)
    return float(weight**-0.5) if weight > 0 else None


def flats_needed(errors: WeightErrors, level: float, variance: float) -> int:
    """Flats at a level (e-) that add less than `NEGLIGIBLE` to the fringe frames."""
    # An error of the flat does not change the phase; it only affects weights from neighbours.
    return max(1, ceil(errors.scale * (level + variance) / level**2 / NEGLIGIBLE))


def frames_to_calibrate(bench: Bench, s: SetBound) -> dict[str, Any]:
    """Bias and flat frames needed, and the cost of those planned."""
    n, f = s.typical, bench.frames
    errors = WeightErrors.of(float(s.iota[n]), float(s.alpha[n]), s.variance)
    level, flat = float(np.median(s.iota)), flat_error(bench)
    return {
        "bias_frames_needed": bias_frames_needed(errors, s.variance),
        "bias_frames": f.bias,
        "bias_error_e": (sample_variance(bench) / f.bias) ** 0.5 if f.bias else None,
        "flats_needed": flats_needed(errors, level, s.variance),
        "flats": sum(step.count for step in f.flats),
        "flat_error": flat,
        "flat_cost": errors.scale * (flat**2 if flat is not None else bench.detector.prnu_rms**2),
    }
