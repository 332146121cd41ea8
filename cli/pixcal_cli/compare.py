"""``pixcal compare``."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixcal.model.options import Compare
from pixcal.storage.artefact import read_json
from pixcal_cli import printing, results
from pixcal_cli.click_options import PATH, Command, command

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


def runs_and_out(body: Command) -> Command:
    """The runs, and where the result goes."""
    out = click.option(
        "--out",
        type=PATH,
        default=Path("compare"),
        show_default=True,
        metavar="DIR",
        help="Directory of compare.json and compare.png.",
    )
    runs = click.argument("runs", metavar="RUN [RUN]...", type=PATH, nargs=-1, required=True)
    return runs(out(body))


@command(
    Compare,
    "pixcal compare demo",
    "pixcal compare monday tuesday --out repeatability",
    argument=runs_and_out,
)
def compare(runs: tuple[Path, ...], out: Path, config: Compare, runtime: "Runtime") -> None:
    """Compare maps of the same pixels, scale by scale.

    Give two or more fitted runs of the same window, or one run to compare with itself.
    """
    from pixcal.stages import compare as stage  # here: for a fast `pixcal --help`

    with results.announce("compare", out):
        stage.run(runs, out, config, runtime)
    _show(read_json(out / "compare.json"))
    for file in sorted(out.glob("compare*.*")):
        click.echo(f"  {file}")


def _show(result: Mapping[str, Any]) -> None:
    labels = [side["label"] for side in result["sides"]]
    for pair in result["pairs"]:
        first, second = pair["sides"]
        components = pair["components"]
        click.echo(f"\n{labels[first]} | {labels[second]}")
        rows = [
            (
                name,
                facts["pixels"],
                printing.with_error(facts["correlation"], facts["correlation_error"]),
                printing.with_error(facts["slope"], facts["slope_error"]),
                *_sizes(facts),
            )
            for name, facts in components.items()
        ]
        printing.show_table(("", "pixels", "correlation", "slope", *SIZES), rows)
        for name, facts in components.items():
            click.echo(f"\n  {name} by scale")
            *smaller, last = [f"{scale['side_px']} px" for scale in facts["scales"]]
            sides = [*smaller, f"{last} and larger"]
            sizes = zip(sides, map(_sizes, facts["scales"]), strict=True)
            printing.show_table(("scale", *SIZES), [(side, *row) for side, row in sizes])
        printing.show_notes(_sentences(components))
    if result["summary"] is not None:
        click.echo("\nerrors of each map beyond noise, from the differences of all pairs, px")
        columns = [map(_amount, facts["own"]) for facts in result["summary"].values()]
        rows = list(zip(labels, *columns, strict=True))
        printing.show_table(("", *result["summary"]), rows)
    printing.show_notes(result["warnings"])


SIZES = ("common px", "difference px", "noise px", "ratio", "beyond noise px")


def _sizes(facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Cells of `SIZES`."""
    return (
        _amount(facts["common"]),
        f"{facts['difference_px']:.3g}",
        f"{facts['expected_px']:.3g}",
        printing.with_error(facts["ratio"], facts["ratio_error"]),
        _amount(facts["beyond_noise"]),
    )


def _sentences(components: Mapping[str, Any]) -> list[str]:
    sentences = []
    for name, facts in components.items():
        evidence = "; ".join(facts["evidence"])
        sentences.append(
            f"{name}: {f'beyond noise: {evidence}' if evidence else 'noise explains all'}"
        )
        if facts["suspicion"] is not None:
            sentences.append(f"{name}: {facts['suspicion']}")
    return sentences


def _amount(estimate: Mapping[str, float]) -> str:
    """A size with its error, or its upper limit (95 %) where it is not significant."""
    if estimate["variance_px2"] < 2 * estimate["variance_error_px2"]:
        return f"< {estimate['upper_px']:.2g}"
    return f"{estimate['px']:.3g} ± {estimate['error_px']:.1g}"
