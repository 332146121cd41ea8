"""The HTML page, from the contents of a run."""

from collections.abc import Iterator, Sequence
from importlib.resources import files

from jinja2 import Environment, StrictUndefined

from pixcal import __version__
from pixcal.report import map_figures, set_figures
from pixcal.report.blocks import Block, Plate, Section, plate
from pixcal.report.contents import Contents, MapContents
from pixcal.report.detector_page import detector
from pixcal.report.diagnosis import diagnosis
from pixcal.report.summary import FlagSummary
from pixcal.report.tables import (
    Table,
    allan_table,
    fit_tables,
    flag_table,
    flat_rows,
    frames_table,
    stage_tables,
)
from pixcal.report.text import NAMES, date_of_mjd, mode_in_words, number
from pixcal.report.verdict import cards, findings, headline

NOT_MEASURED = "Not measured"


def render(contents: Contents) -> str:
    """Draw all figures and write the page.

    Parameters
    ----------
    contents : Contents
        What there is; parts that are missing become sections that say so.

    Returns
    -------
    str
        HTML without any reference to something outside it.
    """
    of_fringes = (_maps, _levels, _temporal, _residuals, _allan) if contents.has_fringes else ()
    chapters = (
        diagnosis, *of_fringes, detector, _masks,
        *((_removed,) if contents.has_fringes else ()), _provenance,
    )  # fmt: skip
    text = files("pixcal.report").joinpath("page.html.j2").read_text(encoding="utf-8")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    what = "pixel offsets" if contents.has_fringes else "detector"
    name = contents.acquisition["detector"].get("name")
    return environment.from_string(text).render(
        title=f"{name}: {what}" if name else what.capitalize(),
        subtitle=_subtitle(contents),
        headline=headline(contents),
        advice=contents.advice,
        causes=_causes(contents),
        cards=list(cards(contents)),
        findings=findings(contents),
        sections=[chapter(contents) for chapter in chapters],
        version=__version__,
    )


def _causes(contents: Contents) -> list[Block]:
    if not contents.causes:
        return []
    header, *rows = contents.causes
    return [Table("Causes, and what to do about them", header, rows)]


def _subtitle(contents: Contents) -> str:
    pitch, optics = contents.pitch_um, contents.acquisition.get("optics")
    flags = contents.flags or contents.detector.flags
    parts = [f"{flags.shape[1]} × {flags.shape[0]} px"] if flags else []
    parts.append(f"pitch {number(pitch)} µm")
    if contents.has_fringes and optics:
        parts.append(f"{number(optics['wavelength_nm'], 4)} nm")
        parts.append(f"{number(optics['distance_mm'], 4)} mm from the fibres")
    starts = [a.first_mjd for a in contents.arrays if a.first_mjd is not None]
    if starts:
        parts.append(f"first frame {date_of_mjd(min(starts))} UTC")
    return " · ".join(parts)


def _missing(what: str, stage: str) -> str:
    return f"{NOT_MEASURED}: {what}; run 'pixcal {stage}' and make the report again."


def _of_fit(name: str, title: str, lead: str, blocks: Sequence[Block]) -> Section:
    """A section that is empty only where there is no fit, and then says so."""
    return Section(name, title, lead if blocks else _missing("there is no fit", "fit"), blocks)


# Sections


def _maps(contents: Contents) -> Section:
    lead = (
        "Offset of each pixel's response barycentre from the perfect grid; positive towards larger "
        "x (y). Grey pixels are masked."
    )
    blocks: list[Block] = []
    for offset in contents.offsets:
        blocks += _offset_plates(offset, contents)
    return _of_fit("maps", "Maps of the offsets", lead, blocks)


