"""Write the datasets of the fringe sets: range, precision, conversion and warnings."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from pixcal.engine.run import Runtime, run_tasks
from pixcal.kernels.quantise import Scale, choose_scale
from pixcal.model.arrays import I64
from pixcal.stages.reduce import electrons
from pixcal.stages.reduce.columns import run_noted, strip_width
from pixcal.stages.reduce.electrons import RawFringeSet
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.tiles import indices, strips
from pixcal.storage.artefact import Workspace
from pixcal.storage.cube_reader import ArrayReader

_CONVERTERS = (8, 10, 12, 14)


@dataclass(frozen=True)
class Bounds:
    """Extreme flat, bias and dark rate of the good pixels; typical read noise."""

    flat: tuple[float, float]  # least and largest relative response
    bias: float  # bias, dark_rate: largest (ADU; e-/s)
    dark_rate: float
    read_noise: float  # typical (e-)

    @property
    def smallest_variance(self) -> float:
        """Least variance of a sample (e-²): read noise at the largest response."""
        return (self.read_noise / self.flat[1]) ** 2


def write_set(
    made: Workspace,
    source: Ingested,
    name: str,
    *,
    gain: float,
    bounds: Bounds,
    share: float,
    runtime: Runtime,
) -> dict[str, Any]:
    """Write the dataset of a fringe set; return its entry in ``reduce.json``.

    ``name``: of the array, ``fringes/<set>``; ``gain``: e-/ADU; ``share``: largest share of the
    variance that rounding of stored samples may add.
    """
    fringes = RawFringeSet(
        name=name.partition("/")[2],
        raw=source.arrays[name],
        calibration=made.folder / "calibration.zarr",
        exptime=source.exposures.fringes[name],
        saturation=source.saturation(name),
        gain=gain,
    )
    todo = indices(source.shape)
    need = partial(
        electrons.convert_bytes, fringes.raw.dtype.itemsize, frames=fringes.raw.chunks[0]
    )
    width = strip_width([fringes.raw], need, runtime)
    low, high = _possible_range(source, name, gain, bounds)
    origin = "saturation"
    scale = None
    if math.isfinite(high - low):
        scale = choose_scale(low, high, bounds.smallest_variance, share)
    if scale is None or scale.variance > share * bounds.smallest_variance:
        # Read the range from the frames: they may not fill the converter's range.
        origin = "frames"
        ends = run_tasks(
            partial(electrons.signal_range, fringes),
            strips(todo, width),
            runtime,
            label=f"{name} range",
        )
        # Samples far below the bias are invalid and have no weight.
        low, high = max(low, min(e[0] for e in ends)), max(e[1] for e in ends)
        low, high = (low, high) if low <= high else (0.0, 1.0)
        scale = choose_scale(low, high, bounds.smallest_variance, share)
    folder = made.cubes / "reduced.zarr" / fringes.name
    scratch = made.scratch / "counts" / fringes.name
    writers = electrons.set_writers(folder, scratch, fringes.frames, source.shape, scale)
    task = partial(electrons.convert, fringes, scale, writers)
    run_noted(made, task, todo, width, runtime, name)
    for writer in writers.values():
        writer.finish()
    electrons.write_coordinates(folder, source.tables[name]["time_s"], source.shape)
    return {
        "frames": fringes.frames,
        **_describe_counts(ArrayReader(scratch).read(), scale),
        "quantisation": _describe_scale(scale, (low, high), origin, bounds),
    }


def _possible_range(
    source: Ingested, name: str, gain: float, bounds: Bounds
) -> tuple[float, float]:
    """Range of electrons of a good pixel over the range of the converter."""
    # In signed types, only noise about a bias gives negative samples, not the converter's range.
    lowest = max(source.lowest(name), -32 * max(bounds.read_noise / gain, 1.0))
    flat = bounds.flat[0]
    dark = bounds.dark_rate * float(source.exposures.fringes[name].max())
    low = gain * (lowest - max(bounds.bias, 0.0)) - max(dark, 0.0)
    return low / flat, gain * source.saturation(name) / flat


def _describe_counts(counts: I64, scale: Scale) -> dict[str, Any]:
    saturated, lost, weighted, total = (int(counts[..., n].sum()) for n in range(4))
    return {
        "samples": saturated + lost + weighted,
        "saturated_samples": saturated,
        "lost_samples": lost,
        "mean_e": total / weighted * scale.step + scale.offset if weighted else None,
        "largest_adu": int(counts[..., 4].max()),
    }


def _describe_scale(
    scale: Scale, span: tuple[float, float], origin: str, bounds: Bounds
) -> dict[str, Any]:
    return {
        "step_e": scale.step,
        "offset_e": scale.offset,
        "range_e": list(span),
        "range_from": origin,
        "share_of_variance_dark": scale.variance / bounds.smallest_variance,
    }


def share_at_mean(facts: dict[str, Any], bounds: Bounds) -> float | None:
    """Share of the variance that rounding adds at the mean signal of a set."""
    if facts["mean_e"] is None:
        return None
    variance = max(facts["mean_e"], 0.0) + bounds.read_noise**2
    return float(facts["quantisation"]["step_e"] ** 2 / 12 / variance)


def set_warnings(
    name: str, facts: dict[str, Any], declared: float | None, share: float
) -> Iterator[str]:
    """Warnings on a fringe set, given the result of `write_set`.

    ``declared``: saturation level, ADU; ``share``: as in `write_set`.
    """
    cost = facts["quantisation"]["share_of_variance_dark"]
    if cost > share:
        yield (
            f"{name}: steps of {facts['quantisation']['step_e']:.3g} e-, which the range of the "
            f"signal needs, add {100 * cost:.2g} % to the variance of a sample without light"
        )
    largest = facts["largest_adu"]
    level = math.inf if declared is None else declared
    if largest < level and any(largest == 2**bits - 1 for bits in _CONVERTERS):
        yield (
            f"{name}: the largest sample is {largest}, the largest code of a converter; if it "
            f"saturates there, declare detector.saturation_adu: {largest}"
        )
    if facts["mean_e"] is None:
        yield f"{name}: no usable samples: all are saturated or missing"
