"""Offsets from the sweep's phases: geometry, removed modes, combination of sets, products."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal import __version__
from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.combine import axes_span_plane, combine_parallel, combine_sets
from pixcal.estimators.geometry import TilePlane, tile_plane, unwrap, unwrapped_phase
from pixcal.estimators.modes import ModeBasis, mode_sums, solve_modes
from pixcal.model.config import quantity
from pixcal.model.flags import PixelFlag
from pixcal.stages import sweep
from pixcal.stages.reduced_set import ReducedSet
from pixcal.stages.sweep import load_run, read_frames
from pixcal.storage.artefact import (
    Build,
    Manifest,
    artefact_key,
    build,
    lock,
    read_json,
    require,
    up_to_date,
    write_json,
)
from pixcal.storage.cube import ArrayReader, ArrayWriter, create_array, create_group, write_array
from pixcal.storage.products import Card, write_map

FORMAT = 1
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Config:
    """Options of the fit."""

    model: str = quantity("paraxial", choices=("paraxial",), doc="shape of the fringes")
    batch_frames: int | None = quantity(
        None, low=4, unit="frames", doc="frames of an Allan batch (500, or fewer in a short run)"
    )
    chi2_limit: float = quantity(
        1.5, above=1.0, doc="pixels with a reduced chi-square above are flagged BAD_FIT"
    )


@dataclass(frozen=True)
class SweptSet:
    """A set's maps of the sweep, tile by tile."""

    sweep: Path
    source: ReducedSet
    noise: float
    chi2_limit: float

    def map(self, name: str, at: tuple[int, int]) -> F32:
        """One map on a tile."""
        y, x = self.source.ranges(at)
        return ArrayReader(self.sweep / name).read(y, x)

    def flags(self, at: tuple[int, int]) -> NDArray[np.uint8]:
        """Flags of a tile's pixels, those of the fit included."""
        mask = self.source.mask(at)
        sigma, chi2 = self.map("sigma", at), self.map("chi2", at)
        count, iota = self.map("count", at), self.map("iota", at)
        mask[count == 0] |= np.uint8(PixelFlag.NO_DATA)
        # Chance alone gives a scatter of sqrt(2 / n) to a reduced chi-square.
        chance = 8 * np.sqrt(2 / np.maximum(count - 3, 1))
        good_fit = np.isfinite(sigma) & (
            chi2 / self.noise < np.maximum(self.chi2_limit, 1 + chance)
        )
        good_fit &= (iota > 0) & (sigma < 0.5)
        mask[~good_fit] |= np.uint8(PixelFlag.BAD_FIT)
        return mask


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Fit every fringe set of a run and write the offset maps.

    Reads ``RUN/reduce``; makes ``RUN/sweep`` (when it is not up to date) and ``RUN/fit``, and
    writes the products ``delta_x.fits``, ``delta_y.fits`` (with one fringe axis:
    ``delta_fringe.fits``) and ``fit.json``.

    Raises
    ------
    InputError
        If reduce has not been run, or the frames hold no fringes that can be fitted.
    """
    require(run_dir, "reduce", 1)
    with lock(run_dir):
        swept = sweep.run(run_dir, sweep.Config(config.batch_frames), runtime)
        inputs = {"sweep": swept.key}
        key = artefact_key("fit", FORMAT, asdict(config), inputs)
        if (ready := up_to_date(run_dir, "fit", key)) is not None:
            return ready
        with build(run_dir, "fit", FORMAT, asdict(config), inputs) as made:
            made.summary = _fit_all(run_dir, made, swept, config, runtime)
        _publish(run_dir)
        return require(run_dir, "fit", FORMAT)


def _fit_all(
    run_dir: Path, made: Build, swept: Manifest, config: Config, runtime: Runtime
) -> dict[str, Any]:
    acquisition, _ = load_run(run_dir)
    create_group(made.folder / "fit.zarr")
    sets = {}
    for fringe_set in acquisition.frames.fringes:
        name = fringe_set.name
        source = ReducedSet(run_dir / "reduce" / "reduced.zarr" / name)
        sets[name] = _fit_set(
            made.folder / "fit.zarr" / name, run_dir, source, name, swept, config, runtime
        )
    combined = _combine(made.folder, run_dir, sets, runtime)
    result = {
        "schema": "pixcal/fit/1",
        "pixcal": __version__,
        "input": require(run_dir, "ingest", 1).key,
        "model": config.model,
        "sets": sets,
        **combined,
    }
    write_json(made.folder / "fit.json", result)
    return result


def _fit_set(
    folder: Path,
    run_dir: Path,
    source: ReducedSet,
    name: str,
    swept: Manifest,
    config: Config,
    runtime: Runtime,
) -> dict[str, Any]:
    facts = swept.summary["sets"][name]
    maps = run_dir / "sweep" / "sweep.zarr" / name
    tiles = list(product(*map(range, source.grid)))
    n_batches = len(ArrayReader(maps / "batch_count").read())
    pixels = int(np.prod(source.signal.chunks[1:]))
    plan = make_plan(f"the fit of {name}", pixels * (400 + 24 * n_batches), 0, runtime)
    runtime = runtime.with_workers(plan.workers)

    chi2 = run_tasks(partial(_noise_task, maps, source), tiles, runtime, label=f"noise {name}")
    every = np.concatenate(chi2) if chi2 else np.zeros(0)
    freedom = max(source.n_frames - 3, 1)
    # Median of a reduced chi-square by Wilson and Hilferty's cube.
    noise = float(np.median(every) / (1 - 2 / (9 * freedom)) ** 3) if len(every) else 1.0
    swept_set = SweptSet(maps, source, noise, config.chi2_limit)

    planes = run_tasks(partial(_plane_task, swept_set), tiles, runtime, label=f"geometry {name}")
    planes = unwrap(planes, source.grid)
    k0 = (float(facts["k"][0]), float(facts["k"][1]))
    reference = (float(facts["reference"][0]), float(facts["reference"][1]))
    basis = ModeBasis(k0, reference, max(source.shape) / 2)
    jobs = list(zip(tiles, planes, strict=True))
    sums = run_tasks(
        partial(_modes_task, swept_set, basis, n_batches), jobs, runtime, label=f"modes {name}"
    )
    normal = np.sum([s[0] for s in sums], axis=0)
    right = np.sum([s[1] for s in sums], axis=0)
    square, weight = sum(s[2] for s in sums), sum(s[3] for s in sums)
    coefficients = solve_modes(normal, right)
    kx = k0[0] + float(coefficients[1, 0]) / basis.scale
    ky = k0[1] + float(coefficients[2, 0]) / basis.scale
    k = float(np.hypot(kx, ky))

    writers = _create_outputs(folder, source, n_batches)
    scale = np.sqrt(noise)
    run_tasks(
        partial(_write_task, swept_set, basis, coefficients, k, scale, writers),
        jobs,
        runtime,
        label=f"maps {name}",
    )
    for writer in writers.values():
        writer.finish()
    frames = read_frames(maps)
    for array, data in (
        ("B", frames.B), ("A", frames.A), ("phi", frames.phi), ("dkx", frames.dk[:, 0]),
        ("dky", frames.dk[:, 1]), ("time", ArrayReader(maps / "time").read()),
    ):  # fmt: skip
        write_array(folder / array, data, dims=("time",))
    for array in ("batch_time", "batch_count"):
        write_array(folder / array, ArrayReader(maps / array).read(), dims=("batch",))

    sigma, mask = ArrayReader(folder / "sigma").read(), ArrayReader(folder / "mask").read()
    good = mask == 0
    residual = (square - coefficients[:, 0] @ right[:, 0]) / max(weight, 1e-300)
    covariance = np.linalg.pinv(normal / weight) * residual / max(int(good.sum()), 1)
    ratio = np.median([p.ratio for p in planes if np.isfinite(p.sigma)] or [np.nan])
    return {
        "model": config.model,
        "frames": source.n_frames,
        "pixels": int(good.size),
        "pixels_masked": int((~good).sum()),
        "interfringe_px": 2 * np.pi / k,
        "geometry": {
            "kx_rad_per_px": kx,
            "ky_rad_per_px": ky,
            "kx_sigma": float(np.sqrt(covariance[1, 1])) / basis.scale,
            "ky_sigma": float(np.sqrt(covariance[2, 2])) / basis.scale,
            "nominal_kx_rad_per_px": facts["nominal_k"][0],
            "nominal_ky_rad_per_px": facts["nominal_k"][1],
        },
        "kx": kx,
        "ky": ky,
        "phase_at_origin_rad": float(
            np.remainder(coefficients[0, 0] - kx * reference[1] - ky * reference[0], 2 * np.pi)
        ),
        "axis": [kx / k, ky / k],
        "visibility": float(1 / ratio),
        "sigma_median_px": float(np.median(sigma[good])) if good.any() else None,
        "crb_median_px": None if facts["bound_rad"] is None else facts["bound_rad"] / k,
        "chi2_reduced": noise,
        "sigma_scale": float(scale),
        "fringe_vector_moves": facts["moving"],
        "iterations": 1,
        "passes": facts["chunks_read"] / facts["chunks"],
        "chunks_read": facts["chunks_read"],
        "chunks": facts["chunks"],
        "batch_frames": facts["batch_frames"],
        "batch_period_s": facts["batch_period_s"],
        "batch_note": facts["batch_note"],
        "removed_modes": list(basis.names),
    }


def _noise_task(maps: Path, source: ReducedSet, at: tuple[int, int]) -> F32:
    """Reduced chi-squares of the pixels that the reduction finds good (every n-th of many)."""
    y, x = source.ranges(at)
    chi2 = ArrayReader(maps / "chi2").read(y, x)
    values = chi2[(source.mask(at) == 0) & np.isfinite(chi2)]
    return np.asarray(values[:: max(1, len(values) // 4000)])


def _plane_task(swept_set: SweptSet, at: tuple[int, int]) -> TilePlane:
    good = swept_set.flags(at) == 0
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = swept_set.map("iota", at) / swept_set.map("alpha", at)
    y, x = swept_set.source.ranges(at)
    centre = ((y[0] + y[1] - 1) / 2, (x[0] + x[1] - 1) / 2)
    return tile_plane(swept_set.map("phase", at), swept_set.map("sigma", at), ratio, good, centre)


def _tile_phases(
    swept_set: SweptSet, plane: TilePlane, at: tuple[int, int]
) -> tuple[F64, F64, NDArray[np.uint8]]:
    """Unwrapped phases, weights (zero where masked) and flags of a tile."""
    flags = swept_set.flags(at)
    sigma = swept_set.map("sigma", at).astype(float)
    phase = unwrapped_phase(swept_set.map("phase", at), plane)
    good = (flags == 0) & np.isfinite(phase)
    weight = np.where(good, 1 / np.where(good, sigma, 1.0) ** 2, 0.0)
    return phase, weight, flags


def _batch_phases(swept_set: SweptSet, at: tuple[int, int], n_batches: int) -> F64:
    """Phases (batch, y, x) of the batches relative to the whole run; zero in gaps."""
    if not n_batches:
        return np.zeros((0, *swept_set.source.tile(at).shape))
    y, x = swept_set.source.ranges(at)
    phases = ArrayReader(swept_set.sweep / "batch_phase").read((0, n_batches), y, x)
    return np.asarray(np.nan_to_num(phases.astype(float)))


def _modes_task(
    swept_set: SweptSet,
    basis: ModeBasis,
    n_batches: int,
    job: tuple[tuple[int, int], TilePlane],
) -> tuple[F64, F64, float, float]:
    at, plane = job
    phase, weight, _ = _tile_phases(swept_set, plane, at)
    modes = basis.on(plane, (phase.shape[0], phase.shape[1]))
    maps = np.concatenate([phase[None], _batch_phases(swept_set, at, n_batches)])
    normal, right = mode_sums(modes, weight, maps)
    square = float((weight * np.where(weight > 0, phase, 0.0) ** 2).sum())
    return normal, right, square, float(weight.sum())


def _create_outputs(folder: Path, source: ReducedSet, n_batches: int) -> dict[str, ArrayWriter]:
    create_group(folder)
    (cy, cx), shape = source.signal.chunks[1:], source.shape
    units = {"delta": "pixel", "sigma": "pixel", "iota": "electron", "alpha": "electron"}
    writers = {}
    for name in ("delta", "sigma", "iota", "alpha", "chi2"):
        writers[name] = create_array(
            folder / name, shape, "<f4", dims=("y", "x"), chunks=(cy, cx), fill_value=np.nan,
            attrs={"units": units.get(name, "1")},
        )  # fmt: skip
    writers["mask"] = create_array(folder / "mask", shape, "u1", dims=("y", "x"), chunks=(cy, cx))
    for name in ("batch_delta", "batch_sigma") if n_batches else ():
        writers[name] = create_array(
            folder / name, (n_batches, *shape), "<f4", dims=("batch", "y", "x"),
            chunks=(n_batches, cy, cx), fill_value=np.nan, attrs={"units": "pixel"},
        )  # fmt: skip
    return writers


def _write_task(
    swept_set: SweptSet,
    basis: ModeBasis,
    coefficients: F64,
    k: float,
    scale: float,
    writers: dict[str, ArrayWriter],
    job: tuple[tuple[int, int], TilePlane],
) -> None:
    at, plane = job
    phase, _, flags = _tile_phases(swept_set, plane, at)
    modes = basis.on(plane, (phase.shape[0], phase.shape[1]))
    (y, _), (x, _) = swept_set.source.ranges(at)
    bad = flags != 0
    rest = phase - np.tensordot(coefficients[:, 0], modes, 1)
    writers["delta"].write((y, x), np.where(bad, np.nan, rest / k).astype(np.float32))
    sigma = swept_set.map("sigma", at) * (scale / k)
    writers["sigma"].write((y, x), np.where(bad, np.nan, sigma).astype(np.float32))
    for name in ("iota", "alpha", "chi2"):
        writers[name].write((y, x), swept_set.map(name, at))
    writers["mask"].write((y, x), flags)
    if "batch_delta" not in writers:
        return
    ranges = swept_set.source.ranges(at)
    n_batches = writers["batch_delta"].shape[0]
    for source, name in (("batch_phase", "batch_delta"), ("batch_sigma", "batch_sigma")):
        values = ArrayReader(swept_set.sweep / source).read((0, n_batches), *ranges)
        out = values / k if name == "batch_delta" else values * (scale / k)
        if name == "batch_delta":
            out = out + (rest - np.tensordot(coefficients[:, 1:].T, modes, 1)) / k
        writers[name].write((0, y, x), np.where(bad, np.nan, out).astype(np.float32))


def _combine(folder: Path, run_dir: Path, sets: dict[str, Any], runtime: Runtime) -> dict[str, Any]:
    """Join the sets into delta_x and delta_y, or delta_fringe where all axes are the same."""
    names = list(sets)
    axes = [tuple(sets[n]["axis"]) for n in names]
    both = axes_span_plane(axes)
    outputs = ("delta_x", "delta_y") if both else ("delta_fringe",)
    source = ReducedSet(run_dir / "reduce" / "reduced.zarr" / names[0])
    (cy, cx), shape = source.signal.chunks[1:], source.shape
    group = folder / "fit.zarr"
    writers = {}
    for name in outputs:
        for array in (name, f"{name}_sigma"):
            writers[array] = create_array(
                group / array, shape, "<f4", dims=("y", "x"), chunks=(cy, cx), fill_value=np.nan,
                attrs={"units": "pixel"},
            )  # fmt: skip
    writers["mask"] = create_array(group / "mask", shape, "u1", dims=("y", "x"), chunks=(cy, cx))
    tiles = list(product(*map(range, source.grid)))
    chi2 = run_tasks(
        partial(_combine_task, group, source, names, axes, both, writers),
        tiles,
        runtime,
        label="combine sets",
    )
    for writer in writers.values():
        writer.finish()
    freedom = len(names) - (2 if both else 1)
    every = np.concatenate(chi2)
    consistency = float(every.mean() / freedom) if freedom > 0 and len(every) else None
    return {"outputs": list(outputs), "sets_chi2_reduced": consistency}


def _combine_task(
    group: Path,
    source: ReducedSet,
    names: Sequence[str],
    axes: Sequence[tuple[float, float]],
    both: bool,
    writers: dict[str, ArrayWriter],
    at: tuple[int, int],
) -> F64:
    y, x = source.ranges(at)

    def stack(array: str) -> NDArray[Any]:
        return np.stack([ArrayReader(group / n / array).read(y, x) for n in names])

    delta, sigma, masks = stack("delta"), stack("sigma"), stack("mask")
    solve = combine_sets if both else combine_parallel
    value, error, chi2 = solve(axes, delta.astype(float), sigma.astype(float))
    outputs = ("delta_x", "delta_y") if both else ("delta_fringe",)
    value, error = (
        value.reshape(len(outputs), *chi2.shape),
        error.reshape(len(outputs), *chi2.shape),
    )
    missing = ~np.isfinite(value).all(axis=0)
    # A flag counts where it costs the pixel its value; a set that others replace does not.
    flags = np.where(missing, np.bitwise_or.reduce(masks, axis=0), 0).astype(np.uint8)
    for n, name in enumerate(outputs):
        writers[name].write((y[0], x[0]), value[n].astype(np.float32))
        writers[f"{name}_sigma"].write((y[0], x[0]), error[n].astype(np.float32))
    writers["mask"].write((y[0], x[0]), flags)
    return np.asarray(chi2[~missing])


def _publish(run_dir: Path) -> None:
    """Write the products of a complete fit."""
    folder = run_dir / "fit"
    result = read_json(folder / "fit.json")
    cards: list[Card] = [
        ("PIXCALID", read_json(folder / "manifest.json")["key"], "key of the fit"),
        ("INDIGEST", result["input"], "digest of the acquisition"),
        ("MODEL", result["model"], "shape of the fringes"),
        ("NSETS", len(result["sets"]), "fringe sets used"),
    ]
    history = []
    for n, (name, facts) in enumerate(result["sets"].items(), start=1):
        cards += [
            (f"SET{n}", name, "name of the fringe set"),
            (f"NFRAME{n}", facts["frames"], "frames used"),
            (f"KX{n}", facts["kx"], "[rad/px] fringe vector along x"),
            (f"KY{n}", facts["ky"], "[rad/px] fringe vector along y"),
            (f"PSI{n}", facts["phase_at_origin_rad"], "[rad] fringe phase psi at x = y = 0"),
            (f"VIS{n}", facts["visibility"], "visibility, alpha / iota"),
            (f"NMODE{n}", len(facts["removed_modes"]), "modes removed from the set's map"),
        ]
        cards += [
            (f"M{n}_{m}", mode, "removed mode") for m, mode in enumerate(facts["removed_modes"], 1)
        ]
        history.append(f"set {name}: modes removed: {', '.join(facts['removed_modes'])}")
    mask = ArrayReader(folder / "fit.zarr" / "mask").read()
    for name in result["outputs"]:
        data = ArrayReader(folder / "fit.zarr" / name).read()
        sigma = ArrayReader(folder / "fit.zarr" / f"{name}_sigma").read()
        write_map(run_dir / "products" / f"{name}.fits", data, sigma, mask, cards, history)
    for other in {"delta_x", "delta_y", "delta_fringe"} - set(result["outputs"]):
        (run_dir / "products" / f"{other}.fits").unlink(missing_ok=True)
    write_json(run_dir / "products" / "fit.json", result)