def _offset_plates(offset: MapContents, contents: Contents) -> Iterator[Plate]:
    name, n = NAMES[offset.name], offset.delta.block
    yield plate(
        f"Map of {name}",
        (f"Each point is the mean of {n} × {n} px. " if n > 1 else "")
        + "Colours span ±3 robust standard deviations. The profiles are means over whole columns "
        "(below) and rows (right), in full resolution. Good: a map without pattern, means inside "
        "the band of independent offsets. Bad: a pattern that repeats every few rows or columns "
        "(crosstalk, read-out), a large-scale curvature (hyperbolic fringes fitted as straight "
        "ones), stripes with the fringe period. Steps between blocks come from the stitching of "
        "the lithography mask: they are real offsets.",
        map_figures.offsets(offset.name, offset.delta, offset.sigma),
    )
    if offset.detail is not None:
        (y0, x0), part = offset.detail.start, offset.detail.delta
        yield plate(
            f"Centre of the map of {name}, pixel by pixel",
            f"Rows {y0} to {y0 + part.shape[0] - 1}, columns {x0} to {x0 + part.shape[1] - 1}, "
            "without averaging: shows patterns of a few pixels, which block means wash out.",
            map_figures.offsets(offset.name, part, offset.detail.sigma, offset.detail.start),
        )
    yield plate(
        f"Errors and distribution of {name}",
        "Left: 1-sigma error; it follows the illumination and the visibility. Fringes of a few per "
        "cent come from the random phases of the frames. Right: all offsets, a normal distribution "
        "of the same robust width, and the width of the noise. Bad: wings far above the normal "
        "distribution, or a histogram no wider than the noise (no offsets were measured).",
        map_figures.errors_and_histogram(offset),
    )
    if offset.spectrum is not None:
        vectors = {s.name: (s.facts["kx"], s.facts["ky"]) for s in contents.sets}
        windows = offset.spectrum.windows
        my, mx = offset.spectrum.power.shape
        yield plate(
            f"Power spectrum of {name}",
            f"Mean of {windows} window{'s' if windows > 1 else ''} of {mx} × {my} px. Left: power "
            "over that of the white noise which the errors predict. Circles mark the fringe "
            "frequency, squares twice that. Good: no peak in the marks (modes there were removed, "
            "so a dip is natural) and a flat floor. Bad: peaks in a mark (fringe residuals), on an "
            "axis (rows or columns, e.g. 0.25 cycles/px for a period of four), or a floor below "
            "the dashed line (errors too large).",
            map_figures.power(offset.name, offset.spectrum, vectors),
        )


def _levels(contents: Contents) -> Section:
    lead = "Mean level and visibility of the fringes in each pixel."
    blocks = [
        plate(
            f"Set {s.name}: mean level ι and visibility α/ι",
            "Both should follow the smooth light of the fibres. A ring or a speck is dust; a "
            "pattern of rows in the visibility is crosstalk; visibility above 1 is impossible and "
            "points to a wrong bias. Fringes below one per cent come from the random phases of the "
            "frames. The errors grow where the visibility falls.",
            map_figures.map_row(
                [("mean level ι", "e⁻", s.iota), ("visibility α/ι", "α/ι", s.visibility)]
            ),
        )
        for s in contents.sets
    ]
    return _of_fit("levels", "Level and visibility", lead, blocks)


def _temporal(contents: Contents) -> Section:
    lead = (
        "What was fitted in each frame: intensity B (over its mean), visibility (A/B times the "
        "median of α/ι), phase φ, and the change of the fringe vector where it moves."
    )
    blocks = [
        plate(
            f"Set {s.name}: parameters of the frames",
            "Right: histograms; for the phase, the dashed line and its band are a uniform "
            "distribution and its ±2σ scatter. Good: phases over the whole cycle, constant "
            "visibility. Bad: gaps in the phase (the fit is then ill-conditioned), a slow drift or "
            "steps in B (laser, coupling), visibility that drops (vibration within the exposure)."
            + (
                " The fringe vector was free: noise about zero is vibration, a trend is drift."
                if s.series.moving
                else " The fringe vector was held constant: it moves by less than its error."
            ),
            set_figures.temporal(s),
        )
        for s in contents.sets
    ]
    return _of_fit("temporal", "Frame by frame", lead, blocks)


