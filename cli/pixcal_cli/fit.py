"""``pixcal fit``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixcal_cli import results
from pixcal_cli.options import examples, model_option, run_argument, runtime_options

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


@click.command(
    epilog=examples(
        "pixcal fit demo",
        "pixcal fit demo --model hyperbolic",
        "pixcal fit demo --with-diagnosis",
    )
)
@run_argument
@model_option
@click.option(
    "--with-diagnosis",
    is_flag=True,
    help="Also write maps without the effects that 'pixcal diagnose' found, and what they gained.",
)
@click.option(
    "--own",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FILE",
    help="Python file with an effect of your own that the diagnosis found; may be repeated.",
)
@runtime_options
def fit(
    run: Path, model: str, with_diagnosis: bool, own: tuple[Path, ...], runtime: "Runtime"
) -> None:
    """Fit the fringes and write the maps of the pixels' offsets."""
    from pixcal.stages import correct  # here: for a fast `pixcal --help`
    from pixcal.stages import fit as stage

    config = stage.Config(model=model)
    if not with_diagnosis:
        if own:
            raise click.UsageError("--own is of use with --with-diagnosis only; give that as well")
        with results.announce("fit", run / "fit"):
            stage.run(run, config, runtime)
        results.show_fit(run)
        return
    with (
        results.announce("corrected", run / "corrected"),
        results.announce("fit", run / "fit"),
    ):
        correct.run(run, correct.Config(own=own, fit=config), runtime)
    results.show_fit(run)
    results.show_correction(run)
