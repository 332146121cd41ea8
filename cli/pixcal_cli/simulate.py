"""``pixcal simulate``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixcal_cli import results
from pixcal_cli.options import examples, runtime_options

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


@click.command(
    epilog=examples(
        "pixcal simulate configs/demo.yaml --out acquisition",
        "pixcal simulate bench.yaml --out acquisition --own glow.py",
    )
)
@click.argument("bench", metavar="BENCH.yaml", type=click.Path(path_type=Path))
@click.option(
    "--out",
    "acquisition",
    metavar="ACQ",
    required=True,
    type=click.Path(path_type=Path),
    help="Directory of the acquisition; made if it is not there.",
)
@click.option(
    "--truth",
    metavar="DIR",
    type=click.Path(path_type=Path),
    show_default="ACQ-truth",
    help="Directory of the truth; apart from the acquisition.",
)
@click.option(
    "--own",
    metavar="FILE",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Python file with an effect of your own, for BENCH.yaml; may be given several times.",
)
@runtime_options
def simulate(
    bench: Path,
    acquisition: Path,
    truth: Path | None,
    own: tuple[Path, ...],
    runtime: "Runtime",
) -> None:
    """Simulate a bench and write an acquisition.

    BENCH.yaml describes detector, optics and frames; ACQ receives the FITS files that the bench's
    camera would have written.
    """
    from pixcal.stages import simulate as stage  # here: for a fast `pixcal --help`

    with results.announce("simulate", acquisition):
        stage.run(bench, acquisition, stage.Config(truth, own), runtime)
    results.show_simulate(acquisition)
