"""Frames to analyse: their series, the halves to fit and to test effects, and what is missing.

Light between bias or dark frames may leave charge in later frames, so it ends a series. The fields
of `FramesUsed` are keys of ``diagnosis.json``.
"""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixcal.effects import effects
from pixcal.estimators.diagnosis.evidence import SOON_S
from pixcal.estimators.fringe_fit.combine import SAME_AXIS
from pixcal.model.acquisition import Acquisition
from pixcal.model.arrays import F64, Indices
from pixcal.simulation.effect import Effect
from pixcal.stages.diagnose.parts import FrameSubset, Table
from pixcal.stages.evidence import frame_days, groups
from pixcal.storage.header_values import DAY_S

# samples of a fringe set to analyse, in each half of the frames and each window
SAMPLES = 6_000_000
# least calibration frames of a series or an exposure time to split; fewer serve both halves
FEWEST = 4
# most fringe frames in a half: the computing time of their series grows with the square
MOST_FRAMES = 1500
# number of blocks, and least number of frames for it: with long blocks, few frames lack the
# preceding one; with short ones, both halves have the same drifts
BLOCKS = ((16, 384), (8, 192), (4, 32), (2, FEWEST))
TURN = (False, True, True, False)  # which blocks are held out: a steady drift is the same in both
Frames = dict[str, tuple[int, int, int]]  # first frame, last frame and count, by array
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


def in_series(tables: Mapping[str, Table]) -> dict[str, Table]:
    """Tables with the number of each bias and dark frame's series (``step``), and ``after_light``.

    Light divides the frames of one exposure time if the next ones begin soon after it. ``last`` is
    the number of the last frame of its series.
    """
    dark = {name: table for name, table in tables.items() if name in ("bias", "dark")}
    every = [frame_days(table) for name, table in tables.items() if name not in dark]
    light = np.sort(np.concatenate([*every, []]))
    series = dict(tables)
    if light.size and np.isfinite(light).all():
        series |= {name: _numbered(table, light) for name, table in dark.items()}
    kinds = {name: series[name] for name in ("bias", "dark", "flat") if name in series}
    return series | {name: _with_ends(table) for name, table in kinds.items()}


def _with_ends(table: Table) -> Table:
    """Table of calibration frames with the number of the last frame of each one's series."""
    last = np.zeros(len(table["time_s"]), int)
    for group in groups(table):
        last[group] = group[-1]
    return {**table, "last": last.tolist()}


def _numbered(table: Table, light: F64) -> Table:
    """Table of bias or dark frames, in series; ``light``: times of lit frames, days, ascending."""
    days = frame_days(table)
    if not np.isfinite(days).all():
        return table
    before = np.searchsorted(light, days)
    since = days - np.append(-np.inf, light)[before]
    soon = since * DAY_S < SOON_S
    step, after = np.zeros(len(days), int), np.zeros(len(days), np.bool_)
    for group in groups(table):
        begins = group[np.flatnonzero(np.diff(before[group], prepend=-1))]
        begins = begins[(begins == group[0]) | soon[begins]]
        series = np.searchsorted(begins, group, side="right") - 1
        if np.bincount(series).min() < FEWEST:
            series, begins = np.zeros_like(series), begins[:1]
        step[group], after[group] = series, soon[begins][series]
    return {**table, "step": step.tolist(), "after_light": after.tolist()}


@dataclass(frozen=True)
class Split:
    """Frames to which effects are fitted (``learn``), and held-out frames (``test``)."""

    learn: FrameSubset
    test: FrameSubset
    shared: tuple[str, ...]  # arrays with exposure times that have too few frames to split


