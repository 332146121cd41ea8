"""``pixcal run``, the commands of one stage each, those that use the maps, and ``simulate``."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pixcal.model import options
from pixcal.model.errors import InputError
from pixcal_cli import diagnosis_results, results
from pixcal_cli.click_options import (
    PATH,
    acquisition_argument,
    bench_argument,
    command,
    out_run_option,
    run_argument,
)
from pixcal_cli.results import perform

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


def step(kind: type, *examples: str) -> click.Command:
    """A command of RUN that runs one stage and prints its results."""
    name = kind.__name__.lower()

    def body(run: Path, config: Any, runtime: "Runtime") -> None:
        perform(name, run / name, run, config, runtime)
        getattr(results, f"show_{name}")(run)

    return command(kind, *examples)(body)


FROM_ACQUISITION = (acquisition_argument, out_run_option)


@command(options.Run, "pixcal run data_samples/demo --out demo", arguments=FROM_ACQUISITION)
def run(acquisition: Path, run: Path, config: options.Run, runtime: "Runtime") -> None:
    """All steps."""
    from pixcal.stages import whole_run  # here: for a fast `pixcal --help`

    done = whole_run.run(acquisition, run, config, runtime, results.announce, click.echo)
    results.show_run(run, *done)


@command(
    options.Ingest,
    "pixcal ingest data_samples/demo --out demo",
    "pixcal ingest data_samples/demo --out demo --copy --cubes s3://bucket/cubes",
    arguments=FROM_ACQUISITION,
)
def ingest(acquisition: Path, run: Path, config: options.Ingest, runtime: "Runtime") -> None:
    """From ACQ to RUN."""
    perform("ingest", run / "ingest", acquisition, run, config, runtime)
    results.show_ingest(run)


reduce = step(options.Reduce, "pixcal reduce demo", "pixcal reduce demo --gain measured")


@command(
    options.Fit,
    "pixcal fit demo",
    "pixcal fit demo --model hyperbolic",
    "pixcal fit demo --with-diagnosis",
)
def fit(run: Path, config: options.Fit, runtime: "Runtime") -> None:
    """The fit, and on demand its correction."""
    if config.with_diagnosis:
        with results.announce("corrected", run / "corrected"):
            perform("correct", run / "fit", run, config, runtime, label="fit")
    else:
        perform("fit", run / "fit", run, config, runtime)
    results.show_fit(run)
    if config.with_diagnosis:
        diagnosis_results.show_correction(run)


allan = step(options.Allan, "pixcal allan demo", "pixcal allan demo --region 0:64,0:64")

crests = step(options.Crests, "pixcal crests demo", "pixcal crests demo --frames 1 --paths 4")


def effect_list(text: str) -> tuple[str, ...]:
    """Names of effects, comma-separated; InputError if there are none."""
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise InputError(
            f"--effects {text!r:.80}: names no effect; give names separated by commas, or "
            "omit the option for all effects"
        )
    return names


effects_option = click.option(
    "--effects",
    "chosen",
    type=effect_list,
    metavar="NAMES",
    help="Candidate effects, comma-separated; -NAME leaves one out. [default: all]",
)


@command(
    options.Diagnose,
    "pixcal diagnose demo",
    "pixcal diagnose demo --effects lag,ipc",
    "pixcal diagnose demo --effects=-telegraph_noise --own my_effect.py",
    arguments=(run_argument, effects_option),
)
def diagnose(
    run: Path, chosen: tuple[str, ...] | None, config: options.Diagnose, runtime: "Runtime"
) -> None:
    """The diagnosis, with the effects to consider."""
    only = tuple(name for name in chosen or () if not name.startswith("-"))
    without = tuple(name[1:] for name in chosen or () if name.startswith("-"))
    config = replace(config, only=only, without=without)
    perform("diagnose", run / "diagnose", run, config, runtime)
    diagnosis_results.show_advice(run)
    diagnosis_results.show_diagnosis(run)


astrometry = step(
    options.Astrometry,
    "pixcal astrometry demo --truth data_samples/demo-truth",
    "pixcal astrometry demo --diameter 2.4 --focal-length 57.6 --electrons 1e6",
)


@command(
    options.Centroids,
    "pixcal centroids demo stars.csv --out corrected.csv --fwhm 2.5",
    "pixcal centroids demo sex.fits --x X_IMAGE --y Y_IMAGE --origin 1 --fwhm 3 --out out.fits",
    arguments=(run_argument, click.argument("table", metavar="TABLE", type=PATH)),
    tasks=False,
)
def centroids(run: Path, table: Path, config: options.Centroids) -> None:
    """The centroids of TABLE."""
    import numpy as np  # here: for a fast `pixcal --help`

    from pixcal.stages import centroids as stage

    corrected = stage.correct_table(run, table, config)
    good = np.isfinite(corrected.place[:, 0])
    click.echo(
        f"{click.format_filename(config.out)}: {int(good.sum())} of {len(good)} centroids corrected"
    )
    if good.any():
        added = np.sqrt((corrected.error[good] ** 2).mean(axis=0))
        click.echo(f"  map errors add {added[0]:.2g} px rms in x, {added[1]:.2g} px in y")
    if not good.all():
        click.echo("  note: the others are off the detector or too close to masked pixels: NaN")


@command(
    options.Wcs,
    "pixcal wcs demo --out distortion.fits",
    "pixcal wcs demo --out stars.fits --fwhm 2.5",
    tasks=False,
)
def wcs(run: Path, config: options.Wcs) -> None:
    """The maps of RUN."""
    from pixcal.stages import centroids as stage  # here: for a fast `pixcal --help`

    stage.write_wcs(run, config)
    click.echo(f"{click.format_filename(config.out)}: written")


@command(
    options.Electrons,
    "pixcal electrons demo night/*.fits --out reduced",
    arguments=(
        run_argument,
        click.argument("files", metavar="FILES...", nargs=-1, required=True, type=PATH),
    ),
    tasks=False,
)
def electrons(run: Path, files: tuple[Path, ...], config: options.Electrons) -> None:
    """The frames of FILES."""
    from pixcal.stages import electrons as stage  # here: for a fast `pixcal --help`

    written = stage.run(run, files, config)
    count = len(written.files)
    click.echo(
        f"{click.format_filename(config.out)}: {count} frame{'s' * (count > 1)} in electrons"
    )
    if written.removed:
        click.echo(f"  removed: {', '.join(written.removed)}")
    if written.left:
        click.echo(f"  note: single frames cannot be corrected for {', '.join(written.left)}")


report = step(options.Report, "pixcal report demo")

acquisition_option = click.option(
    "--out",
    "acquisition",
    metavar="ACQ",
    required=True,
    type=PATH,
    help="Directory of the acquisition; created if missing.",
)


@command(
    options.Simulate,
    "pixcal simulate configs/demo.yaml --out acquisition",
    "pixcal simulate bench.yaml --out acquisition --own glow.py",
    arguments=(bench_argument, acquisition_option),
)
def simulate(bench: Path, acquisition: Path, config: options.Simulate, runtime: "Runtime") -> None:
    """From BENCH.yaml to ACQ."""
    perform("simulate", acquisition, bench, acquisition, config, runtime)
    results.show_simulate(acquisition)
