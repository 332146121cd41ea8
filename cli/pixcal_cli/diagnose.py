"""``pixcal diagnose``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixcal.model.errors import InputError
from pixcal_cli import results
from pixcal_cli.options import examples, run_argument, runtime_options

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


def effect_list(text: str) -> tuple[str, ...]:
    """Names of effects, divided by commas.

    Raises
    ------
    InputError
        If there are none: without the option every effect is a candidate.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise InputError(
            f"--effects {text!r:.80}: no name of an effect; write names with commas between them, "
            "or leave the option out for all effects"
        )
    return names


@click.command(
    epilog=examples(
        "pixcal diagnose demo",
        "pixcal diagnose demo --effects lag,ipc",
        "pixcal diagnose demo --effects=-telegraph_noise --own my_effect.py",
    )
)
@run_argument
@click.option(
    "--effects",
    "chosen",
    type=effect_list,
    default=None,
    metavar="NAMES",
    help="Candidates, divided by commas; a name after '-' is left out. [default: all]",
)
@click.option(
    "--own",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FILE",
    help="Python file that holds an effect of your own; may be given several times.",
)
@click.option(
    "--nominal",
    type=click.Path(path_type=Path),
    metavar="BENCH.yaml",
    help="Bench file whose effects the nominal bench has from the start.",
)
@runtime_options
def diagnose(
    run: Path,
    chosen: tuple[str, ...] | None,
    own: tuple[Path, ...],
    nominal: Path | None,
    runtime: "Runtime",
) -> None:
    """Tell where data and simulation differ, which effect causes it, and what remains."""
    from pixcal.stages import diagnose as stage  # here: for a fast `pixcal --help`

    config = stage.Config(
        only=tuple(name for name in chosen or () if not name.startswith("-")),
        without=tuple(name[1:] for name in chosen or () if name.startswith("-")),
        own=own,
        nominal=nominal,
    )
    with results.announce("diagnose", run / "diagnose"):
        stage.run(run, config, runtime)
    results.show_diagnosis(run)
