"""Crests and valleys: fibre positions independent of the fit (paper, section 6, figures 16, 17).

docs/reference/products-other.md describes ``crests.json``; ``crests.zarr/<set name>`` holds the
points and the maps.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal import __version__
from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.fringe_fit.shapes.hyperbolic import prior_errors
from pixcal.kernels.optics import paraxial_vector
from pixcal.model.arrays import F32, F64, Mask
from pixcal.model.config import result_options
from pixcal.model.errors import naming
from pixcal.model.options import Crests as Config
from pixcal.report.crest_figures import CrestView, Extract, crest_figure, outermost
from pixcal.report.drawing import png
from pixcal.stages.crests import crest_fit
from pixcal.stages.crests.crest_fit import CrestFit
from pixcal.stages.crests.crests import SEED_PIXELS, CrestPaths, find_crests, seed_vector
from pixcal.stages.crests.windows import N_SUMS, CrestCarrier, Vector, Windows, tile_sums
from pixcal.stages.fit.sweep import load_run
from pixcal.stages.fitted_shape import nominal_geometry
from pixcal.stages.reduced_set import ReducedSet
from pixcal.stages.tiles import Range
from pixcal.storage.artefact import Build
from pixcal.storage.cube import create_group, write_array
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import MANIFEST, Manifest, read_json, write_json
from pixcal.storage.stage import make, require, working

SCHEMA = "pixcal/crests/1"
MAP_SIDE = 21  # places along each side of a cost map; odd, so that the minimum is one of them
MAP_REACH = 0.04  # how far the maps go from the minimum, as a share of distance and baseline
FIGURE_BYTES = 128 << 20  # Matplotlib and one figure


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Locate the fibres from crests and valleys, and compare them with the fit if there is one."""
    acquisition = load_run(run_dir, "crests")
    with working(run_dir, "reduce") as inputs:
        facts: dict[str, Any] = {}
        if (run_dir / "fit" / MANIFEST).exists():
            inputs["fit"] = require(run_dir, "fit").key
            facts = read_json(run_dir / "fit" / "fit.json")["sets"]

        def body(made: Build) -> None:
            create_group(made.folder / "crests.zarr")
            sets = {}
            for name in (s.name for s in acquisition.frames.fringes):
                source = ReducedSet(run_dir / "reduce" / "reduced.zarr" / name)
                centre = ((source.shape[0] - 1) / 2, (source.shape[1] - 1) / 2)
                nominal = nominal_geometry(acquisition, name, centre)
                with naming(f"{run_dir}: fringe set {name!r}"):
                    frames, paths = _trace(source, paraxial_vector(nominal), config, runtime)
                    fit = crest_fit.fit_crests(paths, nominal, prior_errors(nominal))
                maps = _write_arrays(made.folder / "crests.zarr" / name, paths, fit)
                picture = crest_figure(_view(source, frames[0], paths, fit, maps))
                (made.folder / f"crests-{name}.png").write_bytes(png(picture))
                used = [n for n, phi in zip(frames, paths.phi, strict=True) if np.isfinite(phi)]
                agrees, note = crest_fit.agreement(paths, fit, facts.get(name))
                sets[name] = {"frames": used, **_facts(paths, fit, maps)}
                sets[name] |= {"agreement": agrees, "agreement_note": note}
            whole = {"schema": SCHEMA, "pixcal": __version__, "sets": sets}
            write_json(made.folder / "crests.json", whole)

        return make(run_dir, STAGES["crests"], result_options(config), inputs, body)


