"""Figures of merit after EMVA 1288, as on a data sheet of the detector, with errors.

Spatial nonuniformity comes from averages of the even and of the odd frames of a series, read again
in the middle of the detector (at most `SIDE` pixels); the rest comes from earlier measurements.
"""

import math
from typing import Any

import numpy as np

from pixcal.engine.run import Runtime
from pixcal.estimators.detector import emva
from pixcal.estimators.detector.amplifiers import Outputs, differing_outputs
from pixcal.estimators.detector.emva import Measure, Nonuniformity
from pixcal.kernels.rounding import UNDETERMINED_BELOW, level_before_rounding
from pixcal.model.arrays import F64, Mask
from pixcal.report.text import with_error
from pixcal.stages.reduce.dark_current import dark_current
from pixcal.stages.reduce.detector_summary import Summary, pair_sums
from pixcal.stages.reduce.halves import Halves, middle_of, read_halves
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.reduce.measuring import STATISTICS, Measuring
from pixcal.stages.reduce.read_noise import Nearby, line_noise
from pixcal.stages.tiles import Part
from pixcal.storage.artefact import Build
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.manifest import write_json

Json = dict[str, Any]

_NAMED = 8  # most outputs that a sentence names
_WELL = 0.97  # share of the converter's range below which saturation is due to full wells


def characterise(
    made: Build,
    source: Ingested,
    job: Measuring,
    summary: Summary,
    nearby: Nearby | None,
    facts: Json,
    runtime: Runtime,
) -> Json:
    """Figures of merit, by name; writes their curves to ``figures_of_merit.json``.

    Each has ``title``, ``unit``, ``value``, ``error`` (null if unknown) and ``note``. ``facts``:
    present contents of ``reduce.json``.
    """
    entry = facts["gain_e_per_adu"]
    measured = entry["measured"] is not None
    gain = (entry["measured"], entry["error"]) if measured else (entry["used"], None)
    dark, *_ = pair_sums(made.scratch / "statistics", job)
    clipped = (source.detector.saturation_adu or source.saturation_found) is not None
    top, reached = _top(summary, job, clipped)
    top = top if job.dark else None  # levels above an unknown bias are meaningless
    middle = middle_of(source.shape)
    halves = read_halves(made, source, summary, top, middle, entry["used"], runtime)
    note = "" if measured else "declared, not measured"
    outputs = _outputs_of(made, summary, middle)
    if outputs is not None:
        note = _report_outputs(outputs, gain[0], facts, source.shape)
    figures: Json = {"conversion_gain": _figure("conversion gain", "e-/ADU", gain, note)}
    noise = _read_noise(figures, summary, gain[0], source.quantum)
    excess = 1.0 if summary.gain is None else summary.gain.excess[0]
    _line_noise(figures, dark, gain[0], job.shape, nearby)
    if top is not None:
        _full_well(figures, gain, excess, top, reached, noise)
    if facts["linearity"] is not None:
        departure = (facts["linearity"][key] for key in ("max_deviation_percent", "error_percent"))
        figures["linearity_error"] = _figure("linearity error, largest", "%", (*departure,))
    curves: Json = {"photon_transfer": _listed(summary.transfer.T, ("level", "variance", "error"))}
    of_noise = {"gain": gain[0] / excess, "read_variance": (noise or (0.0,))[0] ** 2}
    curves["photon_transfer"] |= of_noise
    if halves.dark is not None:
        facts["warnings"] += _dsnu(figures, curves, halves, summary, gain[0], source.quantum)
        if source.exposures.read_series and source.exposures.read_series.array in source.cut_off:
            why = figures["dsnu"]["note"], "lower limit: dark pixels are cut off at the lowest code"
            figures["dsnu"]["note"] = "; ".join(filter(None, why))
    if halves.flat is not None:
        light = halves.flat if outputs is None else halves.flat * outputs.of_pixel
        percent = np.stack([100 * emva.without_trend(half, halves.good) for half in light])
        facts["warnings"] += _spread(figures, curves, "prnu", "%", percent, halves.good)
    rate = dark_current(made, source, job, gain, gain[0] / entry["used"], middle)
    if rate is not None:
        figures["dark_current"] = _figure("dark current", rate.unit, rate.measure, rate.note)
        facts["warnings"] += rate.warnings
    for name, figure in figures.items():
        by_gain = figure["unit"].startswith("e-") and name != "conversion_gain"
        if by_gain and figure["error"] is not None:
            of_gain = figure["value"] * (gain[1] or 0.0) / gain[0]
            figure["error"] = math.hypot(figure["error"], of_gain)
    write_json(made.folder / "figures_of_merit.json", curves)
    return figures


