"""``pixcal allan``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixcal_cli import results
from pixcal_cli.options import examples, region, run_argument, runtime_options

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


@click.command(epilog=examples("pixcal allan demo", "pixcal allan demo --region 0:64,0:64"))
@run_argument
@click.option(
    "--region",
    "regions",
    type=region,
    multiple=True,
    metavar="y0:y1,x0:x1",
    help="Pixels for a curve of their own, ends excluded; may be given several times.",
)
@runtime_options
def allan(run: Path, regions: tuple[tuple[int, int, int, int], ...], runtime: "Runtime") -> None:
    """Measure how the error falls with the number of frames."""
    from pixcal.stages import allan as stage  # here: for a fast `pixcal --help`

    with results.announce("allan", run / "allan"):
        stage.run(run, stage.Config(regions=regions), runtime)
    results.show_allan(run)
