"""Offset of every single frame as measured, less the noise in it (Wiener)."""

from dataclasses import replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.light import LIGHT_PARTS, FrameLight
from pixcal.estimators.frame_series.offset import dark_offsets, offset_modes
from pixcal.estimators.frame_series.variance_components import estimate_components
from pixcal.estimators.frame_series.walk_modes import walk_modes
from pixcal.model.arrays import F64

KNOTS = 32  # most points of a course of fringes

Course = tuple[str, F64, F64]
"""Fringe set or e.g. ``bias frames``; times (t,) from its first frame, s; offsets (t,), e-."""


def fringe_courses(light: FrameLight) -> tuple[list[Course], float]:
    """Slow offsets of every set: the part of (B, log A/B) that moves the first and not A.

    Then what is left of it from frame to frame, e- rms over all sets.
    """
    light = replace(light, dark=())
    drifts, every = ("offset_walk", "offset_smooth"), (*LIGHT_PARTS, "offset_smooth")
    found, jitter = [], []
    for series in light.sets:
        modes = replace(light, sets=(series,)).modes(every)
        size = np.maximum(estimate_components(modes).size, 0.0)
        n = len(series) - 1
        parts = size[:, None, None, None] * modes.parts[:, :n]
        # In e-, what (B, log A/B) share with the drift.
        drift = light.level[series.name] * sum(parts[every.index(name)] for name in drifts)
        offset = series.walk_modes.series(_wiener(parts, drift[:, :, 0], modes.values[:n]))
        some = np.unique(np.linspace(0, n, min(KNOTS, n + 1)).astype(int))
        found.append((series.name, series.time_s[some], offset[some]))
        jitter.append(size[every.index("offset")])
    return found, float(np.sqrt(np.mean(jitter)))


def dark_courses(evidence: Evidence) -> list[Course]:
    """All that moves the level of bias and of dark frames, where these are of one exposure time."""
    found = []
    for kind in ("bias", "dark"):
        stacks = evidence.of_kind(kind)
        if len(stacks) != 1:
            continue
        series = dark_offsets(stacks[0], evidence.good, evidence.gain, evidence.read_noise)
        if series is None:
            continue
        modes = offset_modes([series], [np.zeros((len(series), 0))])
        size = np.maximum(estimate_components(modes).size, 0.0)
        parts = size[:, None, None, None] * modes.parts
        smooth = _wiener(parts, parts[:2].sum(axis=0)[:, :, 0], modes.values)
        found.append((f"{kind} frames", stacks[0].time_s, walk_modes(series.time_s).series(smooth)))
    return found


def _wiener(parts: F64, wanted: F64, values: F64) -> F64:
    """Modes (n,) of a quantity whose covariance with the values (n, c) is ``wanted`` (n, c)."""
    weight = np.linalg.solve(parts.sum(axis=0), wanted[..., None])[..., 0]
    return np.asarray(np.einsum("nc,nc->n", weight, values))
