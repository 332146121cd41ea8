"""``pixcal ingest``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixcal_cli import results
from pixcal_cli.options import (
    acquisition_argument,
    cubes_option,
    examples,
    out_run_option,
    overwrite_option,
    runtime_options,
)

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


@click.command(
    epilog=examples(
        "pixcal ingest data_samples/demo --out demo",
        "pixcal ingest data_samples/demo --out demo --cubes s3://bucket/cubes",
    )
)
@acquisition_argument
@out_run_option
@overwrite_option
@cubes_option
@runtime_options
def ingest(
    acquisition: Path, run: Path, overwrite: bool, cubes: str | None, runtime: "Runtime"
) -> None:
    """Copy the frames of the acquisition ACQ into checksummed cubes.

    ACQ is a directory with acquisition.yaml and FITS files.
    """
    from pixcal.stages import ingest as stage  # here: for a fast `pixcal --help`

    with results.announce("ingest", run / "ingest"):
        stage.run(acquisition, run, stage.Config(overwrite=overwrite, cubes=cubes), runtime)
    results.show_ingest(run)