def _facts(paths: CrestPaths, fit: CrestFit, maps: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    costs = (maps["cost_baseline"], maps["cost_ratio"], maps["valley_cost"])
    return {
        "points": len(paths),
        "points_used": int(fit.used.sum()),
        "paths": len(np.unique(paths.k)),
        "interfringe_px": paths.interfringe,
        "segment_px": paths.segment,
        "point_sigma_median_px": float(np.median(paths.sigma_px)),
        "geometry": fit.geometry_facts(),
        "cost_rad2": fit.cost,
        "chi2_reduced": fit.chi2_reduced,
        "evaluations": fit.evaluations,
        "unique_minimum": all(crest_fit.falls_then_rises(cost) for cost in costs),
        "warnings": [*fit.warnings()],
    }


def _trace(
    source: ReducedSet, nominal: Vector, config: Config, runtime: Runtime
) -> tuple[list[int], CrestPaths]:
    """Numbers of some frames, and points on their crests and valleys."""
    name, count = source.folder.name, min(config.frames, source.n_frames)
    frames = np.unique(np.linspace(0, source.n_frames - 1, count).astype(int)).tolist()
    y, x = (((n - SEED_PIXELS) // 2, (n + SEED_PIXELS) // 2) for n in source.shape)
    k = seed_vector(*read_patch(source, frames[0], y, x), nominal)
    _, rows, columns = source.signal.chunks
    strips = [(at, at + rows) for at in range(0, source.shape[0], rows)]
    # A chunk, a strip of one frame with its mask; the sums, sums in transit, their solution.
    task = 2 * int(np.prod(source.signal.chunks)) + 16 * rows * (source.shape[1] + columns)
    held = 4 * 8 * N_SUMS * int(np.prod(Windows.lay(source.shape, k, config.segment).shape))
    runtime = within_memory(f"the crests of {name}", task, held + FIGURE_BYTES, runtime)

    def accumulate(frame: int, windows: Windows, carrier: CrestCarrier) -> F64:
        task = partial(_strip_task, source, frames[frame], windows, carrier)
        sums = np.zeros((*windows.shape, N_SUMS))
        # Added in the order of the strips, so that sums are equal to the last bit.
        for (i, j), part in run_tasks(task, strips, runtime, label=f"crests {name}"):
            sums[i : i + part.shape[0], j : j + part.shape[1]] += part
        return sums

    paths = find_crests(accumulate, len(frames), source.shape, k, config.segment)
    return frames, paths if config.paths is None else paths.outermost(config.paths)


def read_patch(source: ReducedSet, frame: int, y: Range, x: Range) -> tuple[F32, Mask]:
    """Electrons (y, x) of a part of one frame, and its good samples."""
    mask = ArrayReader(source.place / "mask").read(y, x)
    codes = source.signal.read((frame, frame + 1), y, x)[0]
    return source.coding.electrons(codes), (mask == 0) & (codes != source.coding.fill)


def _strip_task(
    source: ReducedSet, frame: int, windows: Windows, carrier: CrestCarrier, rows: Range
) -> tuple[tuple[int, int], F64]:
    signal, good = read_patch(source, frame, rows, (0, source.shape[1]))
    return tile_sums(signal, good, (rows[0], 0), windows, carrier)


def _write_arrays(folder: Path, paths: CrestPaths, fit: CrestFit) -> dict[str, NDArray[Any]]:
    """Write the points and the cost of figure 17 (held, refitted, its valley), and return them."""
    distance, length = fit.geometry.distance, float(np.hypot(*fit.geometry.vector()[3:5]))
    steps, middle = np.linspace(-1, 1, MAP_SIDE), length / distance
    distances = distance * (1 + MAP_REACH * steps)
    lengths = length * (1 + MAP_REACH * steps)
    best, cost = crest_fit.valley(paths, fit, distances)
    # Wide enough for the drift of the valley and for its walls.
    ratios = middle + max(2 * float(np.max(np.abs(best - middle))), 1e-5 * middle) * steps
    held = crest_fit.cost_map(paths, fit, distances, lengths, ratio=False, refit=False)
    refitted = crest_fit.cost_map(paths, fit, distances, ratios, ratio=True, refit=True)
    px, rad, mm, none = ({"units": unit} for unit in ("pixel", "rad", "mm", "1"))
    arrays: dict[str, tuple[str, dict[str, str], NDArray[Any]]] = {
        "x": ("point", px, paths.x),
        "y": ("point", px, paths.y),
        "k": ("point", none, paths.k),
        "sigma": ("point", rad, paths.sigma),
        "residual": ("point", rad, fit.residual),
        "used": ("point", none, fit.used.astype(np.uint8)),
        "distance": ("distance", mm, distances),
        "baseline": ("baseline", mm, lengths),
        "ratio": ("ratio", none, ratios),
        "cost_baseline": (
            "distance baseline",
            none | {"comment": "phase refitted, others held"},
            held,
        ),
        "cost_ratio": ("distance ratio", none | {"comment": "others refitted"}, refitted),
        "valley_ratio": ("distance", {}, best),
        "valley_cost": ("distance", {}, cost),
    }
    create_group(folder)
    for name, (dims, attrs, data) in arrays.items():
        write_array(folder / name, data, dims=dims.split(), attrs=attrs)
    return {name: data for name, (_, _, data) in arrays.items()}


def _view(
    source: ReducedSet, frame: int, paths: CrestPaths, fit: CrestFit, arrays: Mapping[str, Any]
) -> CrestView:
    best = fit.geometry
    first, last = outermost(paths.k)
    foot = np.array([best.centre_x, best.centre_y])
    half = np.array([best.baseline_x, best.baseline_y]) / 2
    return CrestView(
        name=source.folder.name,
        frame=paths.frame,
        direction=paths.vector,
        arrays=arrays,
        sigma_px=paths.sigma_px * np.sqrt(fit.spread),
        residual_px=fit.residual / paths.slope,
        fibres=((foot - half) / best.pitch, (foot + half) / best.pitch),
        extracts=tuple(_extract_at(source, frame, paths, k) for k in (first[0], last[-1])),
        best=(best.distance, 2 * float(np.hypot(*half))),
        distance_sigma=float(fit.sigma[2]),
        distance_from_prior=bool(fit.from_prior[2]),
    )


def _extract_at(source: ReducedSet, frame: int, paths: CrestPaths, k: int) -> Extract:
    """A few fringes of a frame, around the path point nearest its centre."""
    on = np.flatnonzero(paths.k == k)
    ry, rx = paths.reference
    near = on[np.argmin((paths.x[on] - rx) ** 2 + (paths.y[on] - ry) ** 2)]
    side = int(np.clip(max(8 * paths.interfringe, 1.7 * paths.segment), 32, 320))
    places = zip((paths.y[near], paths.x[near]), source.shape, strict=True)
    y, x = (int(np.clip(round(at) - side // 2, 0, max(0, n - side))) for at, n in places)
    values, good = read_patch(source, frame, (y, y + side), (x, x + side))
    return np.where(good, values, np.nan), (y, x)
