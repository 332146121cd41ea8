"""``pixcal centroids`` and ``pixcal wcs``: correction of star positions."""

from pathlib import Path

import click

from pixcal.model.options import Centroids, Wcs
from pixcal_cli.click_options import PATH, command, run_argument


@command(
    Centroids,
    "pixcal centroids demo stars.csv --out corrected.csv --fwhm 2.5",
    "pixcal centroids demo sex.fits --x X_IMAGE --y Y_IMAGE --origin 1 --fwhm 3 --out out.fits",
    arguments=(run_argument, click.argument("table", metavar="TABLE", type=PATH)),
    tasks=False,
)
def centroids(run: Path, table: Path, config: Centroids) -> None:
    """The centroids of TABLE."""
    import numpy as np  # here: for a fast `pixcal --help`

    from pixcal.stages import centroids as stage

    corrected = stage.correct_table(run, table, config)
    good = np.isfinite(corrected.place[:, 0])
    click.echo(f"{config.out}: {int(good.sum())} of {len(good)} centroids corrected")
    if good.any():
        added = np.sqrt((corrected.error[good] ** 2).mean(axis=0))
        click.echo(f"  map errors add {added[0]:.2g} px rms in x, {added[1]:.2g} px in y")
    if not good.all():
        click.echo("  note: the others are off the detector or too close to masked pixels: NaN")


@command(
    Wcs,
    "pixcal wcs demo --out distortion.fits",
    "pixcal wcs demo --out stars.fits --fwhm 2.5",
    tasks=False,
)
def wcs(run: Path, config: Wcs) -> None:
    """The maps of RUN."""
    from pixcal.stages import centroids as stage  # here: for a fast `pixcal --help`

    stage.write_wcs(run, config)
    click.echo(f"{config.out}: written")
