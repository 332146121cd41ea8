"""``pixcal report``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixcal_cli import results
from pixcal_cli.options import examples, run_argument, runtime_options

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


@click.command(epilog=examples("pixcal report demo"))
@run_argument
@runtime_options
def report(run: Path, runtime: "Runtime") -> None:
    """Write a self-contained HTML page on the whole run."""
    from pixcal.stages import report as stage  # here: for a fast `pixcal --help`

    with results.announce("report", run / "report"):
        stage.run(run, stage.Config(), runtime)
    results.show_report(run)
