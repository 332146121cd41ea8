"""``pixcal blind``."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from blind_examination.options import MakeConfig, RunConfig, ScoreConfig
from pixcal_cli import printing
from pixcal_cli.click_options import PATH, command, examples

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime

cases_argument = click.argument("folder", metavar="DIR", type=PATH)
sealed_option = click.option(
    "--sealed", metavar="FILE", required=True, type=PATH, help="File of the truth; not inside DIR."
)
out_option = click.option(
    "--out", "folder", metavar="DIR", required=True, type=PATH, help="Directory of the cases."
)


@click.group(
    epilog=examples(
        "pixcal blind make --cases 10 --seed 1001 --out exam --sealed truth.json",
        "pixcal blind run exam",
        "pixcal blind score exam --sealed truth.json",
    )
)
def blind() -> None:
    """Test the diagnosis on benches whose effects are withheld."""


@command(
    MakeConfig,
    "pixcal blind make --cases 10 --seed 1001 --out exam --sealed truth.json",
    "pixcal blind make --cases 100 --bench second --out exam --sealed truth.json",
    arguments=(out_option, sealed_option),
)
def make(folder: Path, sealed: Path, config: MakeConfig, runtime: "Runtime") -> None:
    """The cases."""
    from blind_examination import cases  # here: for a fast `pixcal --help`

    examination = cases.make(folder, sealed, config, runtime)
    click.echo(f"cases in {folder}: {config.cases}; their truth in {sealed}")
    printing.show_notes(examination.notes)


@command(
    RunConfig,
    "pixcal blind run exam",
    "pixcal blind run exam --limit 20",
    arguments=[cases_argument],
)
def run(folder: Path, config: RunConfig, runtime: "Runtime") -> None:
    """The diagnoses."""
    from blind_examination import running  # here: for a fast `pixcal --help`

    done, failed = running.run(folder, config, runtime)
    failures = f", {failed} of which failed" if failed else ""
    click.echo(f"cases diagnosed: {done}{failures}; results in {folder / 'runs'}")


@command(
    ScoreConfig,
    "pixcal blind score exam --sealed truth.json",
    "pixcal blind score exam --sealed truth.json --oracle 20 --write docs/appendix/blind.md",
    "pixcal blind score exam --sealed truth.json --also exam-2 truth-2.json",
    arguments=(cases_argument, sealed_option),
)
def score(folder: Path, sealed: Path, config: ScoreConfig, runtime: "Runtime") -> None:
    """The scores."""
    from blind_examination import marking  # here: for a fast `pixcal --help`

    _show(marking.score(folder, sealed, config, runtime))
    for file in (folder / "score.json", folder / "score.md"):
        click.echo(f"  {file}")


for each in (make, run, score):
    blind.add_command(each)


def _show(result: Mapping[str, Any]) -> None:
    rows = []
    for part, facts in result["parts"].items():
        for question, count in facts["questions"].items():
            limits = count["interval"]
            interval = "" if limits is None else f"{limits[0]:.2f} to {limits[1]:.2f}"
            rows.append(
                (part, facts["title"], question, f"{count['right']}/{count['of']}", interval)
            )
    printing.show_table(("part", "", "question", "right", "95 % interval"), rows)
    wrong = [f"{c['case']}: {c['why']}" for c in result["cases"] if not c["right"]]
    missing = [f"not diagnosed yet: {len(result['missing'])} of {result['made']} cases"]
    printing.show_notes([*wrong, *(missing if result["missing"] else []), *result["notes"]])
