"""``pixcal crests``."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixcal.model.options import Crests
from pixcal.storage.manifest import read_json
from pixcal_cli.click_options import command
from pixcal_cli.results import perform

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


@command(Crests, "pixcal crests demo", "pixcal crests demo --frames 1 --paths 4")
def crests(run: Path, config: Crests, runtime: "Runtime") -> None:
    """The fibres of each set."""
    perform("crests", run / "crests", run, config, runtime)
    for name, facts in read_json(run / "crests" / "crests.json")["sets"].items():
        _show(name, facts)
        click.echo(f"  {run / 'products' / f'crests-{name}.png'}")


def _show(name: str, facts: dict[str, Any]) -> None:
    """The points, the fibres, and the difference from the fit."""
    click.echo(
        f"  {name}: {facts['points_used']} of {facts['points']} points, error per point "
        f"{facts['point_sigma_median_px']:.2g} px, chi2 {facts['chi2_reduced']:.3g}"
    )
    geometry, agreement = facts["geometry"], facts["agreement"]
    for parameter in ("centre_x", "centre_y", "distance", "baseline_x", "baseline_y", "baseline_z"):
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
