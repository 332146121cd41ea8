"""Bench properties that effects use, and times of the frames, from an acquisition."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixcal.estimators.detector.flat_ladder import light_of
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.acquisition import Acquisition
from pixcal.model.arrays import F32, F64, Indices
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.simulation.recording import Recording
from pixcal.simulation.replica import TOP_ADU, plain_bench
from pixcal.stages.diagnose.parts import FrameSubset, Table
from pixcal.stages.evidence import frame_days, groups
from pixcal.storage.header_values import DAY_S

_LATE = 0.05  # fraction of a period above which a frame counts as late
_LIFTED = 8.0  # level without light after the pedestal, in units of the read noise


@dataclass(frozen=True)
class SetTruth:
    """One fringe set of the nominal bench."""

    light: F32  # (y, x) mean, for unit response, e-
    contrast: F32  # (y, x) fringe amplitude over the mean, a smooth surface
    psi: F64  # (y, x) phase of the pixels if they had no offsets, rad
    k: tuple[float, float]  # fringe vector, rad/px
    step: float  # of a ramp of the phase, rad; zero: no ramp
    phi: F64  # (t,) measured phase of every frame, rad; NaN for frames that were not fitted

    def phase(self, delta_x: F32, delta_y: F32) -> F64:
        """Phase (y, x) of the pixels at their offsets (px), rad."""
        return np.asarray(self.psi + self.k[0] * delta_x + self.k[1] * delta_y)


def bench_of(
    acquisition: Acquisition,
    tables: Mapping[str, Table],
    evidence: Evidence,
    whole: tuple[int, int],
    sets: Sequence[SetTruth],
    dtypes: Mapping[str, np.dtype[Any]],
) -> Bench:
    """Bench properties that effects use; `Measured` replaces the pixels and light."""
    listed = [f"fringes/{s.name}" for s in acquisition.frames.fringes]
    table = tables[listed[0]] if listed else next(iter(tables.values()))
    times = np.array(table["time_s"], float)
    exposure = max(float(table["exptime_s"][0] or 0.0), 1e-6)
    period = float(np.median(np.diff(times))) if len(times) > 1 else exposure
    contrast = [float(np.median(s.contrast)) for s in sets]
    counts = [len(tables[name]["time_s"]) for name in listed]
    peaks = [float(np.max(truth.light * (1 + truth.contrast))) for truth in sets]
    listed_sets = [
        (s.name, s.baseline_mm, count, peak)
        for s, count, peak in zip(acquisition.frames.fringes, counts, peaks, strict=True)
    ]
    visibility = float(np.mean(contrast)) if contrast else 1.0
    top, times_s = _top(acquisition, evidence, sets, dtypes), (exposure, period)
    declared = acquisition.detector
    return plain_bench(evidence, whole, top, visibility, times_s, listed_sets, declared)


def pedestal_of(
    evidence: Sequence[Evidence], dtypes: Mapping[str, np.dtype[Any]], step: int
) -> int:
    """Pedestal (ADU) that keeps noise without light above zero, if samples may be negative."""
    low = min(float(np.min(e.bias[e.good], initial=0.0)) for e in evidence)
    noise = max(e.read_noise / e.gain for e in evidence)
    if all(dtype.kind == "f" for dtype in dtypes.values()) and noise < 0.5:
        raise InputError(
            f"the frames hold real numbers with a read noise of {noise:.2g}, but simulated samples "
            "are whole numbers; multiply all frames so that the noise is 1 or more, and divide "
            "detector.gain_e_per_adu by the same factor"
        )
    signed = all(dtype.kind != "u" for dtype in dtypes.values())
    signed &= all(e.lowest_adu is None for e in evidence)
    lifted = _LIFTED * noise - low if signed and low < _LIFTED * noise else 0.0
    return math.ceil(lifted / step) * step


def recordings_of(
    bench: Bench,
    acquisition: Acquisition,
    tables: Mapping[str, Table],
    evidence: Sequence[Evidence],
    halves: Sequence[FrameSubset],
) -> tuple[list[Recording], list[tuple[str, Indices]], dict[int, F64]]:
    """Recordings, places of their frames, and light of each flat: e- for unit response, or NaN."""
    start = _start(tables)
    listed = {f"fringes/{s.name}": n for n, s in enumerate(acquisition.frames.fringes)}
    recordings, places, light = [], [], {}
    for name, table in tables.items():
        exposures = np.nan_to_num(np.array(table["exptime_s"], float))
        times = np.array(table["time_s"], float)
        kind = name.split("/")[0]
        series = [np.arange(len(times))] if name in listed else groups(table)
        for n, numbers in enumerate(series):
            exposure = float(exposures[numbers[0]])
            period = float(np.median(np.diff(times[numbers]))) if len(numbers) > 1 else exposure
            electrons = 1.0 if name in listed else 0.0
            if kind == "flat":
                step = int(table["step"][numbers[0]]) if "step" in table else 0
                light[n] = _light(evidence, halves, name, numbers, (exposure, step))
                lit = np.isfinite(light[n])
                # The light of flats outside the evidence is unknown.
                electrons = float(light[n][lit].mean()) if lit.any() else 0.0
            after = times[numbers] - times[numbers[0]]
            known = bool(np.isfinite(after).all())
            even = np.arange(len(after)) * period
            late = known and not np.allclose(after, even, rtol=0, atol=_LATE * period)
            recordings.append(
                Recording(
                    bench,
                    kind,
                    listed.get(name, n),
                    len(numbers),
                    exposure,
                    start[name] + float(times[numbers[0]]),
                    period,
                    electrons,
                    stamps_s=tuple(after.tolist()) if late else (),
                )
            )
            places.append((name, numbers))
    return _in_sequence(recordings, places, tables), places, light


def _in_sequence(
    recordings: Sequence[Recording],
    places: Sequence[tuple[str, Indices]],
    tables: Mapping[str, Table],
) -> list[Recording]:
    """Each recording linked to the preceding one, if time stamps identify it."""
    stamps = [frame_days(tables[name])[numbers] for name, numbers in places]
    linked = []
    for recording, days in zip(recordings, stamps, strict=True):
        earlier = [
            (float(other[other < days[0]].max()), n)
            for n, other in enumerate(stamps)
            if (other < days[0]).any()
        ]
        before = recordings[max(earlier)[1]] if earlier else None
        linked.append(replace(recording, before=before))
    return linked


def _start(tables: Mapping[str, Table]) -> dict[str, float]:
    """Start of each array after the first frame of the acquisition, s; in order if unknown."""
    stamps = {name: frame_days(table) for name, table in tables.items()}
    if all(np.isfinite(s).all() for s in stamps.values()):
        first = min(float(s.min()) for s in stamps.values())
        return {name: float(s[0] - first) * DAY_S for name, s in stamps.items()}
    starts, clock = {}, 0.0
    for name, table in tables.items():
        starts[name] = clock
        clock += float(np.ptp(np.array(table["time_s"], float)))
    return starts


def _light(
    evidence: Sequence[Evidence],
    halves: Sequence[FrameSubset],
    name: str,
    numbers: Indices,
    exposure_and_step: tuple[float, int],
) -> F64:
    """Light (t,) of flats of an exposure time (s; zero: unknown) and a step of the lamp."""
    exposure, step = exposure_and_step
    light = np.full(len(numbers), np.nan)
    # Both halves use the same dark signal, which charge left by light makes larger in one of them,
    # and flats of the same mean, since the medians of colours jump.
    black = [
        one.bias[one.good].mean() + exposure * one.dark_rate[one.good].mean() / one.gain
        for one in evidence
    ]
    good = np.all([one.good for one in evidence], axis=0)
    usual = [one.flat[good].mean() for one in evidence]
    for one, half, own_black, own_usual in zip(evidence, halves, black, usual, strict=True):
        frames = np.flatnonzero(np.isin(numbers, half[name]))
        for stack in one.of_kind("flat"):
            known = np.isfinite(stack.exptime_s)
            same = np.isclose(stack.exptime_s, exposure) if known else exposure == 0
            if same and stack.step == step and len(stack.adu) == len(frames):
                above = light_of(one, stack) + one.gain * (own_black - np.mean(black))
                relative = one.flat[one.good].mean() / own_usual
                light[frames] = above / (relative * np.mean(usual))
    return light


def _top(
    acquisition: Acquisition,
    evidence: Evidence,
    sets: Sequence[SetTruth],
    dtypes: Mapping[str, np.dtype[Any]],
) -> float:
    """Highest sample, ADU."""
    ends = [np.iinfo(d).max if d.kind in "iu" else np.inf for d in dtypes.values()]
    end = min(acquisition.detector.saturation_adu or np.inf, *ends)
    for truth in sets:
        peak = float(np.median(truth.light * (1 + truth.contrast))) / evidence.gain
        if end > TOP_ADU < peak + float(np.median(evidence.bias)):
            raise InputError(
                f"fringes reach {peak:.0f} ADU above the bias: samples above 65535 ADU cannot be "
                "simulated; give frames of a 16-bit converter"
            )
    return float(min(end, TOP_ADU))
