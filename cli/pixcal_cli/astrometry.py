"""``pixcal astrometry``."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixcal.storage.artefact import read_json
from pixcal_cli import results
from pixcal_cli.options import examples, run_argument, runtime_options

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


class Finite(click.FloatRange):
    """A number in a range; ``nan`` is in none."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The number of a text."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a number.", param, ctx)
        return number


POSITIVE = Finite(0, min_open=True)


@click.command(
    epilog=examples(
        "pixcal astrometry demo --truth data_samples/demo-truth",
        "pixcal astrometry demo --diameter 2.4 --focal-length 57.6 --electrons 1e6",
    )
)
@run_argument
@click.option(
    "--truth",
    metavar="DIR",
    type=click.Path(path_type=Path),
    show_default="the maps and a draw of their errors",
    help="True offsets of a simulated detector (ACQ-truth): where its pixels lie.",
)
@click.option(
    "--diameter", type=POSITIVE, default=7.0, show_default=True, metavar="M", help="Telescope, m."
)
@click.option(
    "--focal-length",
    type=POSITIVE,
    default=130.0,
    show_default=True,
    metavar="M",
    help="Telescope, m.",
)
@click.option(
    "--wavelength",
    type=POSITIVE,
    default=600.0,
    show_default=True,
    metavar="NM",
    help="Of the light of stars, nm.",
)
@click.option(
    "--obscuration",
    type=Finite(0, 0.9),
    default=0.0,
    show_default=True,
    metavar="E",
    help="Diameter of the central obscuration over the telescope's.",
)
@click.option(
    "--electrons",
    type=POSITIVE,
    default=1e8,
    show_default="1e8",
    metavar="N",
    help="Photo-electrons of a star at each position, all exposures together.",
)
@click.option(
    "--background",
    type=Finite(0),
    default=0.0,
    show_default=True,
    metavar="N",
    help="Electrons of each pixel at each position beside the star's.",
)
@click.option(
    "--window",
    type=click.IntRange(3, 255),
    default=None,
    show_default="8 λ/D",
    metavar="PX",
    help="Side of the window that is fitted, an odd number.",
)
@click.option(
    "--stars",
    type=click.IntRange(2, 100_000),
    default=1000,
    show_default=True,
    metavar="N",
    help="Stars, at random places of the detector.",
)
@click.option(
    "--positions",
    type=click.IntRange(1, 1024),
    default=16,
    show_default=True,
    metavar="N",
    help="Positions of each star, whose mean is taken.",
)
@click.option(
    "--dither",
    type=Finite(0, 512),
    default=32.0,
    show_default=True,
    metavar="PX",
    help="Positions lie so far from the first at most, along x and y.",
)
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    metavar="N",
    help="Of the random numbers.",
)
@runtime_options
def astrometry(
    run: Path,
    truth: Path | None,
    diameter: float,
    focal_length: float,
    wavelength: float,
    obscuration: float,
    electrons: float,
    background: float,
    window: int | None,
    stars: int,
    positions: int,
    dither: float,
    seed: int,
    runtime: "Runtime",
) -> None:
    """Simulate stars and tell what the maps bring for their centroids.

    Stars are fitted once taking pixels for a perfect grid and once where the measured maps say. The
    telescope is by default that of the habitable worlds mission, 7 m and 130 m.
    """
    from pixcal.stages import astrometry as stage  # here: for a fast `pixcal --help`

    config = stage.Config(
        truth=truth, diameter_m=diameter, focal_length_m=focal_length, wavelength_nm=wavelength,
        obscuration=obscuration, electrons=electrons, background_e=background, window=window,
        stars=stars, positions=positions, dither_px=dither, seed=seed,
    )  # fmt: skip
    with results.announce("astrometry", run / "astrometry"):
        stage.run(run, config, runtime)
    result = read_json(run / "astrometry" / "astrometry.json")
    _show(result, [astuple(row) for row in stage.table(result)])
    click.echo(f"  {run / 'products' / 'astrometry.png'}")


def _show(result: Mapping[str, Any], rows: Sequence[Sequence[str]]) -> None:
    """The table, and what the mission needs."""
    t, axes = result["telescope"], result["axes"]
    bound = next(iter(axes.values()))["photon_bound"]
    click.echo(
        f"  {t['diameter_m']:g} m, {t['focal_length_m']:g} m, {t['wavelength_nm']:g} nm: "
        f"{t['uas_per_px'] / 1e3:.3g} mas a pixel, {t['px_per_lambda_over_d']:.3g} px in λ/D; "
        f"photon noise alone {bound['px']:.3g} px, {bound['uas']:.3g} µas"
    )
    cells = [("error of a centroid", "along", "perfect grid", "measured maps", "gain"), *rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        click.echo(f"  {line.rstrip()}")
    for name, axis in axes.items():
        need = axis["positions_to_target"]
        click.echo(
            f"  positions to {need['target_px']:.0e} px along {name}, if independent: "
            f"{_count(need['perfect'])} with a perfect grid, {_count(need['measured'])} with maps"
        )
    for sentence in result["warnings"]:
        click.echo(f"  note: {sentence}")


def _count(number: int | None) -> str:
    return "-" if number is None else str(number)
