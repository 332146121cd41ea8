"""``pixcal compare``."""

from collections.abc import Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixcal.model.options import Compare
from pixcal.storage.manifest import read_json
from pixcal_cli.click_options import PATH, command
from pixcal_cli.printing import Columns, show_notes, show_records, show_table, with_error
from pixcal_cli.results import perform

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


runs_argument = click.argument("runs", metavar="RUN [RUN]...", type=PATH, nargs=-1, required=True)
out_option = click.option(
    "--out",
    type=PATH,
    default=Path("compare"),
    show_default=True,
    metavar="DIR",
    help="Directory of compare.json and compare.png.",
)


@command(
    Compare,
    "pixcal compare demo",
    "pixcal compare monday tuesday --out repeatability",
    arguments=(runs_argument, out_option),
)
def compare(runs: tuple[Path, ...], out: Path, config: Compare, runtime: "Runtime") -> None:
    """Runs of the same window."""
    perform("compare", out, runs, out, config, runtime)
    _show(read_json(out / "compare.json"))
    for file in sorted(out.glob("compare*.*")):
        click.echo(f"  {file}")


def _show(result: Mapping[str, Any]) -> None:
    labels = [side["label"] for side in result["sides"]]
    for pair in result["pairs"]:
        first, second = pair["sides"]
        components = pair["components"]
        click.echo(f"\n{labels[first]} | {labels[second]}")
        columns: Columns = {
            "pixels": itemgetter("pixels"),
            "correlation": lambda c: with_error(c["correlation"], c["correlation_error"]),
            "slope": lambda c: with_error(c["slope"], c["slope_error"]),
        }
        show_records("", components, {**columns, **SIZES})
        for name, facts in components.items():
            click.echo(f"\n  {name} by scale")
            *smaller, last = [f"{scale['side_px']} px" for scale in facts["scales"]]
            sides = [*smaller, f"{last} and larger"]
            show_records("scale", dict(zip(sides, facts["scales"], strict=True)), SIZES)
        show_notes(_sentences(components))
    if result["summary"] is not None:
        click.echo("\nerrors of each map beyond noise, from the differences of all pairs, px")
        own = [map(_amount, facts["own"]) for facts in result["summary"].values()]
        show_table(("", *result["summary"]), list(zip(labels, *own, strict=True)))
    show_notes(result["warnings"])


def _sentences(components: Mapping[str, Any]) -> Iterator[str]:
    for name, facts in components.items():
        evidence = "; ".join(facts["evidence"])
        yield f"{name}: {f'beyond noise: {evidence}' if evidence else 'consistent with noise'}"
        if facts["suspicion"] is not None:
            yield f"{name}: {facts['suspicion']}"


def _amount(estimate: Mapping[str, float]) -> str:
    """A size with its error, or its upper limit (95 %) where it is not significant."""
    if estimate["variance_px2"] < 2 * estimate["variance_error_px2"]:
        return f"< {estimate['upper_px']:.2g}"
    return f"{estimate['px']:.3g} ± {estimate['error_px']:.1g}"


SIZES: Columns = {
    "common px": lambda facts: _amount(facts["common"]),
    "difference px": lambda facts: f"{facts['difference_px']:.3g}",
    "noise px": lambda facts: f"{facts['expected_px']:.3g}",
    "ratio": lambda facts: with_error(facts["ratio"], facts["ratio_error"]),
    "beyond noise px": lambda facts: _amount(facts["beyond_noise"]),
}
