"""What a reduction measured, and the contents of ``reduce.json``."""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixcal.engine.run import Runtime
from pixcal.model.arrays import Mask
from pixcal.model.flags import PixelFlag
from pixcal.model.options import Reduce as Config
from pixcal.stages.reduce.black_cut_off import cut_off_warnings
from pixcal.stages.reduce.dark_levels import level_warnings
from pixcal.stages.reduce.detector_summary import Summary
from pixcal.stages.reduce.detector_warnings import detector_warnings, lamp_warnings, trail_warnings
from pixcal.stages.reduce.figures_of_merit import characterise
from pixcal.stages.reduce.fringe_sets import Bounds, set_warnings, share_at_mean
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.reduce.measuring import Measuring
from pixcal.stages.reduce.read_noise import Nearby
from pixcal.stages.reduce.subtracted import subtracted_warnings
from pixcal.stages.tiles import STRIP, indices, span, strips
from pixcal.storage.artefact import Build
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.manifest import write_json
from pixcal.storage.place import Place

SCHEMA = "pixcal/reduce/1"
_LINES = 4  # fewest neighbouring rows or columns without light to report


@dataclass(frozen=True)
class Reduction:
    """Results of a reduction other than cubes and maps."""

    job: Measuring  # how the calibration frames were measured
    summary: Summary  # their results for the whole detector
    gain: float  # used gain, e-/ADU
    bounds: Bounds  # extremes over the good pixels
    sets: dict[str, dict[str, Any]]  # entry of each fringe set in ``reduce.json``

    def noise(self, config: Config) -> dict[str, Any]:
        """Entries of ``reduce.json`` on gain, read noise and subtracted dark signal."""
        summary, gain, fitted = self.summary, self.gain, self.summary.gain
        noise = summary.noise_measured_e(summary.before_rounding, gain)
        total = summary.noise_measured_e(summary.read_noise, gain)
        return {
            "gain_e_per_adu": {
                "declared": summary.declared.gain_e_per_adu,
                "measured": fitted.of_electrons[0] if fitted else None,
                "error": fitted.of_electrons[1] if fitted else None,
                "chi2_reduced": fitted.chi2_reduced if fitted else None,
                "levels_adu": list(fitted.levels) if fitted else None,
                "neighbours": [list(lag) for lag in fitted.neighbours] if fitted else [],
                "without_dark": fitted.without_dark if fitted else None,
                "of_noise": [fitted.gain, fitted.error] if fitted else None,
                "used": gain,
                "used_from": "measured" if summary.declared.gain_e_per_adu is None else config.gain,
            },
            "read_noise_e": {
                "declared": summary.declared.read_noise_e,
                "measured": noise[0] if noise else None,
                "error": noise[1] if noise else None,
                "with_rounding": total[0] if total else None,
                "before_rounding": summary.noise_before_rounding_e(gain),
                "used": self.bounds.read_noise,
                "used_error": gain * summary.read_noise[1] if summary.read_noise else None,
            },
            "subtracted_dark_e_s": gain * self.job.subtracted[0],
        }


