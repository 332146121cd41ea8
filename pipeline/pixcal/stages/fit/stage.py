"""Offsets from the sweep's phases: a shape for each set, modes removed, sets joined, products."""

from functools import partial
from pathlib import Path

from pixcal import __version__
from pixcal.engine.run import Runtime
from pixcal.model.config import result_options
from pixcal.model.options import Fit as Config
from pixcal.stages.fit import sweep
from pixcal.stages.fit.fringe_set import describe, fit_sets
from pixcal.stages.fit.maps import write_maps
from pixcal.stages.fit.products import publish, published
from pixcal.stages.fit.sweep import load_run
from pixcal.storage.artefact import Build
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import Manifest, write_json
from pixcal.storage.stage import make, require, working


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Fit every fringe set of a run and write the offset maps.

    Reads ``RUN/reduce``; makes ``RUN/sweep`` (when it is not up to date) and ``RUN/fit``, and
    writes the products ``delta_x.fits``, ``delta_y.fits`` (with one fringe axis:
    ``delta_fringe.fits``) and ``fit.json``.
    """
    with working(run_dir, "reduce"):
        swept = sweep.run(run_dir, config, runtime)
        body = partial(_fit_all, run_dir, swept, config, runtime)
        return make(
            run_dir,
            STAGES["fit"],
            result_options(config),
            {"sweep": swept.key},
            body,
            publish=lambda: publish(run_dir),
            published=lambda: published(run_dir),
        )


def _fit_all(run_dir: Path, swept: Manifest, config: Config, runtime: Runtime, made: Build) -> None:
    acquisition = load_run(run_dir)
    cubes = run_dir / "reduce" / "reduced.zarr"
    fitted = fit_sets(run_dir / "sweep", cubes, swept.summary["sets"], acquisition, config.model)
    totals = write_maps(made.folder / "fit.zarr", fitted, runtime)
    result = {
        "schema": "pixcal/fit/1",
        "pixcal": __version__,
        "input": require(run_dir, "ingest").key,
        "model": config.model,
        "sets": {
            f.name: describe(f, totals.sets[f.name].masked, totals.sets[f.name].sigma_px)
            for f in fitted
        },
        "outputs": list(totals.outputs),
        "sets_chi2_reduced": totals.consistency,
    }
    write_json(made.folder / "fit.json", result)
    made.summary = result