def _figure(
    title: str, unit: str, measure: tuple[float, float | None], note: str = ""
) -> dict[str, Any]:
    value, error = measure
    return {"title": title, "unit": unit, "value": value, "error": error, "note": note}


def _read_noise(figures: Json, summary: Summary, gain: float, step: float) -> Measure | None:
    """Add read noise with and without rounding to steps, in e-; return it with rounding, in ADU."""
    whole, unrounded = summary.read_noise, summary.before_rounding
    if whole is None:
        return None
    steps = "ADU" if step == 1 else f"steps of {step:g} ADU"
    note = f"rounding to {steps} adds {step * gain / math.sqrt(12):.3g} e-" if step else ""
    if unrounded is None and note:
        note += "; too coarse to measure the noise without it"
    for name, title, noise, said in (
        ("read_noise_with_rounding", "read noise with rounding", whole, note),
        ("read_noise", "read noise without rounding", unrounded, ""),
    ):
        if noise is not None:
            electrons = gain * noise[0], gain * noise[1]
            figures[name] = _figure(title, "e-", electrons, said)
    return whole


def _line_noise(
    figures: Json, dark: F64, gain: float, shape: tuple[int, int], nearby: Nearby | None
) -> None:
    """Temporal noise common to the pixels of a row, or of a column."""
    for name, (shared, error) in line_noise(dark, shape).items():
        # What near pixels alone share is of a filter.
        if nearby is None or nearby.lines[name] > shared / 2:
            noise = math.sqrt(shared)
            title, note = f"{name} noise", "part of the read noise"
            figures[f"{name}_noise"] = _figure(
                title, "e-", (gain * noise, gain * error / (2 * noise)), note
            )


def _top(summary: Summary, job: Measuring, clipped: bool) -> tuple[Measure | None, bool]:
    """Saturation above bias (ADU, error) and True, or else the highest level and False."""
    # ``clipped``: whether the converter limits samples, not the wells.
    well, end = summary.well, job.saturation - summary.usual.bias
    if well is not None and (not clipped or sum(well) < _WELL * end):
        return well, True
    if not len(summary.levels) or not summary.usable.any():
        return None, False
    if clipped and (well is not None or not summary.usable.all()):
        return (end, job.quantum / 2), True
    return (float(summary.levels[summary.usable].max()), 0.0), False


def _full_well(
    figures: Json,
    gain: tuple[float, float | None],
    excess: float,
    top: Measure,
    reached: bool,
    noise: Measure | None,
) -> None:
    note = "" if reached else "lower limit: the flats do not saturate"

    def figure(title: str, unit: str, measure: Measure, more: str = "") -> Json:
        value, error = measure
        said = "; ".join(filter(None, (more, note)))
        return _figure(title, unit, (value, error if reached else None), said)

    figures["saturation"] = figure("saturation above bias", "ADU", top)
    well = gain[0] * top[0], gain[0] * top[1]
    figures["full_well"] = figure("full well", "e-", well)
    peak = math.sqrt(well[0] / excess)
    error = math.hypot(top[1] / top[0], (gain[1] or 0.0) / gain[0]) * peak / 2
    figures["snr_max"] = figure("largest signal-to-noise ratio", "", (peak, error))
    if noise is not None:
        electrons = noise[0] * gain[0], noise[1] * gain[0]
        ratio, error, decibels = emva.dynamic_range(well, electrons)
        figures["dynamic_range"] = figure("dynamic range", "", (ratio, error), f"{decibels:.1f} dB")


# Outputs of a detector whose conversion gains differ


def _outputs_of(made: Build, summary: Summary, middle: Part) -> Outputs | None:
    """Outputs that read the middle of the detector, if gains differ; None if that is unknown."""
    if summary.gain is None:
        return None
    maps, at = made.folder / "calibration.zarr", STATISTICS.index("shot")
    shot = ArrayReader(made.scratch / "statistics" / "maps").read((at, at + 1), *middle)[0]
    flat, mask = (ArrayReader(maps / name).read(*middle) for name in ("flat", "mask"))
    first = middle[0][0], middle[1][0]
    return differing_outputs(flat.astype(float), shot.astype(float), mask == 0, first)


