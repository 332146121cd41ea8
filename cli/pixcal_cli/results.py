"""What the commands print on stdout: where the results are, and the main numbers."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from pixcal.storage.artefact import MANIFEST, read_json
from pixcal.storage.cube_place import cubes_of
from pixcal_cli.printing import number, show_notes, show_table, with_error


@contextmanager
def announce(stage: str, folder: Path) -> Iterator[None]:
    """Print where the stage inside the block left its artefact, and whether it is new."""
    before = _made_at(folder)
    yield
    state = "up to date" if before is not None and before == _made_at(folder) else "written"
    click.echo(f"{stage}: {folder} ({state})")
    if (place := cubes_of(folder)) != folder:
        click.echo(f"  cubes: {place}")


def _made_at(folder: Path) -> int | None:
    # A manifest is written once, with its artefact: another time is another artefact.
    try:
        return (folder / MANIFEST).stat().st_mtime_ns
    except (FileNotFoundError, NotADirectoryError):
        return None


def show_simulate(acquisition: Path) -> None:
    """Print how many files of each kind there are."""
    files = read_json(acquisition / MANIFEST)["summary"]["files"]
    folders = Counter(name.partition("/")[0] for name in files if "/" in name)
    show_table(("folder", "files"), list(folders.items()))


def show_ingest(run: Path) -> None:
    """Print one row for each array of frames, and the warnings."""
    summary = read_json(run / "ingest" / MANIFEST)["summary"]
    rows = [
        (
            name,
            array["shape"][0],
            f"{array['shape'][2]} × {array['shape'][1]}",
            array["dtype"],
            "copied" if array["copied"] else "in their files",
        )
        for name, array in summary["arrays"].items()
    ]
    show_table(("array", "frames", "x × y", "type", "samples"), rows)
    show_notes(summary["warnings"])


def show_reduce(run: Path) -> None:
    """Print gain and read noise, declared and measured, and how many pixels have each flag."""
    facts = read_json(run / "reduce" / "reduce.json")
    rows = [
        (
            label,
            number(facts[key]["declared"]),
            with_error(facts[key]["measured"], facts[key]["error"]),
            number(facts[key]["used"]),
        )
        for label, key in (("gain e-/ADU", "gain_e_per_adu"), ("read noise e-", "read_noise_e"))
    ]
    show_table(("quantity", "declared", "measured", "used"), rows)
    figures = facts.get("figures_of_merit", {})
    shown = [
        (f["title"], f"{_figure(f['value'], f['error'])} {f['unit']}".rstrip(), f["note"])
        for key, f in figures.items()
        if not key.endswith(_PARTS)
    ]
    if shown:
        show_table(("figure of merit (measured gain)", "value", ""), shown)
    counts = ", ".join(f"{count} {flag}" for flag, count in facts["flags"].items() if count)
    click.echo(f"  pixels: {counts}")
    show_notes(facts["warnings"])


_PARTS = ("_row", "_column", "_pixel")
"""Parts of a figure of merit, which the JSON and the report have."""


def show_fit(run: Path) -> None:
    """Print one row for each fringe set: how good its map of offsets is, and the bound."""
    sets = read_json(run / "fit" / "fit.json")["sets"]
    rows = [
        (
            name,
            fitted["model"],
            fitted["frames"],
            number(fitted["interfringe_px"], 5),
            number(fitted["sigma_median_px"], 3),
            number(fitted["crb_median_px"], 3),
            number(_ratio(fitted["sigma_median_px"], fitted["crb_median_px"]), 3),
            number(fitted["chi2_reduced"], 4),
        )
        for name, fitted in sets.items()
    ]
    header = [
        "set",
        "model",
        "frames",
        "fringe period px",
        "sigma px",
        "bound px",
        "sigma/bound",
        "chi2",
    ]
    show_table(header, rows)
    # Fits of earlier versions have no such note.
    notes = {name: fitted.get("period_note") for name, fitted in sets.items()}
    show_notes([f"{name}: {note}" for name, note in notes.items() if note])


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
    header = (
        "set",
        "change px rms",
        "maximum",
        "residual px",
        "sigma px",
        "chi2",
        "4-row period px",
    )
    show_table(header, [_gain_row(name, facts) for name, facts in correction["sets"].items()])
    show_notes(
        ["residual px: error of the offsets from the uncertainty of the effects' parameters"]
    )
    for pair in correction["pairs"]:
        expected = number(pair["after_expected_px"], 3)
        apart = _before_after(pair["before_px"], pair["after_px"])
        sets = " and ".join(pair["sets"])
        click.echo(f"  difference between {sets}: {apart} px ({expected} px expected from noise)")
    if not correction["pairs"]:
        show_notes(["one set along each axis: a second baseline would verify the correction"])


def _gain_row(name: str, facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Change of the offsets of a set, and its figures before and after."""
    left = [error for error in facts["parameter_error_px"].values() if error is not None]
    rows = facts["rows"]
    return (
        name,
        number(facts["change"]["rms_px"], 3),
        number(facts["change"]["max_px"], 3),
        number(math.hypot(*left) if left else None, 3),
        _before_after(facts["sigma_median_px"]["before"], facts["sigma_median_px"]["after"]),
        _before_after(facts["chi2_reduced"]["before"], facts["chi2_reduced"]["after"], 4),
        "-" if rows is None else _before_after(rows["before_px"], rows["after_px"]),
    )


def _before_after(before: float | None, after: float | None, digits: int = 3) -> str:
    return f"{number(before, digits)} → {number(after, digits)}"


