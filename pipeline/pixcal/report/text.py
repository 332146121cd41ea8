"""Numbers and names as text."""

import math
import re
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

NO_OFFSETS = "No pixel has a valid offset; see the masks."
NAMES = {"delta_x": "δx", "delta_y": "δy", "delta_fringe": "δ along the fringe axis"}
SYMBOLS = {"delta_x": "δx", "delta_y": "δy", "delta_fringe": "δ"}

_MODES = {
    "1": "the mean of the map (piston): degenerate with the origin of the fringe phase",
    "x": "a slope along x: degenerate with a small change of the fringe vector",
    "y": "a slope along y: degenerate with a small change of the fringe vector",
    "cos(psi)*iota/alpha": "fringes of the set's own period (cosine): degenerate with a free "
    "intensity in each frame",
    "sin(psi)*iota/alpha": "fringes of the set's own period (sine): likewise",
    "cos(2*psi)": "fringes of half that period (cosine): degenerate with a free amplitude in each "
    "frame",
    "sin(2*psi)": "fringes of half that period (sine): likewise",
}

_FIBRES = {
    "centre_x": "the position of the fibres along x",
    "centre_y": "the position of the fibres along y",
    "distance": "the distance of the fibres",
    "baseline_x": "the separation of the fibres along x",
    "baseline_y": "the separation of the fibres along y",
    "baseline_z": "the separation of the fibres along the optical axis",
}


def mode_in_words(name: str) -> str:
    """Meaning of a removed mode."""
    if name.startswith("d psi / d "):
        moved = name.removeprefix("d psi / d ")
        return f"how the fringes change with {_FIBRES.get(moved, moved)}"
    return _MODES.get(name, "a smooth mode of the fringe geometry")


def number(value: Any, digits: int = 3) -> str:
    """A number with some significant digits and a power of ten; a dash if unknown."""
    if value is None:
        return "–"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)
    if isinstance(value, int):
        return _grouped(f"{value:,}")
    if not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    mantissa, _, power = f"{value:.{digits - 1}e}".partition("e")
    exponent = int(power)  # of the rounded value: 0.9996 is 1.00
    if -3 <= exponent < 7:
        decimals = digits - 1 - exponent
        return _grouped(f"{round(value, decimals):,.{max(0, decimals)}f}")
    return f"{mantissa} × 10{str(exponent).translate(_SUPERSCRIPT)}".replace("-", "−")


def times(size: float) -> str:
    """A size in units of a scatter, whichever its sign: one decimal below ten, else none."""
    return f"{abs(size):.{0 if abs(size) >= 9.95 else 1}f}"


def exact(value: Any) -> str:
    """A number with up to six digits, as many as it needs."""
    text = number(value, 6)
    if not isinstance(value, float) or "." not in text:
        return text
    mantissa, times, power = text.partition(" × ")
    return mantissa.rstrip("0").rstrip(".") + times + power


def _grouped(text: str) -> str:
    """Thousands separated by a thin no-break space, and a real minus sign."""
    return text.replace(",", "\u202f").replace("-", "−")


SMALLEST = 1e-9  # share of a value below which an error is not that of a measurement


def with_error(value: float | None, error: float | None) -> str:
    """A value with two digits of its error."""
    if value is None or not math.isfinite(value):
        return "–"
    if error is None or not math.isfinite(error) or error <= 0:
        return number(value, 4)
    if error < SMALLEST * abs(value):
        return exact(value)
    exponent = math.floor(math.log10(error))
    if -6 <= exponent < 4:
        decimals = 1 - exponent
        rounded = (f"{round(v, decimals):,.{max(0, decimals)}f}" for v in (value, error))
        return _grouped(" ± ".join(rounded))
    power = math.floor(math.log10(max(abs(value), error)))
    decimals = max(0, power - exponent + 1)
    scale = 10.0**power
    text = f"({value / scale:.{decimals}f} ± {error / scale:.{decimals}f})".replace("-", "−")
    return f"{text} × 10{str(power).translate(_SUPERSCRIPT)}"


def unit(name: str) -> str:
    """A unit, or a note with units, in the usual notation."""
    for pattern, usual in _NOTATION.items():
        name = re.sub(pattern, usual, name)
    return name


# units as files write them, and in the usual notation
_NOTATION = {
    r"\bh\^-0\.5": "1/√h",
    r"\bh\^0\.5": "√h",
    r"\b(k?e)-(?!\w)": r"\1⁻",
    r"\bu([ms])\b": r"µ\1",
}


def ratio(above: float | None, below: float | None) -> float | None:
    """A quotient; None if a value is unknown, or the divisor zero."""
    return above / below if above is not None and below else None


def sigmas(value: float | None) -> str:
    """A significance; limited to a thousand sigma, beyond which numbers are meaningless."""
    if value is None:
        return "–"
    return "> 1000 σ" if value > 1000 else f"{number(float(value), 2)} σ"


def digits_apart(one: float, other: float) -> int:
    """Significant digits that resolve the difference of two values, at least three."""
    size, apart = max(abs(one), abs(other)), abs(one - other)
    if not (math.isfinite(size) and apart > 0):
        return 3
    return min(max(3, 1 + math.ceil(math.log10(size / apart))), 6)


def not_tested(diagnosis: Mapping[str, Any]) -> str:
    """Effects that the frames cannot show, with those that would, and statistics left out."""
    groups = diagnosis.get("not_tested", {})
    parts = [f"{', '.join(names)} (needs {frames})" for frames, names in groups.items()]
    if statistics := diagnosis.get("not_compared"):
        parts.append(f"{', '.join(statistics)} (no counterpart in the simulations)")
    return f"not tested: {'; '.join(parts)}" if parts else ""


def share(part: int, whole: int) -> str:
    """A part in per cent."""
    percent = 100 * part / max(whole, 1)
    return "0\u00a0%" if part == 0 else f"{number(percent, 2)}\u00a0%".replace(" ", "\u00a0")


def duration(seconds: float) -> str:
    """A time in a suitable unit."""
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{number(seconds / length)} {unit}"
    return f"{number(seconds)} s"


def chance(p: float) -> str:
    """A p-value, or its upper limit where it is very small."""
    return "< 10⁻¹²" if p <= 1e-12 else number(float(p), 2)


def share_by_law(cause: Mapping[str, Any]) -> float | None:
    """Share of the gap closed by the law of a cause, where it differs from that of the cause."""
    share: float = cause.get("gap_closed_by_law", cause["gap_closed"])
    return share if abs(share - cause["gap_closed"]) > 0.02 else None


def date_of_mjd(mjd: float) -> str:
    """Date and time, UTC, of a modified Julian date; leap seconds are not resolved."""
    moment = datetime(1858, 11, 17, tzinfo=UTC) + timedelta(days=mjd)
    return f"{moment:%Y-%m-%d %H:%M:%S}"
