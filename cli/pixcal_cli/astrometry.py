"""``pixcal astrometry``."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixcal.model.options import Astrometry
from pixcal.storage.manifest import read_json
from pixcal_cli import printing
from pixcal_cli.click_options import command
from pixcal_cli.results import perform

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


@command(
    Astrometry,
    "pixcal astrometry demo --truth data_samples/demo-truth",
    "pixcal astrometry demo --diameter 2.4 --focal-length 57.6 --electrons 1e6",
)
def astrometry(run: Path, config: Astrometry, runtime: "Runtime") -> None:
    """Star centroids with the maps of RUN."""
    perform("astrometry", run / "astrometry", run, config, runtime)
    result = read_json(run / "astrometry" / "astrometry.json")
    from pixcal.stages.astrometry import table  # here: for a fast `pixcal --help`

    _show(result, table(result))
    click.echo(f"  {run / 'products' / 'astrometry.png'}")


def _show(result: Mapping[str, Any], rows: Sequence[Sequence[str]]) -> None:
    """The table, and the requirement of the mission."""
    t, axes = result["telescope"], result["axes"]
    bound = next(iter(axes.values()))["photon_bound"]
    click.echo(
        f"  {t['diameter_m']:g} m, {t['focal_length_m']:g} m, {t['wavelength_nm']:g} nm: "
        f"{t['uas_per_px'] / 1e3:.3g} mas/px, {t['px_per_lambda_over_d']:.3g} px in λ/D; "
        f"photon noise alone {bound['px']:.3g} px, {bound['uas']:.3g} µas"
    )
    header = ("error of a centroid", "along", "perfect grid", "measured maps", "gain")
    printing.show_table(header, rows)
    for name, axis in axes.items():
        need = axis["positions_to_target"]
        click.echo(
            f"  positions to {need['target_px']:.0e} px along {name}, if independent: "
            f"{_count(need['perfect'])} with a perfect grid, {_count(need['measured'])} with maps"
        )
    printing.show_notes(result["warnings"])


def _count(number: int | None) -> str:
    return "-" if number is None else str(number)
