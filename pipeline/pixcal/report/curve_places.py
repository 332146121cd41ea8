"""Abscissae of a statistic's curve in words: which row, which neighbour, which period."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pixcal.report.text import number

_STEPS = ("x+1", "y+1", "x+1 y+1", "x−1 y+1", "x+2", "y+2", "x+3", "y+3", "x+4", "y+4")


@dataclass(frozen=True)
class _Axis:
    """The places of a curve: the label of the axis, a place within a sentence, its names."""

    label: str
    phrase: str
    names: tuple[str, ...] = ()


_SIDES = ("x−1", "x+1", "y−1", "y+1")
_ROWS_OF_FOUR = tuple(f"{step} r{row}" for step in ("y+1", "x+1") for row in range(4))
_LINES = tuple(f"{n} {of}{'s' * (n > 1)}" for of in ("row", "column") for n in range(1, 5))
_BANDS = ("≥ 8 px", "4 to 8 px", "2.7 to 4 px", "2 to 2.7 px", "2 rows", "2 columns")
_HALF_WAVES = ("1 to 3", "4 to 9", "10 on")
_CELLS = tuple(f"{row},{column}" for row in range(1, 5) for column in range(1, 5))
_TERMS = tuple(f"{of} {f} {n}φ" for of in "VB" for n in ("", 2, 3) for f in ("cos", "sin"))
_SIGMAS = ("−5", "−7", "−10", "+5", "+7", "+10")

# by `x_label` of `curves.json`, where numbers alone would say little
_AXES = {
    "neighbour": _Axis("neighbour", "neighbour {}", _STEPS),
    "far neighbour": _Axis("neighbour", "neighbour {}", _STEPS[4:]),
    "row of four, down then right": _Axis("neighbour, row modulo 4", "neighbour {}", _ROWS_OF_FOUR),
    "left, right, above, below": _Axis("neighbour", "neighbour {}", _SIDES),
    "rows, columns": _Axis("", "{}", ("rows", "columns")),
    "distance: rows, then columns": _Axis("lines apart", "{} apart", _LINES),
    "band, then two rows, two columns": _Axis("period", "periods of {}", _BANDS),
    "bin of frequency": _Axis(
        "half-waves over the frames", "{} half-waves over the frames", _HALF_WAVES
    ),
    "cell of 4 × 4": _Axis("cell of the window", "cell {}", _CELLS),
    "contrast, light of each pair": _Axis("maps", "{}", ("contrast", "light") * 20),
    "term": _Axis("contrast V, then intensity B", "{}", _TERMS),
    "sigma, low then high": _Axis("beyond so many σ", "beyond {} σ", _SIGMAS),
    "quantile": _Axis("quantile of the pixels", "{} quantile"),
    "bin of level": _Axis("level, dark to bright", "level bin {} (0: darkest)"),
    "flat": _Axis("level of flats (0: shortest exposure)", "flats of level {}"),
    "period, rows": _Axis("period, rows", "every {} rows"),
    "period, columns": _Axis("period, columns", "every {} columns"),
    "frames before": _Axis("other frame", "frame {}"),
    "harmonic (cosine, sine)": _Axis("harmonic", "{}"),
    "exposure time of flats": _Axis("exposure time (s)", "flats of {} s"),
    "batches averaged": _Axis("batches averaged", "batches averaged: {}"),
}


def axis_label(curve: Mapping[str, Any]) -> str:
    """What the places of a curve are."""
    label = str(curve["x_label"])
    return _AXES[label].label if label in _AXES else label.replace(" a ", " per ")


def places(curve: Mapping[str, Any]) -> list[str]:
    """A name for each value of a curve."""
    label, x = str(curve["x_label"]), list(curve["x"])
    names = _AXES[label].names if label in _AXES else ()
    if not label and len(x) == 1:
        return ["all frames"]
    if len(names) >= len(x):
        return list(names[: len(x)])
    if label == "harmonic (cosine, sine)":
        return [f"{'sin' if v % 1 else 'cos'} {int(v) if int(v) > 1 else ''}ψ" for v in x]
    if label == "frames before":
        return [f"t{-int(v):+d}".replace("-", "−") for v in x]
    if label == "quantile":
        return [f"{100 * v:g} %" for v in x]
    return [number(int(v)) if v == int(v) else number(v, 3) for v in x]


def place(curve: Mapping[str, Any], at: int) -> str:
    """Position of a value in a curve, in words."""
    label, name = str(curve["x_label"]), places(curve)[at]
    if label in _AXES:
        return _AXES[label].phrase.format(name)
    if label.startswith("cycles a ") and curve["x"][at] > 0:
        period = number(1 / curve["x"][at], 2)
        return f"periods of {period} {'px' if label.endswith('pixel') else 'frames'}"
    return f"{label} {name}".strip()
