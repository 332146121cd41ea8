"""Maps as parts of the page: an image with one pixel per block, axes and colour bar in SVG.

The browser enlarges the image. Matplotlib would take 80 ms for each map with its colour bar.
"""

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray
from PIL import Image

from pixcal.model.arrays import F64, U8
from pixcal.model.flags import PixelFlag
from pixcal.report.colours import FLAGS, LEVELS, MARKS, MASKED, SEQUENTIAL, SEVERAL, UNFLAGGED
from pixcal.report.contents import MapContents, SetContents
from pixcal.report.drawing import block_note, covered, fit_box, span_scale, unit_for
from pixcal.report.map_summary import FlagSummary, MapSummary, Spectrum
from pixcal.report.text import SYMBOLS, exact

Ticks = list[tuple[float, str]]  # places (page px) and their numbers
Legend = list[tuple[str, str]]  # colours and what they mean

BOX = 370.0  # longest side of a map on the page, px
BAR_COLOURS = [to_hex(c) for c in SEQUENTIAL(np.arange(LEVELS))]


@dataclass(frozen=True)
class Mark:
    """A place (page px) that is marked on a map, by a circle or a square."""

    x: float
    y: float
    colour: str
    title: str
    round: bool


@dataclass(frozen=True)
class Panel:
    """A map as the template draws it; lengths are page px, y downwards."""

    title: str
    src: str  # data URL of the image
    width: float
    height: float
    labels: tuple[str, str]  # of x and y
    x: Ticks
    y: Ticks
    bar: str = ""  # data URL of the colour bar; empty if colours are classes
    label: str = ""  # quantity and unit of the colours
    colours: Ticks = field(default_factory=list)
    beyond: str = "neither"  # ends of the colours that values exceed: neither, min, max, both
    marks: tuple[Mark, ...] = ()


def ticks(low: float, high: float, length: float, *, upwards: bool, log: bool = False) -> Ticks:
    """Round numbers of an axis from ``low`` to ``high``, and their places."""
    locator = LogLocator(numticks=6) if log else MaxNLocator(5)
    values = [float(v) for v in locator.tick_values(low, high) if low <= v <= high]
    ends = np.log([low, high]) if log else np.array([low, high])
    places = ((np.log(values) if log else np.array(values)) - ends[0]) / (ends[1] - ends[0])
    places = length * (1 - places if upwards else places)
    return [(float(at), exact(value)) for at, value in zip(places, values, strict=True)]


def _image(classes: U8, colours: Sequence[str]) -> str:
    """Picture of the colours with these numbers, y upwards."""
    picture = Image.fromarray(np.ascontiguousarray(classes[::-1]))
    picture.putpalette([round(255 * v) for c in colours for v in to_rgb(c)])
    # A picture as a PNG that is part of the page.
    out = io.BytesIO()
    picture.save(out, "PNG")
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode("ascii")


def scaled(image: NDArray[np.floating], low: float, high: float, *, log: bool = False) -> U8:
    """Index of the colour of each value; one past the last if there is no value."""
    ends = np.log([low, high]) if log else np.array([low, high])
    with np.errstate(invalid="ignore", divide="ignore"):
        values = np.log(image) if log else image.astype(float)
    there = np.isfinite(values)
    share = (np.where(there, values, ends[0]) - ends[0]) / (ends[1] - ends[0])
    level = np.clip(np.floor(share * LEVELS), 0, LEVELS - 1)
    return np.where(there, level, LEVELS).astype(np.uint8)


_BAR = _image(np.arange(LEVELS, dtype=np.uint8)[:, None], BAR_COLOURS)


def map_panel(title: str, label: str, summary: MapSummary, factor: float = 1.0) -> Panel:
    """A map whose colours span its values; ``factor`` takes them to the unit of ``label``."""
    image = summary.image * factor
    scale = span_scale(image)
    title = ", ".join(filter(None, (title, block_note(summary))))
    panel = _panel(title, scaled(image, scale.low, scale.high), [*BAR_COLOURS, MASKED], summary)
    return _with_bar(panel, label, scale.low, scale.high, scale.beyond)


def _panel(
    title: str, classes: U8, colours: Sequence[str], summary: MapSummary | FlagSummary
) -> Panel:
    """A map in the colours of some classes, with axes in pixels of the detector."""
    width, height = fit_box(summary.shape, BOX, BOX, 60.0)
    left, right, bottom, top = covered(summary.image.shape, summary.block)
    x = ticks(left, right, width, upwards=False)
    y = ticks(bottom, top, height, upwards=True)
    return Panel(title, _image(classes, colours), width, height, ("x (px)", "y (px)"), x, y)


def _with_bar(
    panel: Panel, label: str, low: float, high: float, beyond: str, *, log: bool = False
) -> Panel:
    colours = ticks(low, high, panel.height, upwards=True, log=log)
    return replace(panel, bar=_BAR, label=label, colours=colours, beyond=beyond)


def levels(sets: Sequence[SetContents]) -> Iterator[Panel]:
    """Mean level and visibility of each set."""
    for s in sets:
        yield map_panel(f"{s.name}: mean level", "ι (e⁻)", s.iota)
        yield map_panel(f"{s.name}: visibility", "α/ι", s.visibility)


