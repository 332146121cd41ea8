"""Input of a diagnosis: windows of a reduced run, their nominal bench, their statistics."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from pixcal.engine.plan import Plan, make_plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.config import parse
from pixcal.model.errors import InputError
from pixcal.stages import reduce
from pixcal.stages.diagnose.candidates import NO_EFFECTS, Considered
from pixcal.stages.diagnose.frames import (
    FramesUsed,
    Split,
    frames_of,
    frames_of_half,
    in_series,
    missing_frames,
    split,
)
from pixcal.stages.diagnose.measure_nominal import nominal_bench
from pixcal.stages.diagnose.parts import FrameSubset, RawFrames, RunFrames, evidence_of, take
from pixcal.stages.diagnose.trial import Curves, Window, averaged, measured_curves
from pixcal.stages.diagnose.windows import chosen_windows
from pixcal.stages.evidence import excess_noise_factor
from pixcal.stages.reduce.black_cut_off import Black
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.tiles import Part
from pixcal.storage.manifest import read_json
from pixcal.storage.stage import read_acquisition, require

# evidence in memory and its run, for each sample of all fringe sets (measured, like the next two)
EVIDENCE_BYTES = 34
CALIBRATION_BYTES = 12  # a sample of bias, dark or flat: as read, in its run, and as a real number
LOOK_BYTES = 50  # additional, for the statistics of one set: for each sample of the largest set
ESTIMATE_BYTES = 130  # additional, for the largest estimate, which is that of crosstalk
FEWEST_FRAMES = 24  # fringe frames in each half


@dataclass(frozen=True)
class DiagnosisInput:
    """Windows, frames and statistics of a diagnosis."""

    first: Window  # window to which effects are fitted
    windows: tuple[Window, ...]  # windows on which they are tested
    each: tuple[Curves, ...]  # curves of the test frames of each window
    facts: FramesUsed
    # runtime, few: with as many workers as fit in memory, for simulations and for estimates
    runtime: Runtime
    few: Runtime
    # whether memory suffices to run estimates in this process in parallel with simulations
    room: bool
    effects: Considered
    learn: Callable[[], RawFrames]  # reads the frames to which effects are fitted again

    @cached_property
    def measured(self) -> Curves:
        """Mean curves of the windows."""
        return averaged(self.each)


def prepare_input(
    run_dir: Path, runtime: Runtime, effects: Considered = NO_EFFECTS
) -> DiagnosisInput:
    """Select the parts of a reduced run to analyse; measure nominal bench, statistics and effects.

    Raises InputError: too few frames, or a part cannot be fitted.
    """
    ingested, reduced = Ingested(run_dir / "ingest"), read_json(run_dir / "reduce" / "reduce.json")
    frames, shape = _run_frames(run_dir, ingested, reduced), ingested.shape
    tables, fringes = frames.tables, bool(frames.acquisition.frames.fringes)
    first, parts = chosen_windows(shape, 0 if fringes else frames_of_half(tables))
    pixels = (first[0][1] - first[0][0]) * (first[1][1] - first[1][0])
    # The nominal bench has one gain, and pixels that are not full.
    ends = reduced["saturation_adu"]
    other = (n for key in ("full_frames", "frames_above_step") for n in ends.get(key, ()))
    subsets = split(tables, pixels, sorted(other))
    _enough(subsets.test)
    runtime, few, room = _memory(subsets.test, pixels, runtime)
    windows: list[Window] = []
    left_out: list[dict[str, Any]] = []
    measured: list[Curves] = []
    for part in dict.fromkeys((first, *parts)):
        raws = [take(ingested, frames, half, part) for half in (subsets.learn, subsets.test)]
        seed = windows[0].seed if windows else raws[0].checksum
        try:
            number = len(windows) + len(left_out) + 1
            halves = _evidence(run_dir, part, shape, raws, runtime, number)
        except InputError as error:
            # A corner may have no light; effects are fitted in the middle.
            if part == first or len(left_out) == len(parts) - 1:
                raise
            left_out.append({"window": part, "reason": str(error)})
            continue
        finally:
            del raws
        # A bench with slightly brighter flats is analysed at the same levels.
        full = halves[0].saturated | halves[1].saturated
        halves = [replace(half, full=full) for half in halves]
        if not windows:
            effects = effects.estimated(halves[0], halves[1], few)
        bench = nominal_bench(frames, halves, (subsets.learn, subsets.test), shape)
        windows.append(Window(part, bench, subsets.learn, subsets.test, shape, seed, full))
        if part in parts:
            measured.append(measured_curves(halves[1], effects.signatures))
    tried = tuple(w for w in windows if w.part in parts)
    facts = _frames_used(frames, subsets, windows[0], tried, left_out)
    effects.note_missing(facts)
    learn = partial(take, ingested, frames, subsets.learn, first)
    return DiagnosisInput(
        windows[0], tried, tuple(measured), facts, runtime, few, room, effects, learn
    )


def _run_frames(run_dir: Path, ingested: Ingested, reduced: Mapping[str, Any]) -> RunFrames:
    """All frames of a run; every window uses the saturation level of the whole detector."""
    gain, subtracted = reduced["gain_e_per_adu"], float(reduced.get("subtracted_dark_e_s") or 0.0)
    acquisition = read_acquisition(run_dir)
    detector = replace(
        acquisition.detector,
        saturation_adu=acquisition.detector.saturation_adu or ingested.saturation_found,
        gain_e_per_adu=acquisition.detector.gain_e_per_adu or float(gain["used"]),
    )
    options = reduce.Config.__dataclass_fields__
    known = {k: v for k, v in require(run_dir, "reduce").config.items() if k in options}
    return RunFrames(
        replace(acquisition, detector=detector),
        in_series(ingested.tables),
        {name: array.dtype for name, array in ingested.arrays.items()},
        parse(reduce.Config, known, str(run_dir / "reduce" / "manifest.json")),
        Black(
            ingested.cut_off,
            gain.get("without_dark"),
            subtracted / float(gain["used"]),
            excess_noise_factor(gain),
        ),
    )


def _frames_used(
    frames: RunFrames,
    subsets: Split,
    first: Window,
    tried: Sequence[Window],
    left_out: Sequence[dict[str, Any]],
) -> FramesUsed:
    steps = [s.step for s in first.bench.measured.sets]
    return FramesUsed(
        first.whole,
        {"window": first.part, "frames": frames_of(subsets.learn)},
        {"windows": tuple(w.part for w in tried), "frames": frames_of(subsets.test)},
        tuple(left_out),
        subsets.shared,
        tuple(kind for kind in ("bias", "dark", "flat") if kind in frames.tables),
        {s.name: s.baseline_mm for s in frames.acquisition.frames.fringes},
        missing_frames(frames.acquisition, frames.tables, steps),
    )


def _memory(half: FrameSubset, pixels: int, runtime: Runtime) -> tuple[Runtime, Runtime, bool]:
    """Workers for simulations and for estimates; whether an estimate fits beside simulations."""
    # Samples of a window: in the largest fringe set and in all; without fringes in all frames.
    counts = [len(frames) for name, frames in half.items() if "/" in name]
    counts = counts or [sum(map(len, half.values()))]
    largest, evidence = pixels * max(counts), pixels * sum(counts)
    frames = sum(len(frames) for name, frames in half.items() if "/" not in name)
    held = EVIDENCE_BYTES * evidence + CALIBRATION_BYTES * pixels * frames
    need, estimates = held + LOOK_BYTES * largest, ESTIMATE_BYTES * largest
    for_estimates = make_plan("diagnose", estimates, held, runtime)
    plan = make_plan("diagnose", need, 0, runtime)
    room = (
        runtime.cluster == "threads"
        and plan.workers > 1
        and Plan(need, held + estimates, plan.workers - 1).total <= runtime.memory
    )
    few = runtime.with_workers(for_estimates.workers)
    return runtime.with_workers(plan.workers), few, room


def _evidence(
    run_dir: Path,
    part: Part,
    shape: tuple[int, int],
    raws: Sequence[RawFrames],
    runtime: Runtime,
    number: int,
) -> list[Evidence]:
    """Evidence of both halves of the frames of a window, reduced and fitted."""

    def of_half(item: tuple[str, RawFrames]) -> Evidence:
        which, raw = item
        try:
            return evidence_of(raw, part, shape)
        except InputError as error:
            raise InputError(f"{run_dir}: in the {which} frames, {error}") from error

    halves = list(zip(("fitted", "held-out"), raws, strict=True))
    return run_tasks(of_half, halves, runtime.here, label=f"window {number}")


def _enough(half: FrameSubset) -> None:
    for name, frames in half.items():
        if "/" in name and len(frames) < FEWEST_FRAMES:
            raise InputError(
                f"{name}: only {len(frames)} frames in one half; diagnose needs {FEWEST_FRAMES} in "
                "each: it fits effects on one and tests them on the other"
            )
