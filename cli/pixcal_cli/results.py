"""What the commands print on stdout: where the results are, and the main numbers."""

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from operator import itemgetter
from pathlib import Path
from typing import Any

import click

from pixcal.report.text import ratio
from pixcal.storage.cube_place import cubes_of
from pixcal.storage.manifest import MANIFEST, read_json
from pixcal_cli.diagnosis_results import show_advice, show_diagnosis
from pixcal_cli.printing import (
    Columns,
    figure,
    number,
    show_notes,
    show_records,
    show_table,
    with_error,
)


@contextmanager
def announce(stage: str, folder: Path) -> Iterator[None]:
    """Print where the stage inside the block left its artefact, and whether it is new."""
    before = _made_at(folder)
    yield
    state = "up to date" if before is not None and before == _made_at(folder) else "written"
    click.echo(f"{stage}: {folder} ({state})")
    if (place := cubes_of(folder)) != folder:
        click.echo(f"  cubes: {place}")


def perform(stage: str, folder: Path, *arguments: Any, label: str = "") -> None:
    """Run a stage inside `announce`; it is imported here, for a fast ``pixcal --help``."""
    with announce(label or stage, folder):
        import_module(f"pixcal.stages.{stage}").run(*arguments)


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
    columns: Columns = {
        "frames": lambda array: array["shape"][0],
        "x × y": lambda array: f"{array['shape'][2]} × {array['shape'][1]}",
        "type": itemgetter("dtype"),
        "samples": lambda array: "copied" if array["copied"] else "in their files",
    }
    show_records("array", summary["arrays"], columns)
    show_notes(summary["warnings"])


def show_reduce(run: Path) -> None:
    """Print gain and read noise, declared and measured, and how many pixels have each flag."""
    facts = read_json(run / "reduce" / "reduce.json")
    columns: Columns = {
        "declared": lambda of: number(of["declared"]),
        "measured": lambda of: with_error(of["measured"], of["error"]),
        "used": lambda of: number(of["used"]),
    }
    quantities = {"gain e-/ADU": facts["gain_e_per_adu"], "read noise e-": facts["read_noise_e"]}
    show_records("quantity", quantities, columns)
    shown = [
        (f["title"], f"{figure(f['value'], f['error'])} {f['unit']}".rstrip(), f["note"])
        for key, f in facts.get("figures_of_merit", {}).items()
        # The JSON and the report have its parts as well.
        if not key.endswith(("_row", "_column", "_pixel"))
    ]
    if shown:
        gain = "declared" if facts["gain_e_per_adu"]["measured"] is None else "measured"
        show_table((f"figure of merit ({gain} gain)", "value", ""), shown)
    counts = ", ".join(f"{count} {flag}" for flag, count in facts["flags"].items() if count)
    click.echo(f"  pixels: {counts}")
    show_notes(facts["warnings"])


def show_fit(run: Path) -> None:
    """Print one row for each fringe set: how good its map of offsets is, and the bound."""
    sets = read_json(run / "fit" / "fit.json")["sets"]
    columns: Columns = {
        "model": itemgetter("model"),
        "frames": itemgetter("frames"),
        "fringe period px": lambda s: number(s["interfringe_px"], 5),
        "sigma px": lambda s: number(s["sigma_median_px"], 3),
        "bound px": lambda s: number(s["crb_median_px"], 3),
        "sigma/bound": lambda s: number(ratio(s["sigma_median_px"], s["crb_median_px"]), 3),
        "chi2": lambda s: number(s["chi2_reduced"]),
    }
    show_records("set", sets, columns)
    # Fits of earlier versions have no such note.
    show_notes([f"{n}: {s['period_note']}" for n, s in sets.items() if s.get("period_note")])


def show_allan(run: Path) -> None:
    """Print one row for each fringe set and region: how the error falls with more frames."""
    rows, notes = [], []
    for name, curves in read_json(run / "allan" / "allan.json")["sets"].items():
        for region, curve in ({"all": curves} | curves["regions"]).items():
            rows.append((name, region, *_allan_row(curve)))
        notes += [f"{name}: {sentence}" for sentence in curves["warnings"]]
    show_table(("set", "region", "slope", "knee", "frames", "deviation px", "white noise px"), rows)
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


def show_crests(run: Path) -> None:
    """Print the points, the fibres and the difference from the fit for each set."""
    parameters = ("centre_x", "centre_y", "distance", "baseline_x", "baseline_y", "baseline_z")
    for name, facts in read_json(run / "crests" / "crests.json")["sets"].items():
        click.echo(
            f"  {name}: {facts['points_used']} of {facts['points']} points, error per point "
            f"{facts['point_sigma_median_px']:.2g} px, chi2 {facts['chi2_reduced']:.3g}"
        )
        geometry, agreement = facts["geometry"], facts["agreement"]
        for parameter in parameters:
            value, sigma = geometry[f"{parameter}_mm"], geometry[f"{parameter}_sigma_mm"]
            line = f"    {parameter:10s} {value:.6g} ± {sigma:.2g} mm"
            if agreement is not None:
                other = agreement["parameters"][parameter]
                origin = ", mostly from its prior" if other["from_prior"] else ""
                line += f", {other['difference_sigma']:+.2f} sigma from the fit{origin}"
            click.echo(line)
        if agreement is None:
            click.echo(f"    not compared: {facts['agreement_note']}")
        else:
            click.echo(
                f"    phase difference: {agreement['phase_rms_px']:.2g} px rms, "
                f"{agreement['phase_sigma_px']:.2g} px expected"
            )
        for sentence in facts["warnings"]:
            click.echo(f"    note: {sentence}")
        click.echo(f"  {run / 'products' / f'crests-{name}.png'}")


def show_astrometry(run: Path) -> None:
    """Print the errors of star centroids, and the requirement of the mission."""
    from pixcal.stages.astrometry import table  # here: for a fast `pixcal --help`

    result = read_json(run / "astrometry" / "astrometry.json")
    t, axes = result["telescope"], result["axes"]
    bound = next(iter(axes.values()))["photon_bound"]
    click.echo(
        f"  {t['diameter_m']:g} m, {t['focal_length_m']:g} m, {t['wavelength_nm']:g} nm: "
        f"{t['uas_per_px'] / 1e3:.3g} mas/px, {t['px_per_lambda_over_d']:.3g} px in λ/D; "
        f"photon noise alone {bound['px']:.3g} px, {bound['uas']:.3g} µas"
    )
    header = ("error of a centroid", "along", "perfect grid", "measured maps", "gain")
    show_table(header, table(result))
    for name, axis in axes.items():
        need = axis["positions_to_target"]
        perfect, measured = ("-" if (n := need[k]) is None else n for k in ("perfect", "measured"))
        click.echo(
            f"  positions to {need['target_px']:.0e} px along {name}, if independent: "
            f"{perfect} with a perfect grid, {measured} with maps"
        )
    show_notes(result["warnings"])
    click.echo(f"  {run / 'products' / 'astrometry.png'}")


def show_report(run: Path) -> None:
    """Print the path of the page."""
    click.echo(f"  {run / 'products' / 'report.html'}")


def show_run(run: Path, fitted: bool, diagnosed: bool) -> None:
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
