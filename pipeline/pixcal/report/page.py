"""The HTML page: a template for each section in `templates/`, filled from the contents of a run."""

import base64
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from pixcal import __version__
from pixcal.report import (
    detector_figures,
    diagnosis,
    diagnosis_figures,
    diagnosis_maps,
    diagnosis_words,
    findings,
    map_figures,
    map_panels,
    set_figures,
    summary,
    tables,
    text,
)
from pixcal.report.contents import Contents
from pixcal.report.drawing import png

# sections, each with the template of its name
SECTIONS = {
    "maps": "Maps of the offsets",
    "allan": "Allan deviation",
    "diagnosis": "Diagnosis: data compared with simulation",
    "levels": "Level and visibility",
    "temporal": "Frame by frame",
    "noise": "Residuals",
    "detector": "Detector",
    "masks": "Masks",
    "removed": "Removed modes",
    "provenance": "Provenance",
}
WITHOUT_FRINGES = ("diagnosis", "detector", "masks", "provenance")

# functions that templates may use for figures, tables and text
FIGURES = (
    vars(map_figures)
    | vars(set_figures)
    | vars(detector_figures)
    | vars(diagnosis_figures)
    | vars(diagnosis_maps)
)
DATA = vars(tables) | vars(diagnosis) | vars(diagnosis_maps)


def render(contents: Contents) -> str:
    """Draw all figures and write the page: HTML without external references."""
    what = "pixel offsets" if contents.has_fringes else "detector"
    name = contents.acquisition["detector"].get("name")
    return fill(
        "page",
        contents,
        title=f"{name}: {what}" if name else what.capitalize(),
        subtitle=_subtitle(contents),
        sections={
            section: title
            for section, title in SECTIONS.items()
            if contents.has_fringes or section in WITHOUT_FRINGES
        },
        version=__version__,
    )


def fill(template: str, contents: Contents, **values: Any) -> str:
    """The page, or a section of it."""
    blocks: Any = {"trim_blocks": True, "lstrip_blocks": True}
    environment = Environment(
        loader=PackageLoader("pixcal.report"), autoescape=True, undefined=StrictUndefined, **blocks
    )
    environment.filters["not_tested"] = text.not_tested
    for module in (summary, findings, diagnosis_words, tables):
        environment.filters |= vars(module)
    environment.globals |= {
        "draw": _draw,
        "figures": FIGURES,
        "panels": vars(map_panels),
        "data": DATA,
        "NAMES": text.NAMES,
    }
    return environment.get_template(f"{template}.html.j2").render(run=contents, **values)


def _draw(figure: Figure) -> dict[str, Any]:
    """A figure as a PNG embedded in the page, and its size there."""
    data = base64.b64encode(png(figure)).decode("ascii")
    # The size in the page is the figure's at 106 px per inch, so text of 10 pt has 15 px.
    width, height = (round(v * 106) for v in figure.get_size_inches())
    return {"src": f"data:image/png;base64,{data}", "width": width, "height": height}


def _subtitle(contents: Contents) -> str:
    optics, flags = contents.acquisition.get("optics"), contents.flags or contents.detector.flags
    parts = [f"{flags.shape[1]} × {flags.shape[0]} px"] if flags else []
    parts.append(f"pitch {text.number(contents.pitch_um)} µm")
    if contents.has_fringes and optics:
        parts.append(f"{text.number(optics['wavelength_nm'], 4)} nm")
        parts.append(f"{text.number(optics['distance_mm'], 4)} mm from the fibres")
    starts = [t for a in contents.arrays.values() for t in a.get("mjd", ()) if t is not None]
    if starts:
        parts.append(f"first frame {text.date_of_mjd(min(starts))} UTC")
    return " · ".join(parts)
