"""``pixcal blind``."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixcal_cli import results
from pixcal_cli.options import examples, runtime_options

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime

cases_argument = click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
sealed_option = click.option(
    "--sealed",
    metavar="FILE",
    required=True,
    type=click.Path(path_type=Path),
    help="File of the truth; apart from DIR.",
)


@click.group(
    epilog=examples(
        "pixcal blind make --cases 10 --seed 1001 --out exam --sealed truth.json",
        "pixcal blind run exam",
        "pixcal blind score exam --sealed truth.json",
    )
)
def blind() -> None:
    """Examine the diagnosis on data whose effects are withheld."""


@blind.command(
    epilog=examples(
        "pixcal blind make --cases 10 --seed 1001 --out exam --sealed truth.json",
        "pixcal blind make --cases 100 --bench second --out exam --sealed truth.json",
    )
)
@click.option("--cases", type=click.IntRange(1, 9999), required=True, help="Number of cases.")
@click.option(
    "--seed",
    type=click.IntRange(0, 10**18),
    help="Of all that is drawn; below 1000 for development, from there on for examinations. "
    "[default: one that only FILE knows]",
)
@click.option(
    "--out",
    "folder",
    metavar="DIR",
    required=True,
    type=click.Path(path_type=Path),
    help="Directory of the cases.",
)
@sealed_option
@click.option(
    "--size",
    type=click.Choice(["tiny", "small", "standard"]),
    default="small",
    show_default=True,
    help="small: 61 x 67 pixels, 2 x 300 frames; standard: 128 x 128, 2 or 3 x 600; "
    "tiny: 33 x 35, 2 x 60, to try the commands.",
)
@click.option(
    "--bench",
    type=click.Choice(["both", "second", "own"]),
    default="both",
    show_default=True,
    help="Cases of the second bench, which shares no code with pixcal, of pixcal's own simulator "
    "(a self-check), or half of each.",
)
@runtime_options
def make(
    cases: int,
    seed: int | None,
    folder: Path,
    sealed: Path,
    size: str,
    bench: str,
    runtime: "Runtime",
) -> None:
    """Make cases, each with an effect, several, or none, and seal the truth."""
    from pixcal.stages import blind as stage  # here: for a fast `pixcal --help`

    found = stage.make(folder, sealed, stage.MakeConfig(cases, seed, size, bench), runtime)
    click.echo(f"cases in {folder}: {cases}; their truth in {sealed}")
    results.show_notes(found.notes)


@blind.command(epilog=examples("pixcal blind run exam", "pixcal blind run exam --limit 20"))
@cases_argument
@click.option("--again", is_flag=True, help="Diagnose anew what was diagnosed.")
@click.option("--keep", is_flag=True, help="Keep the runs whole, not their products alone.")
@click.option(
    "--limit",
    metavar="N",
    type=click.IntRange(1),
    help="Diagnose at most N cases now, in order; their order is random.",
)
@runtime_options
def run(folder: Path, again: bool, keep: bool, limit: int | None, runtime: "Runtime") -> None:
    """Diagnose every case of DIR; those that are done are skipped."""
    from pixcal.stages import blind as stage  # here: for a fast `pixcal --help`

    done, failed = stage.run(folder, stage.RunConfig(again, keep, limit), runtime)
    failures = f", {failed} of which failed" if failed else ""
    click.echo(f"cases diagnosed: {done}{failures}; results in {folder / 'runs'}")


@blind.command(
    epilog=examples(
        "pixcal blind score exam --sealed truth.json",
        "pixcal blind score exam --sealed truth.json --oracle 20 --write docs/blind.md",
        "pixcal blind score exam --sealed truth.json --also exam-2 truth-2.json",
    )
)
@cases_argument
@sealed_option
@click.option(
    "--oracle",
    metavar="N",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Simulate the true effects of the first N cases of parts 1 and 4 as well: "
    "what could be closed.",
)
@click.option(
    "--write",
    metavar="PAGE",
    type=click.Path(path_type=Path),
    help="Markdown page that the table goes to, between its marks.",
)
@click.option(
    "--also",
    metavar="DIR FILE",
    type=(click.Path(path_type=Path), click.Path(path_type=Path)),
    multiple=True,
    help="Another examination of the same size, and its truth, to be scored together; repeatable.",
)
@runtime_options
def score(
    folder: Path,
    sealed: Path,
    oracle: int,
    write: Path | None,
    also: tuple[tuple[Path, Path], ...],
    runtime: "Runtime",
) -> None:
    """Open the seal and hold every diagnosis against its truth."""
    from pixcal.stages import blind as stage  # here: for a fast `pixcal --help`

    found = stage.score(folder, sealed, stage.ScoreConfig(oracle, write, also), runtime)
    _show(found)
    for file in (folder / "score.json", folder / "score.md"):
        click.echo(f"  {file}")


def _show(found: Mapping[str, Any]) -> None:
    rows = []
    for part, facts in found["parts"].items():
        for question, count in facts["questions"].items():
            limits = count["interval"]
            interval = "" if limits is None else f"{limits[0]:.2f} to {limits[1]:.2f}"
            rows.append(
                (part, facts["title"], question, f"{count['right']}/{count['of']}", interval)
            )
    results.show_table(("part", "", "question", "right", "95 % interval"), rows)
    wrong = [f"{c['case']}: {c['why']}" for c in found["cases"] if not c["right"]]
    missing = [f"not diagnosed yet: {len(found['missing'])} of {found['made']} cases"]
    results.show_notes([*wrong, *(missing if found["missing"] else []), *found["notes"]])
