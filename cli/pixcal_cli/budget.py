"""``pixcal budget``."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from pixcal.model.options import Budget
from pixcal_cli.click_options import PATH, bench_argument, config_options, examples
from pixcal_cli.printing import show_notes, show_table

LIMITS = {
    "photons": "photons",
    "uneven_light": "uneven light",
    "visibility": "visibility",
    "read_noise": "read noise",
    "phases": "too few phases",
}


@click.command(
    epilog=examples(
        "pixcal budget configs/demo.yaml",
        "pixcal budget configs/paper.yaml --precision 5e-4 --frames 10000 --out budget",
    )
)
@bench_argument
@config_options(Budget)
@click.option(
    "--out", type=PATH, metavar="DIR", help="Write budget.json and the picture budget.png there."
)
@click.option("--json", "as_json", is_flag=True, help="Print the contents of budget.json.")
def budget(bench: Path, config: Budget, out: Path | None, as_json: bool) -> None:
    """Plan an exposure: frames and hours needed for a given precision.

    BENCH.yaml describes a bench as for `pixcal simulate`. The numbers are the Cramér-Rao bound: no
    unbiased estimate needs fewer frames. The fit comes within a few percent of it.
    """
    from pixcal.stages import budget as stage  # here: for a fast `pixcal --help`

    plan = stage.run(bench, config, out)
    if as_json:
        click.echo(json.dumps(plan, indent=2))
        return
    _show(plan)
    for name in ("budget.json", "budget.png") if out is not None else ():
        click.echo(f"  {(out or Path()) / name}")


def _show(plan: Mapping[str, Any]) -> None:
    ny, nx = plan["window"]
    noise = sum(plan["variance_e2"].values()) ** 0.5
    click.echo(f"budget: {plan['bench']['file']}, {nx} × {ny} px, {noise:.3g} e- rms without light")
    _show_sets(plan)
    if plan["precision_px"] is not None:
        _show_wanted(plan)
    if plan["frames"] is not None:
        _show_given(plan)
    _show_shares(plan)
    _show_calibration(plan)
    _show_levers(plan)
    show_notes([*plan["warnings"], *(f"left out: {what}" for what in plan["left_out"])])


def _show_sets(plan: Mapping[str, Any]) -> None:
    click.echo("\nfringe sets as planned")
    rows = [
        (
            name,
            f"{s['interfringe_px']:.4g}",
            f"{s['mean_e']:.4g}",
            f"{s['visibility']:.3g}",
            f"{s['frame_px']['median']:.3g}",
            f"{s['frame_px']['worst']:.3g}",
            s["planned"]["frames"],
            f"{s['planned']['median_px']:.3g}",
            f"{s['planned']['worst_px']:.3g}",
        )
        for name, s in plan["sets"].items()
    ]
    header = (
        "set", "fringe period px", "mean e-", "visibility", "one frame px", "worst px", "frames",
        "reach px", "worst px",
    )  # fmt: skip
    show_table(header, rows)


def _show_wanted(plan: Mapping[str, Any]) -> None:
    click.echo(f"\nfor {plan['precision_px']:g} px on each axis")
    joint = plan["joined"]
    entries = [(f"{name} alone", s["wanted"]) for name, s in plan["sets"].items()]
    if len(plan["sets"]) > 1:
        entries += [(f"{name}, all sets", c["wanted"]) for name, c in joint["components"].items()]
    rows = [
        (name, w["frames"], _hours(w["hours"]), _size(w["bytes"]), w["frames_worst"])
        for name, w in entries
    ]
    show_table(("", "frames", "time", "data", "frames, worst px"), rows)


def _show_given(plan: Mapping[str, Any]) -> None:
    click.echo(f"\nwith {plan['frames']} frames of each set")
    parts = [(f"{name} alone", s["given"]) for name, s in plan["sets"].items()]
    if len(plan["sets"]) > 1:
        parts += [
            (f"{name}, all sets", c["given"]) for name, c in plan["joined"]["components"].items()
        ]
    rows = [(name, f"{g['median_px']:.3g}", f"{g['worst_px']:.3g}") for name, g in parts]
    show_table(("", "median px", "worst px"), rows)


def _show_shares(plan: Mapping[str, Any]) -> None:
    click.echo("\nframes for photon noise alone, and the factors that increase them")
    rows = [
        (
            name,
            s["shares"].get("photons_frames", "-"),
            *(f"× {s['shares'][key]:.3g}" for key in list(LIMITS)[1:]),
            LIMITS[s["limited_by"]],
        )
        for name, s in plan["sets"].items()
    ]
    header = (
        "set", "photons", "uneven light", "visibility", "read noise", "phases", "limited by",
    )  # fmt: skip
    show_table(header, rows)


def _show_calibration(plan: Mapping[str, Any]) -> None:
    click.echo(
        "\ncalibration frames for which their noise costs less than 0.1 % more fringe frames"
    )
    rows = []
    for name, s in plan["sets"].items():
        c = s["calibration"]
        flat = "-" if c["flat_error"] is None else f"{100 * c['flat_error']:.2g} %"
        rows.append(
            (
                name,
                f"{c['bias_frames_needed']} of {c['bias_frames']} planned",
                f"{c['flats_needed']} of {c['flats']} planned",
                flat,
                _percent(100 * c["flat_cost"]),
            )
        )
    show_table(("set", "bias", "flat", "noise of the flats", "which costs"), rows)


def _show_levers(plan: Mapping[str, Any]) -> None:
    click.echo("\nalternatives (all sets, the worse axis)")
    planned = next(v for v in plan["levers"] if v["name"] == "as planned")
    rows = []
    for lever in plan["levers"]:
        ratio = planned["variance"] * planned["period_s"] / (lever["variance"] * lever["period_s"])
        frames = "-" if lever["frames"] is None else lever["frames"]
        time = "-" if lever["hours"] is None else _hours(lever["hours"])
        rows.append((lever["name"], frames, time, f"{ratio:.3g}", lever["note"]))
    show_table(("change", "frames", "time", "times faster", ""), rows)


def _percent(value: float) -> str:
    return "< 0.001 %" if value < 1e-3 else f"{value:.1g} %"


def _hours(hours: float) -> str:
    for unit, length in (("d", 24.0), ("h", 1.0), ("min", 1 / 60)):
        if hours >= 2 * length:
            return f"{hours / length:.3g} {unit}"
    return f"{3600 * hours:.3g} s"


def _size(size: float) -> str:
    for unit, scale in (("TB", 1e12), ("GB", 1e9)):
        if size >= scale:
            return f"{size / scale:.3g} {unit}"
    return f"{size / 1e6:.3g} MB"
