"""Mean dark signal of a detector, and what the clipping of outliers leaves out of it."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from pixcal.estimators.detector import emva
from pixcal.stages.reduce.dark_levels import DarkLevels, late_rate, middle_rows
from pixcal.stages.reduce.frame_statistics import Measuring
from pixcal.stages.reduce.halves import Window
from pixcal.stages.reduce.ingested import Ingested
from pixcal.storage.artefact import Build
from pixcal.storage.cube import ArrayReader

_NO_ERROR = 1e-9  # ADU/s: below it all samples have one code
# relative error of the change of dark current by correcting noise that is cut off: it is not known
# which distribution the noise had
_OF_CORRECTION = 0.5
# least signal in outliers that is reported: errors, and share of the whole
_SURE, _NOTABLE = 5.0, 0.05


class DarkCurrent(NamedTuple):
    """Mean dark signal of good pixels."""

    measure: tuple[float, float | None]
    unit: str
    note: str
    warnings: tuple[str, ...]


def dark_current(
    made: Build,
    source: Ingested,
    job: Measuring,
    conversion: tuple[float, float | None],
    scale: float,
    middle: Window,
) -> DarkCurrent | None:
    """The dark current; its error is from frames, bias drift included. None if it is unknown.

    Without charge that light before the darks left, where that is told from a drift of the bias; a
    warning tells of either.
    ``conversion``: gain with its error (e-/ADU); ``scale``: over the gain used for the maps.
    """
    if not source.exposures.has_rate:
        return None
    folder = made.folder / "calibration.zarr"
    good = ArrayReader(folder / "mask").read(*middle) == 0
    if not good.any():
        return None
    rates = scale * ArrayReader(folder / "dark_rate").read(*middle)
    gain, of_gain = conversion[0], (conversion[1] or 0.0) / conversion[0]
    rows = middle_rows(middle)
    levels = DarkLevels.of(source, middle, good)
    slope = emva.dark_slope(levels.times, levels.means)
    error = gain * slope[1] if slope is not None and slope[1] > _NO_ERROR else None
    timed = any(source.tables["dark"]["exptime_s"])
    unit = "e-/s" if timed else "e-/exposure"
    notes = []
    if error is not None and slope is not None:
        left_out = gain * slope[0] - float(rates[rows][good[rows]].mean(dtype=float))
        if source.cut_off:
            error = math.hypot(error, _OF_CORRECTION * left_out)
        elif not job.subtracted[0] and left_out > max(_SURE * error, _NOTABLE * gain * slope[0]):
            notes.append(
                f"outliers that are left out hold {left_out:.2g} {unit} more: particles, or charge "
                "that an electron multiplier spreads widely"
            )
    note, rate = _temperature(source.tables), float(rates[good].mean(dtype=float))
    subtracted, off = job.subtracted
    if subtracted:
        # A variance in electrons goes with the square of the gain; that was found by a rough one.
        better = gain / job.gain
        rate = better * (rate + gain * subtracted)
        error = math.hypot(better * gain * off, rate * of_gain)
        note = f"by the noise of dark frames: the camera subtracts it from their level; {note}"
    given = not (subtracted or source.cut_off)  # whether the rate is that of the level
    late = late_rate(source, levels, gain, gain * job.read_noise) if given else None
    if late is not None and late.sure:
        rate, error = rate - late.rate, late.error
        notes.append(f"without {late.rate:.2g} {unit} that light before the darks left")
    warnings = () if late is None else (late.warning(unit),)
    return DarkCurrent((rate, error), unit, "; ".join([note, *notes]), warnings)


def _temperature(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Temperature of the frames without light, if in their headers."""
    known = [
        t
        for kind in ("dark", "bias")
        for t in tables.get(kind, {}).get("temperature_c", ())
        if t is not None
    ]
    if not known:
        return "temperature not in the headers"
    low, high = min(known), max(known)
    return f"at {low:.1f} °C" if high - low < 0.05 else f"at {low:.1f} to {high:.1f} °C"