def split(tables: Mapping[str, Table], pixels: int, full_flats: Sequence[int] = ()) -> Split:
    """Assign blocks of every array and exposure time to the halves (`TURN`)."""
    # A long fringe set contributes `SAMPLES` to each half; without fringes, all frames together do.
    # Flats with full pixels are left out unless all have them. Without fringes, the first flat of
    # an exposure time and the first dark after light are in both halves: they show lag most.
    learn, test = {}, {}
    every = {name: _groups(name, table, full_flats) for name, table in tables.items()}
    most = SAMPLES // pixels
    fringes = any("/" in name for name in tables)
    if fringes:
        most = min(most, MOST_FRAMES)
    else:
        most = _equal_share([len(group) for of_name in every.values() for group in of_name], most)
    after_light = {n: table["after_light"] for n, table in tables.items() if "after_light" in table}
    for name, of_name in every.items():
        fitted, held_out = [], []
        for group in of_name:
            one, other = _halves(group, most)
            fitted.append(one)
            lags = name == "flat" or (name in after_light and after_light[name][group[0]])
            held_out.append(np.union1d(other, group[:1]) if lags and not fringes else other)
        learn[name] = np.sort(np.concatenate(fitted))
        test[name] = np.sort(np.concatenate(held_out))
    short = (name for name, of_name in every.items() if min(map(len, of_name)) < FEWEST)
    return Split(learn, test, tuple(short))


def _groups(name: str, table: Table, full_flats: Sequence[int]) -> list[Indices]:
    """Groups of frames of an array that are split together."""
    if "/" in name:
        return [np.arange(len(table["exptime_s"]))]
    every = groups(table)
    kept = [group for group in every if name != "flat" or not np.isin(group, full_flats).any()]
    return kept or every


def _of_half(count: int) -> int:
    return count if count < FEWEST else count // 2


def frames_of_half(tables: Mapping[str, Table]) -> int:
    """Calibration frames in each half."""
    return sum(
        _of_half(len(group))
        for name, table in tables.items()
        if "/" not in name
        for group in groups(table)
    )


def _equal_share(counts: Sequence[int], total: int) -> int:
    """Largest number of frames per group in a half that keeps the sum within a total."""
    left, share = total, total
    ordered = sorted(map(_of_half, counts))
    for n, count in enumerate(ordered):
        share = left // (len(ordered) - n)
        if count > share:
            return max(share, FEWEST // 2)
        left -= count
    return total


def _halves(frames: Indices, most: int) -> tuple[Indices, Indices]:
    if len(frames) < FEWEST:
        return frames, frames
    count = next(blocks for blocks, fewest in BLOCKS if len(frames) >= fewest)
    # Of an odd number, the half that effects are fitted to has one more: medians need three.
    edges = [-(-n * len(frames) // count) for n in range(count + 1)]
    halves: tuple[list[Indices], list[Indices]] = ([], [])
    for n, (first, last) in enumerate(itertools.pairwise(edges)):
        size = min(last - first, 2 * most // count)
        halves[TURN[n % len(TURN)]].append(frames[first : first + size])
    return np.concatenate(halves[0]), np.concatenate(halves[1])


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
    """Frames that show more of an unexplained difference, and missing ones of use in its domain."""
    kinds = [kind for kind in effects().values() if kind.domains[0] == domain]
    needed = {name for kind in kinds for name in kind.frames_needed}
    return [CLOSER_LOOK[domain], *(words for name, words in missing.items() if name in needed)]


def _axes(baselines: Iterable[Sequence[float]]) -> list[tuple[str, set[float]]]:
    """Axes of the fringe sets, and the different lengths (mm) of their baselines."""
    axes: list[tuple[tuple[float, float], set[float]]] = []
    for bx, by in baselines:
        size = math.hypot(bx, by)
        if size == 0:
            continue
        one = bx / size, by / size
        for axis, lengths in axes:
            if abs(axis[0] * one[0] + axis[1] * one[1]) > SAME_AXIS:
                lengths.add(round(size, 1))
                break
        else:
            axes.append((one, {round(size, 1)}))
    return [(_axis_name(axis), lengths) for axis, lengths in axes]


def _axis_name(axis: tuple[float, float]) -> str:
    if abs(axis[0]) > SAME_AXIS:
        return "x"
    if abs(axis[1]) > SAME_AXIS:
        return "y"
    return f"{math.degrees(math.atan2(axis[1], axis[0])) % 180:.0f}°"
