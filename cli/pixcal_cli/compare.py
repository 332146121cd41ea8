"""``pixcal compare``."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixcal.model.options import Compare
from pixcal.storage.artefact import read_json
from pixcal_cli import results
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
        click.echo(f"\n{labels[first]} | {labels[second]}")
        _show_totals(pair["components"])
        for name, facts in pair["components"].items():
            click.echo(f"\n  {name} by scale")
            _show_scales(facts)
        results.show_notes(_sentences(pair["components"]))
    if result["summary"] is not None:
        _show_summary(result["summary"], labels)
    results.show_notes(result["warnings"])


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


def _show_totals(components: Mapping[str, Any]) -> None:
    rows = [
        (
            name,
            facts["pixels"],
            results.with_error(facts["correlation"], facts["correlation_error"]),
            results.with_error(facts["slope"], facts["slope_error"]),
            _amount(facts["common"]),
            f"{facts['difference_px']:.3g}",
            f"{facts['expected_px']:.3g}",
            results.with_error(facts["ratio"], facts["ratio_error"]),
            _amount(facts["beyond_noise"]),
        )
        for name, facts in components.items()
    ]
    header = (
        "", "pixels", "correlation", "slope", "common px", "difference px", "noise px", "ratio",
        "beyond noise px",
    )  # fmt: skip
    results.show_table(header, rows)


def _show_scales(facts: Mapping[str, Any]) -> None:
    scales = facts["scales"]
    rows = [
        (
            f"{scale['side_px']} px" + (" and larger" if scale is scales[-1] else ""),
            _amount(scale["common"]),
            f"{scale['difference_px']:.3g}",
            f"{scale['expected_px']:.3g}",
            results.with_error(scale["ratio"], scale["ratio_error"]),
            _amount(scale["beyond_noise"]),
        )
        for scale in scales
    ]
    header = ("scale", "common px", "difference px", "noise px", "ratio", "beyond noise px")
    results.show_table(header, rows)


def _show_summary(summary: Mapping[str, Any], labels: list[str]) -> None:
    click.echo("\neach map's own errors beyond noise, from the differences of all pairs, px")
    rows = [
        (label, *(_amount(facts["own"][n]) for facts in summary.values()))
        for n, label in enumerate(labels)
    ]
    results.show_table(("", *summary), rows)


def _amount(estimate: Mapping[str, float]) -> str:
    """A size with its error, or its upper limit (95 %) where it is not significant."""
    if estimate["variance_px2"] < 2 * estimate["variance_error_px2"]:
        return f"< {estimate['upper_px']:.2g}"
    return f"{estimate['px']:.3g} ± {estimate['error_px']:.1g}"
