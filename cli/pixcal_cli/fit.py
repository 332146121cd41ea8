"""``pixcal fit``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixcal_cli import results
from pixcal_cli.options import examples, model_option, run_argument, runtime_options

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


@click.command(epilog=examples("pixcal fit demo", "pixcal fit demo --model hyperbolic"))
@run_argument
@model_option
@runtime_options
def fit(run: Path, model: str, runtime: "Runtime") -> None:
    """Fit the fringes and write the maps of the pixels' offsets."""
    from pixcal.stages import fit as stage  # here: for a fast `pixcal --help`

    with results.announce("fit", run / "fit"):
        stage.run(run, stage.Config(model=model), runtime)
    results.show_fit(run)
