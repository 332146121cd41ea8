"""One fringe set: from the sweep's phases to the map of offsets along its axis."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.geometry import TilePlane, tile_plane, unwrap, unwrapped_phase
from pixcal.estimators.models import FringeShape, Start, fringe_models
from pixcal.estimators.modes import ModeBasis, mode_sums
from pixcal.estimators.smooth import Polynomial
from pixcal.model.acquisition import Acquisition
from pixcal.model.errors import InputError
from pixcal.model.flags import PixelFlag
from pixcal.stages.fit.sweep import read_frames
from pixcal.stages.reduced_set import ReducedSet
from pixcal.storage.cube import ArrayReader, ArrayWriter, create_array, create_group, write_array

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Job = tuple[tuple[int, int], TilePlane]

MAX_STEPS = 8
"""Gauss-Newton steps of a shape; it is nearly linear (physics note, section 4)."""
STEP_RAD = 1e-7
"""A step that moves phases by less, rms, is the last."""
EVIDENCE = 12.0
"""Fall in chi-square for which ``auto`` takes hyperbolic fringes: one chance in a hundred for three
terms. Taken in vain they cost three modes of the map; curvature missed stays in it whole."""
QUADRATIC = 3
"""Terms of second order, which is what hyperbolic fringes show first."""
RED = 2.5
"""Power at large scales over that at small ones beyond which the map has structure of its own."""
EXCESS = 50.0
"""Fall then asked of each term over that of terms of no cause: the power of steps falls with the
order of the term, and two stitches reach 15."""


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


@dataclass(frozen=True)
class SetFit:
    """A shape fitted to a set.

    Attributes
    ----------
    basis : ModeBasis
        The shape and the modes about it.
    coefficients : (mode, 1 + batch) float64
        What is left to take off the phases of the run and of each batch.
    covariance : (mode, mode) float64
        Of the shape's coefficients and the gauge's.
    square : float
        Weighted square of what remains of the map.
    spread : float
        The same for each pixel: variance of the map over that of its noise.
    steps : int
        Gauss-Newton steps taken.
    """

    basis: ModeBasis
    coefficients: F64
    covariance: F64
    square: float
    spread: float
    steps: int


def fit_set(
    folder: Path,
    maps: Path,
    source: ReducedSet,
    facts: dict[str, Any],
    acquisition: Acquisition,
    name: str,
    model: str,
    chi2_limit: float,
    runtime: Runtime,
) -> tuple[FringeShape, dict[str, Any]]:
    """Fit a set's shape, write its maps, and tell what ``fit.json`` says of it.

    Parameters
    ----------
    folder : Path
        ``fit.zarr/<set name>``, to be written.
    maps : Path
        ``sweep.zarr/<set name>``.
    source : ReducedSet
    facts : dict
        Summary of the set's sweep.
    acquisition : Acquisition
    name : str
        Of the set.
    model : str
        A shape's name, or ``auto``.
    chi2_limit : float
        Pixels with a reduced chi-square above are flagged.
    runtime : Runtime

    Raises
    ------
    InputError
        If no pixel of the set can be fitted.
    """
    tiles = source.tiles()
    n_batches = len(ArrayReader(maps / "batch_count").read())
    pixels = int(np.prod(source.signal.chunks[1:]))
    plan = make_plan(f"the fit of {name}", pixels * (600 + 40 * n_batches), 0, runtime)
    runtime = runtime.with_workers(plan.workers)

    every = np.concatenate(
        run_tasks(partial(_noise_task, maps, source), tiles, runtime, label=f"noise {name}")
    )
    freedom = max(source.n_frames - 3, 1)
    # Median of a reduced chi-square by Wilson and Hilferty's cube.
    noise = float(np.median(every) / (1 - 2 / (9 * freedom)) ** 3) if len(every) else 1.0
    swept = SweptSet(maps, source, noise, chi2_limit)
    planes = unwrap(
        run_tasks(partial(_plane_task, swept), tiles, runtime, label=f"phases {name}"),
        source.grid,
    )
    if not any(np.isfinite(p.sigma) for p in planes):
        raise InputError(
            f"fringe set {name!r}: no pixel can be fitted; its fringes are too faint for "
            f"{source.n_frames} frames, or the mask leaves no pixel"
        )
    jobs = list(zip(tiles, planes, strict=True))
    start = _start(source, facts, planes, acquisition, name)
    fitted, evidence = _choose(model, swept, start, jobs, n_batches, runtime, name)

    writers = _create_outputs(folder, source, n_batches)
    told = run_tasks(
        partial(_write_task, swept, fitted, writers), jobs, runtime, label=f"maps {name}"
    )
    for writer in writers.values():
        writer.finish()
    _write_frames(folder, maps)
    shape = fitted.basis.shape.moved(fitted.coefficients[: len(fitted.basis.shape.names), 0])
    facts = _describe(source, facts, planes, fitted, shape, noise, told)
    return shape, facts | {"model": _model_name(shape), "evidence": evidence}


def _model_name(shape: FringeShape) -> str:
    return next(name for name, cls in fringe_models().items() if isinstance(shape, cls))


def _start(
    source: ReducedSet,
    facts: dict[str, Any],
    planes: list[TilePlane],
    acquisition: Acquisition,
    name: str,
) -> Start:
    (baseline,) = (s.baseline_mm for s in acquisition.frames.fringes if s.name == name)
    return Start(
        k=(float(facts["k"][0]), float(facts["k"][1])),
        reference=(float(facts["reference"][0]), float(facts["reference"][1])),
        scale=max(source.shape) / 2,
        planes=planes,
        wavelength_mm=acquisition.optics.wavelength_nm * 1e-6,
        pitch_mm=acquisition.detector.pitch_um * 1e-3,
        distance_mm=acquisition.optics.distance_mm,
        baseline_mm=baseline,
    )


def _choose(
    model: str,
    swept: SweptSet,
    start: Start,
    jobs: list[Job],
    n_batches: int,
    runtime: Runtime,
    name: str,
) -> tuple[SetFit, str]:
    """Fit the shape asked for; ``auto`` takes hyperbolic fringes where the map asks for them.

    True offsets have structure of their own at large scales (stitches), which any richer shape
    takes for curvature. How much, a polynomial tells: what it finds beyond the hyperbolic shape is
    what curvature of no cause amounts to here.
    """
    shapes = fringe_models()

    def fit(shape: type[FringeShape], label: str, background: float = 1.0) -> SetFit:
        first = shape.start(start)
        return _fit_shape(swept, first, start, jobs, n_batches, runtime, label, background)

    if model != "auto":
        return fit(shapes[model], f"{model} {name}"), "asked for"
    straight = fit(shapes["paraxial"], f"paraxial {name}")
    smooth = fit(Polynomial, f"smooth {name}")
    most = (straight.square - smooth.square) / smooth.spread
    if most < EVIDENCE:
        return straight, f"no curvature: chi-square falls by {most:.0f} at most"
    exact = fit(shapes["hyperbolic"], f"hyperbolic {name}")
    gain = (straight.square - exact.square) / smooth.spread
    others = len(smooth.basis.names) - len(straight.basis.names) - QUADRATIC
    beyond = max(exact.square - smooth.square, 0.0) / smooth.spread / others
    background = max(1.0, beyond)
    needed = QUADRATIC * EXCESS * background if background > RED else EVIDENCE
    reason = (
        f"hyperbolic fringes lower chi-square by {gain:.0f}, {needed:.0f} are asked for where "
        f"large scales hold {background:.1f} times the power of small ones"
    )
    if gain <= needed:
        return straight, reason
    return fit(shapes["hyperbolic"], f"hyperbolic {name}", background), reason


def _fit_shape(
    swept: SweptSet,
    shape: FringeShape,
    start: Start,
    jobs: list[Job],
    n_batches: int,
    runtime: Runtime,
    label: str,
    background: float,
) -> SetFit:
    """Gauss-Newton steps of a shape on all pixels, and the gauge's modes with it."""
    size = len(shape.names)
    for steps in range(1, MAX_STEPS + 1):
        basis = ModeBasis(shape, start.k, start.reference)
        sums = run_tasks(partial(_modes_task, swept, basis, n_batches), jobs, runtime, label=label)
        normal = np.sum([s[0] for s in sums], axis=0)
        right = np.sum([s[1] for s in sums], axis=0)
        square, pixels = sum(s[2] for s in sums), max(sum(s[3] for s in sums), 1)
        free = np.linalg.lstsq(normal, right[:, 0], rcond=1e-12)[0]
        spread = background * max(1.0, float(square - free @ right[:, 0]) / pixels)
        c = basis.solve(normal, right, spread)
        own = c[:size, 0]
        moved = np.sqrt(
            abs(own @ normal[:size, :size] @ own) / max(np.trace(normal[:1, :1]), 1e-300)
        )
        if shape.linear or moved < STEP_RAD or steps == MAX_STEPS:
            break
        shape = shape.moved(own)
    rest = float(square - 2 * c[:, 0] @ right[:, 0] + c[:, 0] @ normal @ c[:, 0])
    return SetFit(basis, c, basis.covariance(normal, spread), rest, spread, steps)


