"""Join the fringe sets of a run into delta_x and delta_y."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.combine import axes_span_plane, combine_parallel, combine_sets
from pixcal.estimators.models import FringeShape
from pixcal.stages.reduced_set import ReducedSet
from pixcal.storage.cube import ArrayReader, ArrayWriter, create_array

F64 = NDArray[np.float64]


def combine(
    folder: Path, run_dir: Path, shapes: dict[str, FringeShape], runtime: Runtime
) -> dict[str, Any]:
    """Join the sets into delta_x and delta_y, or delta_fringe where all axes are the same."""
    names = list(shapes)
    source = ReducedSet(run_dir / "reduce" / "reduced.zarr" / names[0])
    ny, nx = source.shape
    both = axes_span_plane([axis(s, ny / 2, nx / 2) for s in shapes.values()])
    outputs = ("delta_x", "delta_y") if both else ("delta_fringe",)
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
    tiles = source.tiles()
    squares = run_tasks(
        partial(_combine_task, group, source, shapes, both, writers),
        tiles,
        runtime,
        label="combine sets",
    )
    for writer in writers.values():
        writer.finish()
    square, freedom = sum(s[0] for s in squares), sum(s[1] for s in squares)
    consistency = square / freedom if freedom else None
    return {"outputs": list(outputs), "sets_chi2_reduced": consistency}


def _combine_task(
    group: Path,
    source: ReducedSet,
    shapes: dict[str, FringeShape],
    both: bool,
    writers: dict[str, ArrayWriter],
    at: tuple[int, int],
) -> tuple[float, int]:
    """Join the sets on a tile; disagreement of the sets and its degrees of freedom."""
    y, x = source.ranges(at)

    def stack(array: str) -> NDArray[Any]:
        return np.stack([ArrayReader(group / n / array).read(y, x) for n in shapes])

    delta, sigma, masks = stack("delta"), stack("sigma"), stack("mask")
    # Hyperbolic fringes turn over the window: each tile has its own axes.
    axes = [axis(s, (y[0] + y[1] - 1) / 2, (x[0] + x[1] - 1) / 2) for s in shapes.values()]
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
    freedom = np.isfinite(delta).sum(axis=0) - len(outputs)
    return float(chi2[~missing].sum()), int(freedom[~missing].sum())


def axis(shape: FringeShape, y: float, x: float) -> tuple[float, float]:
    """Unit vector (x, y) along which a set measures at a point."""
    kx, ky = shape.vector(y, x)
    k = float(np.hypot(kx, ky))
    return kx / k, ky / k
