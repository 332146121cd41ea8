"""``pixcal run``, its steps one by one, and ``pixcal simulate``.

Stages are imported where they are called: for a fast ``pixcal --help``.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pixcal.model import options
from pixcal.model.errors import InputError
from pixcal_cli import results
from pixcal_cli.click_options import (
    PATH,
    Command,
    acquisition_argument,
    bench_argument,
    command,
    config_options,
    examples,
    out_run_option,
    run_argument,
    runtime_options,
)

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


def from_acquisition(body: Command) -> Command:
    """Of commands that make RUN from ACQ."""
    return acquisition_argument(out_run_option(body))


def out_acquisition_option(body: Command) -> Command:
    """Of the command that makes ACQ."""
    out = click.option(
        "--out",
        "acquisition",
        metavar="ACQ",
        required=True,
        type=PATH,
        help="Directory of the acquisition; created if missing.",
    )
    return bench_argument(out(body))


@command(options.Run, "pixcal run data_samples/demo --out demo", argument=from_acquisition)
def run(acquisition: Path, run: Path, config: options.Run, runtime: "Runtime") -> None:
    """Run all steps, from the acquisition ACQ to the report in RUN."""
    from pixcal.stages import chain

    done = chain.run(acquisition, run, config, runtime, results.announce, click.echo)
    results.show_run(run, fitted=done.fitted, diagnosed=done.diagnosed)


@command(
    options.Ingest,
    "pixcal ingest data_samples/demo --out demo",
    "pixcal ingest data_samples/demo --out demo --copy --cubes s3://bucket/cubes",
    argument=from_acquisition,
)
def ingest(acquisition: Path, run: Path, config: options.Ingest, runtime: "Runtime") -> None:
    """Check and catalogue every frame of the acquisition ACQ.

    ACQ is a directory with acquisition.yaml and FITS files. Later steps read these files where they
    are; only compressed ones are copied into cubes.
    """
    from pixcal.stages import ingest as stage

    with results.announce("ingest", run / "ingest"):
        stage.run(acquisition, run, config, runtime)
    results.show_ingest(run)


@command(options.Reduce, "pixcal reduce demo", "pixcal reduce demo --gain measured")
def reduce(run: Path, config: options.Reduce, runtime: "Runtime") -> None:
    """Measure the detector and write the fringes in electrons.

    Bias, dark, flat, gain, read noise and bad pixels come from the detector frames; the fringe
    frames become cubes in electrons.
    """
    from pixcal.stages import reduce as stage

    with results.announce("reduce", run / "reduce"):
        stage.run(run, config, runtime)
    results.show_reduce(run)


@command(
    options.Fit,
    "pixcal fit demo",
    "pixcal fit demo --model hyperbolic",
    "pixcal fit demo --with-diagnosis",
)
def fit(run: Path, config: options.Fit, runtime: "Runtime") -> None:
    """Fit the fringes and write the maps of pixel offsets."""
    from pixcal.stages import correct
    from pixcal.stages import fit as stage

    if config.with_diagnosis:
        with results.announce("corrected", run / "corrected"), results.announce("fit", run / "fit"):
            correct.run(run, config, runtime)
    else:
        if config.own:
            raise click.UsageError("--own needs --with-diagnosis; give both")
        with results.announce("fit", run / "fit"):
            stage.run(run, config, runtime)
    results.show_fit(run)
    if config.with_diagnosis:
        results.show_correction(run)


@command(options.Allan, "pixcal allan demo", "pixcal allan demo --region 0:64,0:64")
def allan(run: Path, config: options.Allan, runtime: "Runtime") -> None:
    """Measure how the error falls with the number of frames (Allan deviation)."""
    from pixcal.stages import allan as stage

    with results.announce("allan", run / "allan"):
        stage.run(run, config, runtime)
    results.show_allan(run)


def effect_list(text: str) -> tuple[str, ...]:
    """Names of effects, comma-separated.

    Raises
    ------
    InputError
        If there are none: without the option every effect is a candidate.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise InputError(
            f"--effects {text!r:.80}: names no effect; give names separated by commas, or "
            "omit the option for all effects"
        )
    return names


@click.command(
    epilog=examples(
        "pixcal diagnose demo",
        "pixcal diagnose demo --effects lag,ipc",
        "pixcal diagnose demo --effects=-telegraph_noise --own my_effect.py",
    )
)
@run_argument
@click.option(
    "--effects",
    "chosen",
    type=effect_list,
    metavar="NAMES",
    help="Candidate effects, comma-separated; -NAME leaves one out. [default: all]",
)
@config_options(options.Diagnose)
@runtime_options
def diagnose(
    run: Path, chosen: tuple[str, ...] | None, config: options.Diagnose, runtime: "Runtime"
) -> None:
    """Find where data and simulation differ, which effect causes it, and the residual gap."""
    from pixcal.stages import diagnose as stage

    only = tuple(name for name in chosen or () if not name.startswith("-"))
    without = tuple(name[1:] for name in chosen or () if name.startswith("-"))
    with results.announce("diagnose", run / "diagnose"):
        stage.run(run, replace(config, only=only, without=without), runtime)
    results.show_advice(run)
    results.show_diagnosis(run)


@command(options.Report, "pixcal report demo")
def report(run: Path, config: options.Report, runtime: "Runtime") -> None:
    """Write the report of a run, one self-contained HTML page."""
    from pixcal.stages import report as stage

    with results.announce("report", run / "report"):
        stage.run(run, config, runtime)
    results.show_report(run)


@command(
    options.Simulate,
    "pixcal simulate configs/demo.yaml --out acquisition",
    "pixcal simulate bench.yaml --out acquisition --own glow.py",
    argument=out_acquisition_option,
)
def simulate(bench: Path, acquisition: Path, config: options.Simulate, runtime: "Runtime") -> None:
    """Simulate a bench and write an acquisition.

    BENCH.yaml describes detector, optics and frames. ACQ receives the FITS files that the camera of
    the bench would have written.
    """
    from pixcal.stages import simulate as stage

    with results.announce("simulate", acquisition):
        stage.run(bench, acquisition, config, runtime)
    results.show_simulate(acquisition)