def _describe(
    source: ReducedSet,
    facts: dict[str, Any],
    planes: list[TilePlane],
    fitted: SetFit,
    shape: FringeShape,
    noise: float,
    told: list[tuple[int, F32]],
) -> dict[str, Any]:
    ny, nx = source.shape
    kx, ky = shape.vector((ny - 1) / 2, (nx - 1) / 2)
    k = float(np.hypot(kx, ky))
    ratio = np.median([p.ratio for p in planes if np.isfinite(p.sigma)])
    own = len(shape.names)
    origin = float(shape.phase(np.zeros(1), np.zeros(1))[0])
    return {
        "frames": source.n_frames,
        "pixels": ny * nx,
        "pixels_masked": ny * nx - sum(good for good, _ in told),
        "interfringe_px": 2 * np.pi / k,
        "geometry": shape.facts(fitted.covariance[:own, :own]),
        "kx": kx,
        "ky": ky,
        "nominal_kx": facts["nominal_k"][0],
        "nominal_ky": facts["nominal_k"][1],
        "phase_at_origin_rad": float(np.remainder(origin, 2 * np.pi)),
        "axis": [kx / k, ky / k],
        "visibility": float(1 / ratio),
        "sigma_median_px": float(np.median(np.concatenate([some for _, some in told]))),
        "crb_median_px": None if facts["bound_rad"] is None else facts["bound_rad"] / k,
        "chi2_reduced": noise,
        "sigma_scale": float(np.sqrt(noise)),
        "fringe_vector_moves": facts["moving"],
        "iterations": fitted.steps,
        "passes": facts["chunks_read"] / facts["chunks"],
        "chunks_read": facts["chunks_read"],
        "chunks": facts["chunks"],
        "batch_frames": facts["batch_frames"],
        "batch_period_s": facts["batch_period_s"],
        "batch_note": facts["batch_note"],
        "removed_modes": list(fitted.basis.names),
    }


