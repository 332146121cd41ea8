"""``pixcal ingest``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixcal_cli import results
from pixcal_cli.options import (
    acquisition_argument,
    copy_option,
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
        "pixcal ingest data_samples/demo --out demo --copy --cubes s3://bucket/cubes",
    )
)
@acquisition_argument
@out_run_option
@overwrite_option
@copy_option
@cubes_option
@runtime_options
def ingest(
    acquisition: Path,
    run: Path,
    overwrite: bool,
    copy: bool,
    cubes: str | None,
    runtime: "Runtime",
) -> None:
    """Check every frame of the acquisition ACQ, and catalogue it.

    ACQ is a directory with acquisition.yaml and FITS files. Later steps read these files where they
    are; only compressed ones are copied into cubes.
    """
    from pixcal.stages import ingest as stage  # here: for a fast `pixcal --help`

    with results.announce("ingest", run / "ingest"):
        config = stage.Config(overwrite=overwrite, copy=copy, cubes=cubes)
        stage.run(acquisition, run, config, runtime)
    results.show_ingest(run)
