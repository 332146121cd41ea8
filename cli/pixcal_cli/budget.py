"""``pixcal budget``."""

import json
from collections.abc import Callable, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any

import click

from pixcal.model.options import Budget
from pixcal_cli.click_options import PATH, bench_argument, command
from pixcal_cli.printing import Columns, show_notes, show_records

LIMITS = {
    "photons": "photons",
    "uneven_light": "uneven light",
    "visibility": "visibility",
    "read_noise": "read noise",
    "phases": "too few phases",
}

out_option = click.option(
    "--out", type=PATH, metavar="DIR", help="Write budget.json and the picture budget.png there."
)
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the contents of budget.json."
)


@command(
    Budget,
    "pixcal budget configs/demo.yaml",
    "pixcal budget configs/paper.yaml --precision 5e-4 --frames 10000 --out budget",
    arguments=(bench_argument, out_option, json_option),
    tasks=False,
)
def budget(bench: Path, config: Budget, out: Path | None, as_json: bool) -> None:
    """The bound for the bench BENCH.yaml."""
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
    _show_bound(plan, "precision_px", "\nfor {:g} px on each axis", "wanted", WANTED)
    _show_bound(plan, "frames", "\nwith {} frames of each set", "given", GIVEN)
    _show_shares(plan)
    _show_calibration(plan)
    _show_levers(plan)
    show_notes([*plan["warnings"], *(f"left out: {what}" for what in plan["left_out"])])


def _show_sets(plan: Mapping[str, Any]) -> None:
    click.echo("\nfringe sets as planned")
    columns: Columns = {
        "fringe period px": lambda s: f"{s['interfringe_px']:.4g}",
        "mean e-": lambda s: f"{s['mean_e']:.4g}",
        "visibility": lambda s: f"{s['visibility']:.3g}",
        "one frame px": lambda s: f"{s['frame_px']['median']:.3g}",
        "one frame, worst px": lambda s: f"{s['frame_px']['worst']:.3g}",
        "frames": lambda s: s["planned"]["frames"],
        "reach px": lambda s: f"{s['planned']['median_px']:.3g}",
        "reach, worst px": lambda s: f"{s['planned']['worst_px']:.3g}",
    }
    show_records("set", plan["sets"], columns)


WANTED: Columns = {
    "frames": itemgetter("frames"),
    "time": lambda w: _hours(w["hours"]),
    "data": lambda w: _size(w["bytes"]),
    "frames, worst px": itemgetter("frames_worst"),
}
GIVEN: Columns = {
    "median px": lambda g: f"{g['median_px']:.3g}",
    "worst px": lambda g: f"{g['worst_px']:.3g}",
}


def _show_bound(
    plan: Mapping[str, Any], option: str, title: str, key: str, columns: Columns
) -> None:
    """Precision of each set alone and, for several sets, of each axis from all of them."""
    if plan[option] is None:
        return
    click.echo(title.format(plan[option]))
    joined = plan["joined"]["components"] if len(plan["sets"]) > 1 else {}
    entries = {f"{name} alone": s[key] for name, s in plan["sets"].items()}
    show_records("", entries | {f"{n}, all sets": c[key] for n, c in joined.items()}, columns)


def _show_shares(plan: Mapping[str, Any]) -> None:
    click.echo("\nframes for photon noise alone, and the factors that increase them")

    def factor(key: str) -> Callable[[Any], str]:
        return lambda s: f"× {s['shares'][key]:.3g}"

    factors = {LIMITS[key]: factor(key) for key in list(LIMITS)[1:]}
    columns: Columns = {
        "photons": lambda s: s["shares"].get("photons_frames", "-"),
        **factors,
        "limited by": lambda s: LIMITS[s["limited_by"]],
    }
    show_records("set", plan["sets"], columns)


def _show_calibration(plan: Mapping[str, Any]) -> None:
    click.echo(
        "\ncalibration frames, enough that their noise costs less than 0.1 % more fringe frames"
    )
    columns: Columns = {
        "bias": lambda c: f"{c['bias_frames_needed']} of {c['bias_frames']} planned",
        "flat": lambda c: f"{c['flats_needed']} of {c['flats']} planned",
        "noise of the flats": lambda c: (
            "-" if c["flat_error"] is None else f"{100 * c['flat_error']:.2g} %"
        ),
        "which costs": lambda c: _percent(100 * c["flat_cost"]),
    }
    show_records("set", {n: s["calibration"] for n, s in plan["sets"].items()}, columns)


def _show_levers(plan: Mapping[str, Any]) -> None:
    click.echo("\nalternatives (all sets, the worse axis)")
    levers = {v["name"]: v for v in plan["levers"]}
    cost = {name: v["variance"] * v["period_s"] for name, v in levers.items()}
    columns: Columns = {
        "frames": itemgetter("frames"),
        "time": lambda v: None if v["hours"] is None else _hours(v["hours"]),
        "times faster": lambda v: f"{cost['as planned'] / cost[v['name']]:.3g}",
        "": itemgetter("note"),
    }
    show_records("change", levers, columns)


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