def write_reduction(
    made: Build, source: Ingested, config: Config, reduction: Reduction, runtime: Runtime
) -> None:
    """Write ``reduce.json``, and its main results into the summary of the manifest."""
    job, summary, sets = reduction.job, reduction.summary, reduction.sets
    piled = source.saturation_found if source.detector.saturation_adu is None else None
    warnings = [*source.exposures.warnings, *cut_off_warnings(source.cut_off)]
    warnings += subtracted_warnings(job.subtracted, reduction.gain)
    nearby = summary.read_noise and Nearby.of(job, summary.read_noise[0] ** 2)
    warnings += detector_warnings(summary, reduction.gain, piled, nearby)
    if source.survey is not None and source.exposures.known:
        light = source.survey.levels
        warnings += lamp_warnings([(g.exptime, light[list(g.frames)]) for g in job.flat])
    warnings += level_warnings(source, reduction.gain, summary.read_noise_e(reduction.gain))
    warnings += trail_warnings(made.folder / "calibration.zarr", source, reduction.gain)
    warnings += _dark_lines(ArrayReader(made.folder / "calibration.zarr" / "mask"), source.shape)
    for name, facts in sets.items():
        warnings += set_warnings(name, facts, source.detector.saturation_adu, config.rounding_share)
        facts["quantisation"]["share_at_mean"] = share_at_mean(facts, reduction.bounds)
        facts["flags"] = _count_flags(made.cubes / "reduced.zarr" / name / "mask", source.shape)
    report = {
        "schema": SCHEMA,
        **reduction.noise(config),
        "linearity": linearity_report(summary, job, reduction.gain),
        "saturation_adu": {
            "declared": source.detector.saturation_adu,
            "found": source.saturation_found,
            "used": job.saturation if math.isfinite(job.saturation) else None,
            "levels_left_out": int((~summary.usable).sum()),
            "full_frames": _flats(source, summary.full),
            "frames_above_step": _flats(source, summary.above_step),
        },
        "flags": _count_flags(made.folder / "calibration.zarr" / "mask", source.shape),
        "quantisation": {name: facts.pop("quantisation") for name, facts in sets.items()},
        "sets": sets,
        "warnings": warnings,
    }
    report["figures_of_merit"] = characterise(made, source, job, summary, nearby, report, runtime)
    write_json(made.folder / "reduce.json", report)
    made.summary.update({key: report[key] for key in ("gain_e_per_adu", "flags", "warnings")})


def _flats(source: Ingested, levels: Mask) -> list[int]:
    """Numbers of the flats of some levels (step,)."""
    chosen = zip(source.exposures.flat, levels, strict=True)
    return sorted(frame for group, wanted in chosen if wanted for frame in group.frames)


def _dark_lines(mask: ArrayReader, shape: tuple[int, int]) -> Iterator[str]:
    """Warnings on neighbouring rows or columns without any light."""
    dark = {"rows": np.ones(shape[0], np.bool_), "columns": np.ones(shape[1], np.bool_)}
    for strip in strips(indices(shape), STRIP):
        (y0, y1), (x0, x1) = span(shape, strip)
        dead = mask.read((y0, y1), (x0, x1)) & PixelFlag.DEAD > 0
        dark["rows"][y0:y1] &= dead.all(axis=1)
        dark["columns"][x0:x1] &= dead.all(axis=0)
    for name, lines in dark.items():
        ends = np.flatnonzero(np.diff(lines, prepend=False, append=False)).reshape(-1, 2)
        spans = [f"{a} to {b - 1}" for a, b in ends if b - a >= _LINES]
        if spans and not lines.all():
            yield (
                f"{name} {', '.join(spans)} see no light and are masked as dead: an overscan, or a "
                "border of the detector"
            )


def _count_flags(mask: Place, shape: tuple[int, int]) -> dict[str, int]:
    """Pixels with each flag, and without any."""
    reader = ArrayReader(mask)
    counts: Counter[str] = Counter()
    for strip in strips(indices(shape), STRIP):
        values = reader.read(*span(shape, strip))
        counts["good"] += int((values == 0).sum())
        for flag in PixelFlag:
            counts[str(flag.name).lower()] += int((values & flag > 0).sum())
    return dict(counts)


def linearity_report(summary: Summary, job: Measuring, gain: float) -> dict[str, Any] | None:
    """Entry of ``reduce.json`` on the exposure-time steps of flats; None without them."""
    if summary.linearity is None:
        return None
    linearity, line = summary.linearity, summary.linearity.line
    rows = zip(job.flat, summary.levels, line.deviation, strict=True)
    return {
        "max_deviation_percent": 100 * linearity.largest,
        "error_percent": None if linearity.error is None else 100 * linearity.error,
        "intercept_adu": line.intercept,
        "exposure_offset_s": line.late[0],
        "exposure_step_s": linearity.rounded or None,
        "lamp_drift_percent": 100 * linearity.drift,
        "levels": [
            {
                "exptime_s": group.exptime,
                "frames": len(group.frames),
                "level_adu": float(level),
                "level_e": float(gain * level),
                "deviation_percent": 100 * float(off) if math.isfinite(off) else None,
            }
            for group, level, off in rows
        ],
    }
