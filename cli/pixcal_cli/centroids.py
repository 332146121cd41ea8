"""``pixcal centroids`` and ``pixcal wcs``: correction of star positions."""

from pathlib import Path

import click

from pixcal.model.errors import InputError
from pixcal_cli.click_options import PATH, examples, run_argument


@click.command(
    epilog=examples(
        "pixcal centroids demo stars.csv --out corrected.csv --fwhm 2.5",
        "pixcal centroids demo sex.fits --x X_IMAGE --y Y_IMAGE --origin 1 --fwhm 3 --out out.fits",
    )
)
@run_argument
@click.argument("table", metavar="TABLE", type=PATH)
@click.option(
    "--out",
    metavar="FILE",
    required=True,
    type=PATH,
    help="Table to write: CSV, ECSV, FITS or VOTable.",
)
@click.option(
    "--fwhm",
    metavar="PX",
    required=True,
    type=float,
    help="Full width of the stars at half maximum, px.",
)
@click.option("--x", default="x", show_default=True, metavar="NAME", help="Column of x, px.")
@click.option("--y", default="y", show_default=True, metavar="NAME", help="Column of y, px.")
@click.option(
    "--origin",
    type=click.Choice(["0", "1"]),
    default="0",
    show_default=True,
    help="Coordinate of the centre of the first pixel (1 for SExtractor and FITS).",
)
@click.option(
    "--electrons",
    type=float,
    metavar="N",
    show_default="equal weights",
    help="Electrons per star, if the centroids were fitted with photon-noise weights.",
)
@click.option("--overwrite", is_flag=True, help="Replace FILE.")
def centroids(
    run: Path,
    table: Path,
    out: Path,
    fwhm: float,
    x: str,
    y: str,
    origin: str,
    electrons: float | None,
    overwrite: bool,
) -> None:
    """Correct a table of centroids with the maps of RUN.

    TABLE holds centroids measured on a perfect grid. Columns are added for the corrected positions
    and their errors from the maps.
    """
    import numpy as np  # here: for a fast `pixcal --help`

    from pixcal.stages import centroids as stage

    job = stage.TableJob(table, out, x, y, int(origin), overwrite)
    corrected = stage.correct_table(run, job, fwhm_px=fwhm, electrons=electrons)
    good = np.isfinite(corrected.place[:, 0])
    click.echo(f"{out}: {int(good.sum())} of {len(good)} centroids corrected")
    if good.any():
        left = np.sqrt((corrected.error[good] ** 2).mean(axis=0))
        click.echo(f"  errors of the maps leave {left[0]:.2g} px in x, {left[1]:.2g} px in y")
    if not good.all():
        click.echo("  note: the others are off the detector or too close to masked pixels: NaN")


@click.command(
    epilog=examples(
        "pixcal wcs demo --out distortion.fits", "pixcal wcs demo --out stars.fits --fwhm 2.5"
    )
)
@run_argument
@click.option("--out", metavar="FILE", required=True, type=PATH, help="FITS file to write.")
@click.option(
    "--fwhm",
    metavar="PX",
    type=float,
    show_default="no star: the pixel offsets",
    help="Distortion for stars of this width, centred on pixels.",
)
@click.option("--overwrite", is_flag=True, help="Replace FILE.")
def wcs(run: Path, out: Path, fwhm: float | None, overwrite: bool) -> None:
    """Write the maps of RUN as a WCS distortion.

    astropy and others apply these lookup tables (D2IMARR) to pixel coordinates before the rest of a
    WCS.
    """
    from pixcal.stages import centroids as stage  # here: for a fast `pixcal --help`

    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists; choose another --out or add --overwrite")
    stage.write_wcs(run, out, fwhm_px=fwhm)
    click.echo(f"{out}: written")