def _write_frames(folder: Path, maps: Path) -> None:
    """Parameters of every frame and the times of the batches, for those who read the fit."""
    frames = read_frames(maps)
    for array, data in (
        ("B", frames.B), ("A", frames.A), ("phi", frames.phi), ("dkx", frames.dk[:, 0]),
        ("dky", frames.dk[:, 1]), ("time", ArrayReader(maps / "time").read()),
    ):  # fmt: skip
        write_array(folder / array, data, dims=("time",))
    for array in ("batch_time", "batch_count"):
        write_array(folder / array, ArrayReader(maps / array).read(), dims=("batch",))


def _noise_task(maps: Path, source: ReducedSet, at: tuple[int, int]) -> F32:
    """Reduced chi-squares of the pixels that the reduction finds good (every n-th of many)."""
    y, x = source.ranges(at)
    chi2 = ArrayReader(maps / "chi2").read(y, x)
    return _some(chi2[(source.mask(at) == 0) & np.isfinite(chi2)])


def _some(values: F32) -> F32:
    """Every n-th of many values; a copy, lest they all stay in memory."""
    return values[:: max(1, len(values) // 4000)].copy()


def _plane_task(swept: SweptSet, at: tuple[int, int]) -> TilePlane:
    good = swept.flags(at) == 0
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = swept.map("iota", at) / swept.map("alpha", at)
    y, x = swept.source.ranges(at)
    centre = ((y[0] + y[1] - 1) / 2, (x[0] + x[1] - 1) / 2)
    return tile_plane(swept.map("phase", at), swept.map("sigma", at), ratio, good, centre)


def _tile_phases(
    swept: SweptSet, plane: TilePlane, at: tuple[int, int]
) -> tuple[F64, F64, NDArray[np.uint8]]:
    """Unwrapped phases, weights (zero where masked) and flags of a tile."""
    flags = swept.flags(at)
    sigma = swept.map("sigma", at).astype(float)
    phase = unwrapped_phase(swept.map("phase", at), plane)
    good = (flags == 0) & np.isfinite(phase)
    weight = np.where(good, 1 / np.where(good, sigma, 1.0) ** 2, 0.0)
    return phase, weight, flags


def _batch_phases(swept: SweptSet, at: tuple[int, int], n_batches: int) -> F64:
    """Phases (batch, y, x) of the batches relative to the whole run; zero in gaps."""
    if not n_batches:
        return np.zeros((0, *swept.source.tile(at).shape))
    y, x = swept.source.ranges(at)
    phases = ArrayReader(swept.sweep / "batch_phase").read((0, n_batches), y, x)
    return np.asarray(np.nan_to_num(phases.astype(float)))


def _modes_task(
    swept: SweptSet, basis: ModeBasis, n_batches: int, job: Job
) -> tuple[F64, F64, float, int]:
    at, plane = job
    phase, weight, _ = _tile_phases(swept, plane, at)
    modes, model = basis.on(plane, (phase.shape[0], phase.shape[1]))
    phase = phase - model
    maps = np.concatenate([phase[None], _batch_phases(swept, at, n_batches)])
    normal, right = mode_sums(modes, weight, maps)
    square = float((weight * np.where(weight > 0, phase, 0.0) ** 2).sum())
    return normal, right, square, int((weight > 0).sum())


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
    swept: SweptSet, fitted: SetFit, writers: dict[str, ArrayWriter], job: Job
) -> tuple[int, F32]:
    """Write the maps of a tile; the number of its good pixels, and errors (px) of some of them."""
    at, plane = job
    phase, _, flags = _tile_phases(swept, plane, at)
    modes, model = fitted.basis.on(plane, (phase.shape[0], phase.shape[1]))
    ranges = swept.source.ranges(at)
    start = (ranges[0][0], ranges[1][0])
    bad = flags != 0
    k = float(np.hypot(*fitted.basis.shape.vector(*plane.centre)))
    scale = np.sqrt(swept.noise) / k
    rest = phase - model - np.tensordot(fitted.coefficients[:, 0], modes, 1)

    def write(name: str, values: F64 | F32) -> None:
        begin = (0, *start) if values.ndim == 3 else start
        writers[name].write(begin, np.where(bad, np.nan, values).astype(np.float32))

    sigma = (swept.map("sigma", at) * scale).astype(np.float32)
    told = int((~bad).sum()), _some(sigma[~bad])
    write("delta", rest / k)
    write("sigma", sigma)
    for name in ("iota", "alpha", "chi2"):
        writers[name].write(start, swept.map(name, at))
    writers["mask"].write(start, flags)
    if "batch_delta" not in writers:
        return told
    everything = (0, writers["batch_delta"].shape[0])
    steps = ArrayReader(swept.sweep / "batch_phase").read(everything, *ranges)
    removed = np.tensordot(fitted.coefficients[:, 1:].T, modes, 1)
    write("batch_delta", (rest + steps - removed) / k)
    errors = ArrayReader(swept.sweep / "batch_sigma").read(everything, *ranges)
    write("batch_sigma", errors * scale)
    return told
