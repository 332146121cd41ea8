"""What the commands print of a diagnosis: advice, causes, differences and corrections."""

import math
from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import click

from pixcal.report.text import chance, not_tested, share_by_law, times
from pixcal.storage.manifest import read_json
from pixcal_cli.printing import Columns, number, show_notes, show_records, show_table

MAX_NAMED = 3  # most statistics in a line
MAX_ROWS = 8  # most differences that are printed


def show_correction(run: Path) -> None:
    """Print how each effect of a diagnosis was treated, and how the maps changed."""
    correction = read_json(run / "corrected" / "correction.json")
    if not correction["effects"]:
        click.echo(
            f"  {correction['verdict']}: the diagnosis found no effect; use the maps of the fit"
        )
        return
    rows = [(e["effect"], e["treatment"], e["why"]) for e in correction["effects"]]
    show_table(("effect", "treatment", "why"), rows)
    if not correction["outputs"]:
        click.echo("  nothing to correct: use the maps of the fit")
        return
    columns: Columns = {
        "change px rms": lambda s: number(s["change"]["rms_px"], 3),
        "maximum": lambda s: number(s["change"]["max_px"], 3),
        "residual px": lambda s: _quadratic_sum(s["parameter_error_px"]),
        "sigma px": lambda s: _before_after(s["sigma_median_px"]),
        "chi2": lambda s: _before_after(s["chi2_reduced"], 4),
        "4-row period px": lambda s: _before_after(s["rows"], unit="_px"),
    }
    show_records("set", correction["sets"], columns)
    show_notes(
        ["residual px: error of the offsets from the uncertainty of the effects' parameters"]
    )
    for pair in correction["pairs"]:
        expected, sets = number(pair["after_expected_px"], 3), " and ".join(pair["sets"])
        apart = _before_after(pair, unit="_px")
        click.echo(f"  difference between {sets}: {apart} px ({expected} px expected from noise)")
    if not correction["pairs"]:
        show_notes(["one set along each axis: a second baseline would verify the correction"])
    show_notes(
        [
            f"{name}: sigma is enlarged by {factor:.2f}, because the corrected maps from each half "
            "of the frames differ by more than their noise"
            for name, facts in correction["sets"].items()
            # Corrections of earlier versions do not have it.
            if (factor := facts.get("sigma_enlarged", 1.0)) > 1
        ]
    )


def _quadratic_sum(errors: Mapping[str, float | None]) -> str:
    known = [error for error in errors.values() if error is not None]
    return number(math.hypot(*known) if known else None, 3)


def _before_after(facts: Mapping[str, Any] | None, digits: int = 3, unit: str = "") -> str:
    ends = [number(facts[f"{when}{unit}"], digits) for when in ("before", "after")] if facts else []
    return " → ".join(ends) or "-"


def show_diagnosis(run: Path) -> None:
    """Print the verdict, the causes, the largest differences and the recommended frames."""
    diagnosis = read_json(run / "diagnose" / "diagnosis.json")
    gap = diagnosis["gap"]
    low, high = (100 * end for end in gap["interval"])
    click.echo(
        f"  {diagnosis['verdict']}; residual gap: {100 * gap['after']:.0f} % "
        f"(90 % interval {low:.0f} to {high:.0f} %)"
    )
    staying = [f"{e['title']}, {e['place']}" for e in gap["where"] if e.get("stays")]
    if diagnosis["verdict"] == "partly explained" and staying:
        more = f"; and {len(staying) - MAX_NAMED} more" if len(staying) > MAX_NAMED else ""
        click.echo(f"  still different with all causes: {'; '.join(staying[:MAX_NAMED])}{more}")
    if diagnosis["verdict"] == "no gap":
        show_notes(list(filter(None, [not_tested(diagnosis)])))
    else:
        click.echo(
            "  gap: sum of all significant differences between frames and simulation, in units of "
            "the scatter of nominal simulations"
        )
    columns: Columns = {
        "gap closed": lambda c: _closed(c["gap_closed"], c["gap_closed_interval"]),
        "unique share": lambda c: f"{100 * c['gain_over_rest']:.1f} %",
        "p-value": lambda c: chance(c["p_value"]),
        "indistinguishable from": lambda c: ", ".join(c["not_told_apart_from"]) or "-",
    }
    if diagnosis["causes"]:
        show_records("cause", {c["effect"]: c for c in diagnosis["causes"]}, columns)
    for cause in diagnosis["causes"]:
        _show_cause(cause)
    columns = {
        "where": itemgetter("place"),
        "measured": lambda e: f"{number(e['measured'], 3)} {e['unit']}".strip(),
        "nominal": lambda e: number(e["simulated"], 3),
        "with causes": lambda e: number(e["after"], 3),
        "difference/scatter": lambda e: times(e["size"]),
        "significance σ": lambda e: f"{e['significance']:.1f}",
    }
    differing = [e for e in gap["where"] if e["significance"] > 0]
    rows = [
        (f"{e['domain']}: {e['title']}", *(cell(e) for cell in columns.values()))
        for e in differing[:MAX_ROWS]
    ]
    if rows:
        show_table(("statistic", *columns), rows)
        if len(differing) > MAX_ROWS:
            click.echo(f"  and {len(differing) - MAX_ROWS} more in diagnosis.json")
    if diagnosis["more_would_tell"]:
        click.echo(f"  recommended frames: {'; '.join(diagnosis['more_would_tell'])}")


def _show_cause(cause: Mapping[str, Any]) -> None:
    """Print the law of a cause, and the frames that would distinguish it from others."""
    law, by_law = cause.get("law", ""), share_by_law(cause)
    alone = "" if by_law is None else f"the law alone closes {100 * by_law:.1f} %"
    if law or alone:
        click.echo(f"  {cause['effect']}: {'; '.join(filter(None, (law, alone)))}")
    if cause["would_decide"]:
        others = " or ".join(cause["not_told_apart_from"])
        frames = "; ".join(cause["would_decide"])
        click.echo(f"  recommended frames to distinguish {cause['effect']} from {others}: {frames}")


def _closed(share: float, interval: Sequence[float]) -> str:
    low, high = (100 * end for end in interval)
    return f"{100 * share:.1f} % ({low:.1f} to {high:.1f} %)"


def show_advice(run: Path) -> None:
    """Print which map to use, what limits it, and how each cause affects it."""
    from pixcal.stages.advice import advice  # here: for a fast `pixcal --help`

    summary = advice(run)
    if summary.sentences:
        click.echo()
    for sentence in summary.sentences:
        click.echo(sentence)
    if summary.rows:
        show_table(summary.rows[0], summary.rows[1:])
