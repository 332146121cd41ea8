"""Frames and windows that a diagnosis used, and frames that would separate similar effects.

The fields are keys of ``diagnosis.json``.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pixcal.model.acquisition import Acquisition
from pixcal.simulation.effect import Effect
from pixcal.stages.diagnose.parts import FrameSubset, Table

# first frame, last frame and count, by array
Frames = dict[str, tuple[int, int, int]]
SAME_AXIS = 0.98  # cosine of the angle below which two sets measure along one axis
LADDER = 3  # exposure times of flats for a linearity curve
# with equal phase steps, light of neighbouring frames cannot be detected
RANDOM = "fringes with random phases"
MORE = "more frames of the same kind"
# frames that show more of an unexplained difference, by its domain
CLOSER_LOOK = {
    "space": "flats with the detector rotated or shifted, to separate its patterns from those of "
    "the light",
    "time": "a long series of frames of one kind under steady conditions, with DATE-OBS and "
    "CCD-TEMP in the headers",
    "intensity": "flats of ten levels up to saturation, in ascending and in descending order",
    "noise": "fifty bias frames and fifty flats of one level",
}
FRINGES = "fringes"  # for effects that other frames do not show


def frames_of(half: FrameSubset) -> Frames:
    """Frames of a half, by array."""
    return {name: (int(own[0]), int(own[-1]), len(own)) for name, own in half.items()}


@dataclass(frozen=True)
class FramesUsed:
    """Entry ``looked_at`` of ``diagnosis.json``."""

    shape: tuple[int, int]  # rows and columns of the detector
    fitted_on: dict[str, Any]  # ``window`` and ``frames`` to which effects were fitted
    tried_on: dict[str, Any]  # ``windows`` and ``frames`` on which effects were tested
    left_out: tuple[dict[str, Any], ...]  # ``window`` that cannot be fitted, and ``reason``
    # arrays too short to split: effects are fitted and tested on the same frames
    shared: tuple[str, ...]
    kinds: tuple[str, ...]  # of calibration frames
    sets: dict[str, tuple[float, float]]  # baseline of each fringe set, mm
    missing_frames: dict[str, str]  # frames that the acquisition lacks, in words, by name

    @property
    def on_the_same_pixels(self) -> bool:
        """Whether effects were tested on pixels to which they were fitted."""
        (y0, y1), (x0, x1) = self.fitted_on["window"]
        return any(
            y0 < b1 and b0 < y1 and x0 < a1 and a0 < x1
            for (b0, b1), (a0, a1) in self.tried_on["windows"]
        )


def missing_frames(
    acquisition: Acquisition, tables: Mapping[str, Table], steps: Sequence[float]
) -> dict[str, str]:
    """Kinds of frames that would help, by kind (`Effect.frames_needed`), each in words.

    ``steps``: of each set's phase, rad; zero where phases are random.
    """
    axes = _axes([s.baseline_mm for s in acquisition.frames.fringes])
    missing = {}
    single = [name for name, lengths in axes if len(lengths) == 1]
    if single:
        missing["baseline"] = f"a second baseline along {' and '.join(single)}"
    if len(axes) == 1:
        missing["axis"] = "a fringe set along another axis"
    for kind in ("dark", "flat"):
        if kind not in tables:
            missing[kind] = f"{kind} frames"
    exposures = {t for t in tables.get("flat", {}).get("exptime_s", ()) if t is not None}
    if len(exposures) < LADDER:
        missing["ladder"] = f"flats at {LADDER} or more exposure times"
    if steps and all(steps):
        missing["random"] = RANDOM
    return missing


def recommend_frames(
    missing: Mapping[str, str], kinds: Iterable[type[Effect]] = (Effect,)
) -> list[str]:
    """Missing frames that separate effects, or else all that show them (default: any effect)."""
    needed = [set(kind.frames_needed) for kind in kinds]
    some, every = needed[0].union(*needed), needed[0].intersection(*needed)
    for wanted in (some - every, some):
        if frames := [words for name, words in missing.items() if name in wanted]:
            return frames
    return [MORE]


def recommend_closer_look(missing: Mapping[str, str], domain: str) -> list[str]:
    """Frames for an unexplained difference: those that are missing, or more in its domain."""
    frames = recommend_frames(missing)
    return frames if frames != [MORE] else [CLOSER_LOOK[domain]]


def _axes(baselines: Iterable[Sequence[float]]) -> list[tuple[str, set[float]]]:
    """Axes of the fringe sets, and the different lengths (mm) of their baselines."""
    found: list[tuple[tuple[float, float], set[float]]] = []
    for bx, by in baselines:
        size = math.hypot(bx, by)
        if size == 0:
            continue
        one = bx / size, by / size
        for axis, lengths in found:
            if abs(axis[0] * one[0] + axis[1] * one[1]) > SAME_AXIS:
                lengths.add(round(size, 1))
                break
        else:
            found.append((one, {round(size, 1)}))
    return [(_axis_name(axis), lengths) for axis, lengths in found]


def _axis_name(axis: tuple[float, float]) -> str:
    if abs(axis[0]) > SAME_AXIS:
        return "x"
    if abs(axis[1]) > SAME_AXIS:
        return "y"
    return f"{math.degrees(math.atan2(axis[1], axis[0])) % 180:.0f}°"