def errors(maps: Sequence[MapContents]) -> Iterator[Panel]:
    """Error of each map of offsets."""
    for offset in maps:
        unit, symbol = unit_for([offset.sigma.median], "px"), SYMBOLS[offset.name]
        yield map_panel(f"error of {symbol}", f"σ ({unit.label})", offset.sigma, unit.factor)


def residuals(sets: Sequence[SetContents]) -> Iterator[Panel]:
    """Reduced chi-square of each set."""
    for s in sets:
        yield map_panel(f"set {s.name}", "reduced χ²", s.chi2)


def calibration(maps: Sequence[tuple[str, str, MapSummary]]) -> list[Panel]:
    """Calibration maps: (title, unit, summary)."""
    return [map_panel(title, unit, summary) for title, unit, summary in maps]


# Power spectra


def spectra(
    maps: Sequence[MapContents], vectors: Mapping[str, tuple[float, float]]
) -> tuple[list[Panel], Legend]:
    """Power spectra over that of white noise, with marks at the fringe vectors (rad/px)."""
    panels = [_spectrum(SYMBOLS[m.name], m.spectrum, vectors) for m in maps if m.spectrum]
    return panels, [(MARKS[n % len(MARKS)], f"set {name}") for n, name in enumerate(vectors)]


def _spectrum(symbol: str, spectrum: Spectrum, vectors: Mapping[str, tuple[float, float]]) -> Panel:
    relative = spectrum.power / spectrum.white if spectrum.white > 0 else spectrum.power
    positive = relative[relative > 0]
    low, high = np.percentile(positive, [1, 99.9]) if len(positive) else (0.1, 10.0)
    high = max(high, 3 * low)
    src = _image(scaled(relative, low, high, log=True), [*BAR_COLOURS, MASKED])
    x, y = (ticks(-0.5, 0.5, BOX, upwards=upwards) for upwards in (False, True))
    labels = ("fx (cycles/px)", "fy (cycles/px)")
    panel = Panel(f"spectrum of {symbol}", src, BOX, BOX, labels, x, y)
    marks = [
        mark
        for n, (name, vector) in enumerate(vectors.items())
        for mark in fringe_marks(name, vector, MARKS[n % len(MARKS)])
    ]
    panel = replace(panel, marks=tuple(marks))
    return _with_bar(panel, "power / white noise", low, high, "both", log=True)


def fringe_marks(name: str, vector: tuple[float, float], colour: str) -> Iterator[Mark]:
    """The fringe frequency (circles) and its double (squares), at both signs."""
    for order, words in ((1, "fringes"), (2, "twice the fringe frequency")):
        for sign in (1, -1):
            fx, fy = folded(sign * order * np.array(vector) / (2 * np.pi))
            yield Mark(
                BOX * (fx + 0.5), BOX * (0.5 - fy), colour, f"{name}: {words}", round=order == 1
            )


def folded(frequency: F64) -> F64:
    """Frequencies as they appear on the grid of pixels, in ±1/2."""
    return np.asarray((frequency + 0.5) % 1 - 0.5)


# Flags


def flags(masks: Mapping[str, FlagSummary]) -> tuple[list[Panel], Legend]:
    """Maps of flags; identical ones are drawn once."""
    # Pixel by pixel each flag has its colour; of larger maps the share of masked pixels is shown.
    most = 100 * max(float(s.share.max()) for s in masks.values()) or 1.0
    merged: dict[tuple[bytes, tuple[int, ...]], tuple[list[str], FlagSummary]] = {}
    for title, summary in masks.items():
        key = (summary.image.tobytes(), tuple(summary.counts.values()))
        merged.setdefault(key, ([], summary))[0].append(title)
    panels = [_flags(", ".join(titles), summary, most) for titles, summary in merged.values()]
    if next(iter(masks.values())).block > 1:
        return panels, []
    there = [f for f in PixelFlag if any(s.counts[f.value] for s in masks.values())]
    legend = [(FLAGS[f.value], f.words) for f in there]
    return panels, [*legend, (SEVERAL, "several")]


def _flags(title: str, summary: FlagSummary, most: float) -> Panel:
    if summary.block == 1:
        colours = [UNFLAGGED, *FLAGS.values(), SEVERAL]
        # 0 for good, 1 + bit for one flag, one more than all bits for several.
        bits = np.unpackbits(summary.image[..., None], axis=-1, bitorder="little").astype(np.uint8)
        several = np.uint8(len(FLAGS) + 1)
        number = (bits * np.arange(1, 9, dtype=np.uint8)).sum(axis=-1, dtype=np.uint8)
        return _panel(title, np.where(bits.sum(axis=-1) > 1, several, number), colours, summary)
    shown = scaled(100 * summary.share, 0, most)
    panel = _panel(title, shown, [*BAR_COLOURS, MASKED], summary)
    label = f"masked (%) of {summary.block} × {summary.block} px"
    return _with_bar(panel, label, 0, most, "neither")
