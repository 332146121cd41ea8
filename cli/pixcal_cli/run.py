"""``pixcal run``: all steps from the acquisition to the report."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixcal.model.acquisition import load_acquisition
from pixcal.model.errors import InputError
from pixcal_cli import results
from pixcal_cli.options import (
    acquisition_argument,
    copy_option,
    cubes_option,
    examples,
    gain_option,
    model_option,
    out_run_option,
    overwrite_option,
    runtime_options,
)

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


@click.command(epilog=examples("pixcal run data_samples/demo --out demo"))
@acquisition_argument
@out_run_option
@overwrite_option
@copy_option
@gain_option
@model_option
@cubes_option
@click.option(
    "--diagnose/--no-diagnose",
    "diagnosed",
    default=True,
    show_default=True,
    help="Tell where the frames differ from a simulation of the bench, and why: takes the longest.",
)
@runtime_options
def run(
    acquisition: Path,
    run: Path,
    overwrite: bool,
    copy: bool,
    gain: str,
    model: str,
    cubes: str | None,
    diagnosed: bool,
    runtime: "Runtime",
) -> None:
    """Do all steps, from the acquisition ACQ to the report under RUN."""
    # Here, not at the top: for a fast `pixcal --help`.
    from pixcal.stages import allan, correct, diagnose, fit, ingest, reduce, report

    with results.announce("ingest", run / "ingest"):
        cataloguing = ingest.Config(overwrite=overwrite, copy=copy, cubes=cubes)
        ingest.run(acquisition, run, cataloguing, runtime)
    with results.announce("reduce", run / "reduce"):
        reduce.run(run, reduce.Config(gain=gain, cubes=cubes), runtime)
    fringes = bool(load_acquisition(acquisition).frames.fringes)
    if fringes:
        with results.announce("fit", run / "fit"):
            fit.run(run, fit.Config(model=model), runtime)
        with results.announce("allan", run / "allan"):
            allan.run(run, allan.Config(), runtime)
    if diagnosed:
        try:
            with results.announce("diagnose", run / "diagnose"):
                diagnose.run(run, diagnose.Config(), runtime)
        except InputError as error:
            # The maps are good without it.
            click.echo(f"diagnose: not possible: {error}")
            diagnosed = False
    if diagnosed and fringes:
        config = correct.Config(fit=fit.Config(model=model))
        with results.announce("corrected", run / "corrected"):
            refused = correct.attempt(run, config, runtime)
        if refused is not None:
            click.echo(f"corrected: not possible, the fitted maps stand: {refused}")
    with results.announce("report", run / "report"):
        report.run(run, report.Config(), runtime)
    results.show_run(run, fitted=fringes, diagnosed=diagnosed)
