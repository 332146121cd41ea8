"""Strengths of the effects, from the detection threshold to ten times the threshold."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixcal.effects.ghost_fringes import PARENTS

Plain = dict[str, Any]
Make = Callable[[float, np.random.Generator], Plain]


@dataclass(frozen=True)
class Variant:
    """A variant of an effect."""

    effect: str
    strength: str  # meaning of its strength, in words
    # small, standard: threshold, the strength detected on half of the frames with about four
    # sigmas, on the typical bench of each size
    small: float
    standard: float
    # parameters of the effect, from a strength and random numbers for all others
    make: Make

    def threshold(self, size: str) -> float:
        """Threshold for an examination's size."""
        return self.small if size == "small" else self.standard


def _around(size: float, rng: np.random.Generator) -> list[float]:
    """A vector of given length in a random direction."""
    angle = rng.uniform(0, 2 * np.pi)
    return [float(size * np.cos(angle)), float(size * np.sin(angle))]


def _between(low: float, high: float, rng: np.random.Generator) -> float:
    """A log-uniform random number."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _either(size: float, rng: np.random.Generator) -> float:
    """The size with a random sign."""
    return size if rng.random() < 0.5 else -size


def _only(name: str, strengths: tuple[str, ...], **more: Any) -> Make:
    """One strength of several, the others zero."""
    return lambda s, rng: dict.fromkeys(strengths, 0.0) | more | {name: s}


def _ramp(s: float, rng: np.random.Generator) -> Plain:
    return {name: [0.0, 0.0] for name in _DRIFT} | {"ramp": _around(s, rng)}


def _walk(s: float, rng: np.random.Generator) -> Plain:
    share = rng.uniform(0.3, 1)
    return {name: [0.0, 0.0] for name in _DRIFT} | {"walk": [s, float(s * share)]}


def _vibration(s: float, rng: np.random.Generator) -> Plain:
    along = [abs(part) for part in _around(s, rng)]
    return {"rms": [0.0, 0.0], "vibration": along, "vibration_hz": float(rng.uniform(0.3, 3.0))}


def _ghost(s: float, rng: np.random.Generator) -> Plain:
    beat = _around(rng.uniform(0.15, 1.0), rng)
    turn, parent = float(rng.uniform(-np.pi, np.pi)), str(rng.choice(tuple(PARENTS)))
    return {"share": s, "beat_rad_px": beat, "phase_rad": turn, "parent": parent}


def _bump(s: float, rng: np.random.Generator) -> Plain:
    centre = [float(v) for v in rng.uniform(10, 110, 2)]
    return {"share": 0.0, "slope_per_px": [0.0, 0.0], "bump": s, "bump_centre_px": centre,
            "bump_radius_px": float(rng.uniform(15, 40))}  # fmt: skip


def _nearest(s: float, rng: np.random.Generator) -> Plain:
    up, right = s, s * float(rng.uniform(0.3, 1))
    places = ((1, 0, up), (-1, 0, up), (0, 1, right), (0, -1, right))
    return {"couplings": [{"dy": dy, "dx": dx, "share": share} for dy, dx, share in places]}


def _every_other_row(s: float, rng: np.random.Generator) -> Plain:
    row = int(rng.integers(2))
    return {"couplings": [{"dy": 1, "dx": 0, "share": s, "every_rows": 2, "row": row}]}


_BIAS = ("jitter_rms", "ramp_e_h", "walk_e_h", "settle_e")
_DRIFT = ("ramp", "settle", "walk")
_ROWS = ("row_rms", "flicker_rms", "interlace_rms", "column_rms", "alternate_rms")
_CODES = ("coarse_adu", "dnl_rms", "ripple")
_WAVE = ("ramp", "walk", "hop")

# fmt: off
VARIANTS = (
    Variant("bias_drift", "jitter, e-", 0.6, 0.2, _only("jitter_rms", _BIAS)),
    Variant("bias_drift", "random walk, e-/h^0.5", 32, 11, _only("walk_e_h", _BIAS)),
    Variant("brighter_fatter", "shift, px/e-", 1.1e-8, 3.8e-9,
        lambda s, rng: {"shift_px_per_e": s, "falloff_px": float(rng.uniform(0.4, 1.0))}),
    Variant("contrast_noise", "vibration, rad", 0.015, 0.0095,
        _only("vibration_rad", ("polarisation",))),
    Variant("contrast_noise", "polarisation", 1.2e-4, 3.5e-5,
        lambda s, rng: {"vibration_rad": 0.0, "polarisation": s,
                        "polarisation_s": _between(0.5, 10, rng)}),
    Variant("cosmic_hits", "rate, /(cm² s)", 180, 30, lambda s, rng: {"rate_cm2_s": s}),
    Variant("flat_error", "from pixel to pixel", 5e-4, 3.5e-4, _only("pixel_rms", ("smooth_rms",))),
    Variant("flat_error", "smooth", 4.2e-4, 2.8e-4,
        lambda s, rng: {"pixel_rms": 0.0, "smooth_rms": s, "scale_px": _between(3, 12, rng)}),
    Variant("fringe_drift", "random walk, rad/(px h^0.5)", 1.9e-4, 2.5e-5, _walk),
    Variant("fringe_drift", "ramp, rad/(px h)", 0.0018, 1.4e-4, _ramp),
    Variant("fringe_jitter", "vector, rad/px", 7.5e-6, 1.3e-6,
        lambda s, rng: {"rms": [s, float(s * rng.uniform(0.3, 1))]}),
    Variant("fringe_jitter", "vibration, rad/px", 4.7e-6, 1.1e-6, _vibration),
    Variant("gain_error", "relative", 0.024, 0.0085, lambda s, rng: {"relative": _either(s, rng)}),
    Variant("ghost_fringes", "share", 2.7e-4, 1.3e-4, _ghost),
    Variant("hyperbolic_fringes", "fibre-pair offset, mm", 12, 1.1,
        lambda s, rng: {"foot_mm": _around(s, rng)}),
    Variant("intensity_noise", "white, relative", 8e-5, 4.7e-5, _only("rms", ("line",))),
    Variant("intensity_noise", "slow, relative", 9e-5, 3.1e-5,
        lambda s, rng: {"rms": s, "line": 0.0, "correlation_s": _between(0.3, 5, rng)}),
    Variant("intra_pixel_response", "scatter of the width, px", 0.006, 0.003,
        lambda s, rng: {"width_px": 2 * [float(rng.uniform(0.8, 1.0))], "width_rms_px": s}),
    Variant("ipc", "share to the next pixel", 0.004, 9e-4, _nearest),
    Variant("ipc", "share from every other row", 0.0023, 9.8e-4, _every_other_row),
    Variant("lag", "share", 3.3e-5, 1.4e-5,
        lambda s, rng: {"share": s, "decay_frames": float(rng.choice([0.0, rng.uniform(1, 3)]))}),
    Variant("nonlinearity", "quadratic", 0.0011, 4.3e-4,
        lambda s, rng: {"quadratic": _either(s, rng), "cubic": float(s * rng.uniform(-0.4, 0.4))}),
    Variant("quantisation", "step beyond 1 ADU, ADU", 1.0, 1.0, _only("coarse_adu", _CODES)),
    Variant("quantisation", "scatter of the codes", 0.012, 0.0036, _only("dnl_rms", _CODES)),
    Variant("quantisation", "ripple of the codes", 0.007, 0.0027,
        lambda s, rng: {"coarse_adu": 0.0, "dnl_rms": 0.0, "ripple": s,
                        "ripple_phase_rad": float(rng.choice([0.0, np.pi]))}),
    Variant("rolling_shutter", "line time, us", 0.053, 0.0073, lambda s, rng: {"line_time_us": s}),
    Variant("row_noise", "rows, e-", 0.75, 0.3, _only("row_rms", _ROWS)),
    Variant("row_noise", "columns, e-", 0.7, 0.32, _only("column_rms", _ROWS)),
    Variant("row_noise", "alternate rows, e-", 0.29, 0.12, _only("interlace_rms", _ROWS)),
    Variant("straylight", "bump, of the light", 1.5e-3, 7e-4, _bump),
    Variant("telegraph_noise", "amplitude, e-", 19, 10,
        lambda s, rng: {"amplitude_e": s, "share": float(rng.uniform(0.01, 0.05)),
                        "switching_s": _between(0.3, 3, rng)}),
    Variant("wavelength_drift", "ramp, 1/h", 0.0025, 4.4e-4, _only("ramp", _WAVE)),
    Variant("wavelength_drift", "hop", 3e-5, 3.3e-6,
        lambda s, rng: {"ramp": 0.0, "walk": 0.0, "hop": s, "hops_per_h": 300.0}),
)
# fmt: on
"""Every variant of every effect."""


def variants_of() -> Mapping[str, tuple[Variant, ...]]:
    """Variants by the name of the effect."""
    names = dict.fromkeys(variant.effect for variant in VARIANTS)
    return {name: tuple(w for w in VARIANTS if w.effect == name) for name in names}


STRONGEST = 10.0  # times the threshold that an effect is at most