def show_allan(run: Path) -> None:
    """Print one row for each fringe set and region: how the error falls with more frames."""
    rows, notes = [], []
    for name, curves in read_json(run / "allan" / "allan.json")["sets"].items():
        for region, curve in ({"all": curves} | curves["regions"]).items():
            rows.append((name, region, *_allan_row(curve)))
        notes += [f"{name}: {sentence}" for sentence in curves["warnings"]]
    show_table(("set", "region", "slope", "knee", "frames", "deviation px", "if white px"), rows)
    show_notes(notes)


def _allan_row(curve: Mapping[str, Any]) -> tuple[str, ...]:
    """Slope, knee, and the deviation at the longest averaging."""
    if not curve["adev_px"]:
        return ("-",) * 5
    knee = curve["knee_frames"]
    return (
        with_error(curve["slope"], curve["slope_err"]),
        "none" if knee is None else f"{number(knee)} frames",
        str(curve["frames"][-1]),
        with_error(curve["adev_px"][-1], curve["adev_err_px"][-1]),
        number(curve["white_expected_px"][-1], 3),
    )


def show_diagnosis(run: Path) -> None:
    """Print the verdict, the causes, the largest differences and the recommended frames."""
    diagnosis = read_json(run / "diagnose" / "diagnosis.json")
    gap = diagnosis["gap"]
    low, high = (100 * end for end in gap["interval"])
    click.echo(
        f"  {diagnosis['verdict']}; residual gap: {100 * gap['after']:.0f} % "
        f"(90 % interval {low:.0f} to {high:.0f} %)"
    )
    causes = [
        (
            cause["effect"],
            "{:.1f} % ({:.1f} to {:.1f} %)".format(
                *(100 * v for v in (cause["gap_closed"], *cause["gap_closed_interval"]))
            ),
            f"{100 * cause['gain_over_rest']:.1f} %",
            _chance(cause["p_value"]),
            ", ".join(cause["not_told_apart_from"]) or "-",
        )
        for cause in diagnosis["causes"]
    ]
    if causes:
        header = ("cause", "gap closed", "unique share", "p-value", "indistinguishable from")
        show_table(header, causes)
    for cause in diagnosis["causes"]:
        _show_cause(cause)
    rows = [
        (
            f"{entry['domain']}: {entry['title']}",
            entry["place"],
            f"{number(entry['measured'], 3)} {entry['unit']}".strip(),
            number(entry["simulated"], 3),
            number(entry["after"], 3),
            f"{entry['significance']:.1f}",
        )
        for entry in gap["where"][:MAX_ROWS]
    ]
    if rows:
        columns = ("statistic", "where", "measured", "nominal", "with causes", "significance σ")
        show_table(columns, rows)
        if len(gap["where"]) > MAX_ROWS:
            click.echo(f"  and {len(gap['where']) - MAX_ROWS} more in diagnosis.json")
    if diagnosis["more_would_tell"]:
        click.echo(f"  recommended frames: {'; '.join(diagnosis['more_would_tell'])}")


def _show_cause(cause: Mapping[str, Any]) -> None:
    """Print the law of a cause, and the frames that would distinguish it from others."""
    law, by_law = cause.get("law", ""), cause.get("gap_closed_by_law", cause["gap_closed"])
    differs = abs(by_law - cause["gap_closed"]) > LAW_DIFFERS
    alone = f"the law alone closes {100 * by_law:.1f} %" if differs else ""
    if law or alone:
        click.echo(f"  {cause['effect']}: {'; '.join(filter(None, (law, alone)))}")
    if cause["would_decide"]:
        others = " or ".join(cause["not_told_apart_from"])
        frames = "; ".join(cause["would_decide"])
        click.echo(f"  recommended frames to distinguish {cause['effect']} from {others}: {frames}")


LAW_DIFFERS = 0.02
"""Difference of the shares closed by a cause and by its law alone that is printed."""
MAX_ROWS = 8
"""Largest number of differences that are printed."""
MIN_P_VALUE = 1e-12
"""Smallest p-value that is printed as a number."""


def _chance(p: float) -> str:
    return f"< {MIN_P_VALUE:.0e}" if p <= MIN_P_VALUE else f"{p:.1e}"


def show_report(run: Path) -> None:
    """Print where the page is."""
    click.echo(f"  {run / 'products' / 'report.html'}")


def show_advice(run: Path) -> None:
    """Print which map to use, what limits it, and what each cause does to it."""
    from pixcal.stages.advice import advice  # here: for a fast `pixcal --help`

    summary = advice(run)
    click.echo()
    for sentence in summary.sentences:
        click.echo(sentence)
    if summary.rows:
        show_table(summary.rows[0], summary.rows[1:])


def show_run(run: Path, *, fitted: bool, diagnosed: bool) -> None:
    """Print which map to use, the results of all steps, and where the products are."""
    show_advice(run)
    if warnings := read_json(run / "ingest" / MANIFEST)["summary"]["warnings"]:
        click.echo("\ningest")
        show_notes(warnings)
    steps = {"reduce": show_reduce} | ({"fit": show_fit, "allan": show_allan} if fitted else {})
    steps |= {"diagnose": show_diagnosis} if diagnosed else {}
    for stage, show in steps.items():
        click.echo(f"\n{stage}")
        show(run)
    click.echo("\nproducts")
    for file in sorted((run / "products").iterdir()):
        click.echo(f"  {file}")


def _ratio(a: float | None, b: float | None) -> float | None:
    return a / b if a is not None and b else None


def _figure(value: float, error: float | None) -> str:
    """As `with_error`; a large number without error not as a power of ten."""
    return f"{value:.0f}" if error is None and value >= 1e4 else with_error(value, error)
