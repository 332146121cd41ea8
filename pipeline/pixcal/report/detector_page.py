"""The detector's chapter of the page."""

from collections.abc import Iterator

from pixcal.report import detector_figures, emva_figures, map_figures
from pixcal.report.blocks import Block, Plate, Section, plate
from pixcal.report.contents import Contents, DetectorContents
from pixcal.report.tables import Table, is_table, merit_table, reduction_tables
from pixcal.report.text import number

# title and unit of each map of the reduction
DETECTOR_MAPS = {
    "bias": ("bias", "ADU"),
    "dark_rate": ("dark current", "e⁻/s"),
    "flat": ("flat", "relative response"),
    "read_noise": ("read noise", "e⁻"),
}


def detector(contents: Contents) -> Section:
    """What the bias, dark and flat frames show."""
    measured = contents.detector
    panels = [
        (title, unit, measured.maps[key])
        for key, (title, unit) in DETECTOR_MAPS.items()
        # A map of one value is what the reduction takes where there are no frames.
        if key in measured.maps and measured.maps[key].std > 0
    ]
    blocks: list[Block] = [*merit_table(measured.facts), *_merit_plates(measured)]
    if panels:
        blocks.append(
            plate(
                "Calibration maps",
                "Colours span the 0.5th to the 99.5th percentile. Good: smooth or random maps. "
                "Bad: rows, columns or blocks in the read noise, fringes in the flat (coherent "
                "light), a flat that follows the dark current (dark subtraction).",
                map_figures.map_row(panels),
            )
        )
        rows = [
            [title, unit, *(number(v, 4) for v in (m.median, m.robust_std, m.mean, m.std))]
            for title, unit, m in panels
        ]
        header = ["map", "unit", "median", "robust σ", "mean", "σ"]
        blocks.append(Table("Calibration maps in numbers", header, rows))
    linearity = measured.facts.get("linearity") or {}
    if is_table(linearity.get("levels")):
        blocks.append(
            plate(
                "Linearity",
                "Departure of each flat level from the straight line over exposure time. Good: "
                "within a few tenths of a per cent, without trend. Bad: a curve that grows towards "
                "the full well (nonlinear response), or scatter (an unsteady lamp).",
                detector_figures.linearity(linearity["levels"]),
            )
        )
    blocks += reduction_tables(measured.facts)
    lead = "Bias, dark current, flat, read noise and linearity."
    if not blocks:
        lead = "Not measured: the reduction left no calibration maps."
    return Section("detector", "Detector", lead, blocks)


def _merit_plates(measured: DetectorContents) -> Iterator[Plate]:
    """Photon transfer, and what is not uniform, in the dark and in light."""
    figures, curves = measured.facts.get("figures_of_merit") or {}, measured.curves
    transfer = curves.get("photon_transfer") or {}
    if len(transfer.get("level", ())) > 1:
        full = figures.get("saturation")
        yield plate(
            "Photon-transfer curve",
            "Half the variance of the differences of pairs of flats against their level; right: "
            "over the straight line that shot noise and read noise make. Good: points on the line "
            "up to saturation. Bad: a slope or a curve (nonlinear response, neighbours that share "
            "charge), or a fall (saturation) at a level that is still in use.",
            emva_figures.photon_transfer(
                transfer, full["value"] if full and full["error"] is not None else None
            ),
        )
    for key, name, what in (
        ("dsnu", "DSNU", "Without light"),
        ("prnu", "PRNU", "Near half of the saturation, quadratic trend of the lamp removed"),
    ):
        if key in curves:
            yield plate(
                f"{name}: spectra and profiles",
                f"{what}. Left: amplitude along the rows and along the columns, where white noise "
                "is flat; the dashed line is the noise left in the averaged frames. Right: means "
                "of rows and columns. Good: flat spectra, means without pattern. Bad: peaks "
                "(periodic pattern: 0.5 cycles/px is a repeat of two), a rise to low frequencies "
                "(gradients), steps between rows or columns (amplifiers).",
                emva_figures.nonuniformity(curves[key], name),
            )
