"""``pixcal reduce``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixcal_cli import results
from pixcal_cli.options import cubes_option, examples, gain_option, run_argument, runtime_options

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


@click.command(epilog=examples("pixcal reduce demo", "pixcal reduce demo --gain measured"))
@run_argument
@gain_option
@cubes_option
@runtime_options
def reduce(run: Path, gain: str, cubes: str | None, runtime: "Runtime") -> None:
    """Measure the detector and write the fringes in electrons.

    Bias, dark, flat, gain, read noise and bad pixels come from the detector frames; the fringe
    frames become cubes in electrons.
    """
    from pixcal.stages import reduce as stage  # here: for a fast `pixcal --help`

    with results.announce("reduce", run / "reduce"):
        stage.run(run, stage.Config(gain=gain, cubes=cubes), runtime)
    results.show_reduce(run)