def _report_outputs(
    outputs: Outputs, gain: float, facts: dict[str, Any], shape: tuple[int, ...]
) -> str:
    """Words on the gain of each output, which is also added to the contents of ``reduce.json``.

    ``gain``: of all outputs together (e-/ADU). ``shape``: of the detector.
    """
    sides = outputs.of_pixel.shape
    looked_at = "" if sides == shape else " in the central {} × {} pixels".format(*sides)
    each = zip(outputs.names, gain * outputs.gain, gain * outputs.gain * outputs.error, strict=True)
    entries: list[dict[str, Any]] = []
    entries += [{"where": n, "gain": float(g), "error": float(e)} for n, g, e in each if g > 0]
    said = [f"{e['where']}: {with_error(e['gain'], e['error'])}" for e in entries]
    if len(said) > _NAMED:
        order = sorted(entries, key=lambda entry: float(entry["gain"]))
        ends = [f"{e['gain']:.4g} ({e['where']})" for e in (order[0], order[-1])]
        said = [" to ".join(ends)]
    words = "; ".join(said) + " e-/ADU"
    facts["gain_e_per_adu"]["outputs"] = entries
    facts["warnings"].append(
        f"the gain differs between outputs{looked_at} ({words}): all signals are converted with "
        "one common gain, and the flat map removes the steps"
    )
    return f"of all outputs together: {words}"


# Nonuniformity


_TITLES = {"dsnu": "DSNU", "prnu": "PRNU"}
_ALTERNATES = 6.0  # least difference of even and odd lines to report, in its errors
_ALTERNATING_SHARE = 0.04  # least share of its square in the variance of the map


def _dsnu(
    figures: Json, curves: Json, halves: Halves, summary: Summary, gain: float, quantum: float
) -> list[str]:
    """Add DSNU before rounding, or with an error of how far rounded means follow the level."""
    assert halves.dark is not None
    step = quantum or 1e-9
    sigma = summary.noise_before_rounding_e(gain) / gain / step
    unrounded = gain * step * level_before_rounding(halves.dark / step, sigma)
    if summary.before_rounding is not None and sigma > UNDETERMINED_BELOW:
        return _spread(figures, curves, "dsnu", "e-", unrounded, halves.good)
    other: Json = {}
    _spread(other, {}, "dsnu", "e-", unrounded, halves.good)
    warnings = _spread(figures, curves, "dsnu", "e-", gain * halves.dark, halves.good)
    for name, figure in other.items():
        left = figure["value"] - figures[name]["value"]
        figures[name]["error"] = math.hypot(figures[name]["error"], left)
    return warnings


def _spread(
    figures: Json, curves: Json, name: str, unit: str, halves: F64, good: Mask
) -> list[str]:
    """Add standard deviations, spectra and profiles of a pair of maps; return pattern warnings."""
    pair = emva.without_gaps(halves[0], good), emva.without_gaps(halves[1], good)
    spread: Nonuniformity = emva.nonuniformity(*pair, int((~good).sum()))
    patterns = []
    for axis, lines in ((0, "row"), (1, "column")):
        size, error = emva.alternation(*pair, axis=axis)
        if size > _ALTERNATES * error and size**2 > _ALTERNATING_SHARE * spread.total[0] ** 2:
            differ = f"alternate {lines}s differ by {with_error(size, error)} {unit}"
            patterns.append((differ, size / 2))
    trend = ["quadratic trend of the lamp removed"] if name == "prnu" else []
    note = "; ".join([*trend, *(differ for differ, _ in patterns)])
    figures[name] = _figure(_TITLES[name], unit, spread.total, note)
    for part in ("row", "column", "pixel"):
        title = f"{_TITLES[name]} of {part}s"
        figures[f"{name}_{part}"] = _figure(title, unit, getattr(spread, part))
    mean = np.where(good, halves.mean(axis=0), np.nan)
    curves[name] = {"unit": unit}
    for axis, along in ((1, "rows"), (0, "columns")):
        *spectrum, noise = emva.spectrogram(*pair, axis=axis)
        curves[name][along] = _listed(spectrum, ("frequency", "amplitude")) | {"noise": noise}
        count = good.sum(axis=axis)
        filled = count > 0
        means = np.nansum(mean, axis=axis)[filled] / count[filled]
        curves[name][along] |= _listed(
            (np.flatnonzero(filled), means - means.mean()), ("at", "profile")
        )
    seen_in, removed_by = {"dsnu": ("bias or dark", "bias"), "prnu": ("flat", "flat")}[name]
    return [
        f"in the {seen_in} frames {differ}: a fixed pattern of period 2 px and amplitude "
        f"{amplitude:.3g} {unit}; the {removed_by} map removes it"
        for differ, amplitude in patterns
    ]


def _listed(columns: Any, names: tuple[str, ...]) -> Json:
    """Columns of numbers rounded to five digits."""
    return {
        name: [float(f"{v:.5g}") for v in column]
        for name, column in zip(names, columns, strict=True)
    }
