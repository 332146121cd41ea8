"""Outputs of a detector whose conversion gains differ."""

from typing import Any

from pixcal.estimators.detector.amplifiers import Outputs, differing_outputs
from pixcal.report.text import with_error
from pixcal.stages.reduce.detector_summary import Summary
from pixcal.stages.reduce.frame_statistics import STATISTICS
from pixcal.stages.reduce.halves import Window
from pixcal.storage.artefact import Build
from pixcal.storage.cube import ArrayReader

_NAMED = 8  # most outputs that a sentence names


def outputs_of(made: Build, summary: Summary, middle: Window) -> Outputs | None:
    """Outputs that read the middle of the detector, if gains differ; None if that is unknown."""
    if summary.gain is None:
        return None
    maps, at = made.folder / "calibration.zarr", STATISTICS.index("shot")
    shot = ArrayReader(made.scratch / "statistics" / "maps").read((at, at + 1), *middle)[0]
    flat, mask = (ArrayReader(maps / name).read(*middle) for name in ("flat", "mask"))
    first = middle[0][0], middle[1][0]
    return differing_outputs(flat.astype(float), shot.astype(float), mask == 0, first)


def report_outputs(
    found: Outputs, gain: float, facts: dict[str, Any], shape: tuple[int, ...]
) -> str:
    """Words on the gain of each output, which is also added to the contents of ``reduce.json``.

    ``gain``: of all outputs together (e-/ADU). ``shape``: of the detector.
    """
    sides = found.of_pixel.shape
    looked_at = "" if sides == shape else " in the middle {} × {} pixels".format(*sides)
    each = zip(found.names, gain * found.gain, gain * found.gain * found.error, strict=True)
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
        f"the gain differs between outputs{looked_at} ({words}): electrons are counted by one gain "
        "for all, and the flat map removes the steps"
    )
    return f"of all outputs together: {words}"