def _residuals(contents: Contents) -> Section:
    lead = "Residuals of the fit over the noise predicted from gain and read noise."
    blocks = [
        plate(
            f"Set {s.name}: reduced χ²",
            "Good: a map without pattern and a histogram on the dashed curve. A histogram scaled "
            "as a whole (red) means that gain or read noise is wrong by that factor, or that the "
            "light fluctuates; the errors were multiplied by its square root. Bad: fringes, rows "
            "or blocks in the map, or a long tail. Linear, constant effects (crosstalk, hyperbolic "
            "fringes) leave no residuals: look for them in the maps.",
            set_figures.residuals(s),
        )
        for s in contents.sets
    ]
    return _of_fit("noise", "Residuals", lead, blocks)


def _allan(contents: Contents) -> Section:
    lead = (
        "Allan deviation of the offsets between batches of frames: how the error falls as more "
        "frames are averaged, without knowing the true offsets."
    )
    measured = [s for s in contents.sets if s.allan is not None and s.allan.get("frames")]
    blocks: list[Block] = [
        plate(
            f"Set {s.name}: Allan deviation",
            "Median over the pixels. Good: points on the square-root law, which is what the errors "
            "of the fit predict, and that law close to the Cramér–Rao bound (short batches lie a "
            "little above it). Bad: points that leave the law upwards at long times (drift), or "
            "that lie above it everywhere (noise that is not in the errors).",
            set_figures.allan(s.name, s.allan or {}, s.facts),
        )
        for s in measured
    ]
    if measured:
        blocks.append(allan_table(measured))
    else:
        lead = _missing("there is no Allan deviation", "allan")
    return Section("allan", "Allan deviation", lead, blocks)


def _masks(contents: Contents) -> Section:
    panels: list[tuple[str, FlagSummary]] = []
    if contents.detector.flags is not None:
        panels.append(("calibration frames", contents.detector.flags))
    panels += [(f"set {s.name}", s.flags) for s in contents.sets]
    if contents.flags is not None:
        panels.append(("products", contents.flags))
    if not panels:
        return Section("masks", "Masks", f"{NOT_MEASURED}: there are no masks.", [])
    blocks: list[Block] = []
    if any(summary.masked for _, summary in panels):
        blocks.append(
            plate(
                "Flags of the pixels",
                "Maps that are the same are drawn once. Good: few, scattered pixels. Bad: whole "
                "rows, columns or blocks, or masks that follow the fringes (saturation at the "
                "crests).",
                map_figures.flags(panels),
            )
        )
    blocks.append(flag_table(panels))
    lead = (
        "Pixels without an offset, and why. A pixel may have several flags. The mask of a set "
        "includes that of the calibration frames. In the products a flag is counted where it "
        "removes the pixel's value."
    )
    return Section("masks", "Masks", lead, blocks)


def _removed(contents: Contents) -> Section:
    lead = (
        "These modes of the maps are degenerate with the geometry of the bench. The products do "
        "not contain them. Remove them from both maps before a comparison."
    )
    groups: dict[tuple[str, ...], list[str]] = {}
    for fringes in contents.sets:
        groups.setdefault(tuple(fringes.facts.get("removed_modes", ())), []).append(fringes.name)
    blocks = [
        Table(
            f"Set{'s' if len(names) > 1 else ''} {', '.join(names)}",
            ["mode", "description"],
            [[mode, mode_in_words(mode)] for mode in modes],
        )
        for modes, names in groups.items()
    ]
    if not blocks:
        lead = "Nothing was removed: there are no maps of offsets."
    return Section("removed", "Removed modes", lead, blocks)


def _provenance(contents: Contents) -> Section:
    blocks: list[Block] = []
    if contents.fit is not None:
        blocks += fit_tables(contents.fit)
    if contents.arrays:
        blocks.append(frames_table(contents.arrays))
    blocks += stage_tables(contents.stages)
    # Detector frames alone have no optics.
    listed = {key: value for key, value in contents.acquisition.items() if value is not None}
    blocks.append(Table("Acquisition as understood", ["key", "value"], flat_rows(listed)))
    lead = "Origin of the results. Equal keys mean equal results."
    return Section("provenance", "Provenance", lead, blocks)
