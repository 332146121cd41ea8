"""Correct the maps of a sweep for effects: new phases of the pixels and new sums of the tiles.

The result is in the format of a sweep of the cube, and the shapes of the fringes are fitted to it.
Its batches are variants: each half of the frames, corrected separately, and the map with each of
the effects left in.

A tile is corrected together with the surrounding pixels that the effects involve. Tiles are the
columns of chunks of the cube, so results depend neither on memory nor on workers.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.fringe_fit.combine import weighted_mean
from pixcal.estimators.fringe_fit.fringes import wrapped
from pixcal.estimators.fringe_fit.tile_sums import TileSums, sum_row, tile_plane
from pixcal.estimators.maps.corrected import phase_change
from pixcal.kernels.medians import robust_sigma
from pixcal.model.arrays import F32, F64, Mask
from pixcal.simulation.effect import FringeMaps
from pixcal.stages.correct.sweep_to_correct import (
    HALVES,
    Sides,
    Swept,
    border_change,
    corrected,
    maps_of,
    padded,
    without_sample_effects,
)
from pixcal.stages.correct.uncertainty import parameter_variance, task_bytes
from pixcal.stages.fit.sweep import BATCH_MAPS
from pixcal.stages.tiles import Part
from pixcal.storage import cube
from pixcal.storage.cube import ArrayWriter
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.folder import link_files
from pixcal.storage.manifest import read_json, write_json

SAME = ("chi2", "mask", "g", "dk", "time")  # unchanged arrays of a sweep
# lines of pixels that predict the line at the border, and lines next to it that are left out
DEPTH, SKIPPED = 24, 4
ALONG = 1024  # pixels along a side that test whether it is open
# difference of chi-square above which a side is decided alone; the sum decides the others
CLEAR = 9.0
# signs of neighbours, chosen so that the errors of any two add in quadrature on average
SIGNS = ((0, 0), (0, 1), (1, 0), (1, 1))


def correct_sweep(swept: Swept, target: Path, runtime: Runtime, name: str) -> None:
    """Write the corrected sweep of a set to a new folder."""
    cube.create_group(target)
    for array in SAME:
        link_files(swept.folder / array, target / array)
    write_json(target / "scout.json", read_json(swept.folder / "scout.json"))
    counts = ArrayReader(swept.folder / "batch_count").read()
    middle, frames = len(counts) // 2, swept.source.n_frames
    of_halves = [int(counts[:middle].sum()), int(counts[middle:].sum())] * swept.has_halves
    variants = np.array([*of_halves, *[frames] * len(swept.effects)], np.int32)
    cube.write_array(target / "batch_count", variants, dims=("batch",))
    cube.write_array(target / "batch_time", np.zeros(len(variants)), dims=("batch",))
    cy, cx = swept.source.signal.chunks[1:]
    tiles = swept.source.tiles()
    if swept.has_halves:
        halves = _create(target, swept, ("half_phase", "half_sigma"), HALVES)
        need = cy * cx * (44 * swept.n_batches + 100)
        fitting = within_memory(f"halves of {name}", need, 0, runtime)
        task = partial(_halve, swept, halves, middle)
        run_tasks(task, tiles, fitting, label=f"halves {name}")
        for writer in halves.values():
            writer.finish()
    writers = _create(target, swept, ("iota", "alpha", "phase", "sigma"))
    writers |= _create(target, swept, ("batch_phase", "batch_sigma"), len(variants))
    width = TileSums.width(len(variants))
    writers["sums"] = cube.create_array(
        target / "sums",
        (*swept.source.grid, width),
        "<f8",
        dims=("row", "column", "fact"),
        chunks=(1, 1, width),
        fill_value=np.nan,
    )
    fitting = within_memory(f"correction of {name}", task_bytes(swept), 0, runtime)
    task = partial(_correct_tile, swept, target, writers)
    run_tasks(task, tiles, fitting, label=f"correct {name}")
    for writer in writers.values():
        writer.finish()


def _create(
    target: Path, swept: Swept, names: Sequence[str], number: int = 0
) -> dict[str, ArrayWriter]:
    """Writers of maps (y, x), or of several at a time (number, y, x)."""
    source = swept.source
    chunks = source.signal.chunks[1:]
    return {n: cube.create_map(target / n, source.shape, chunks, number=number) for n in names}


def _halve(swept: Swept, writers: dict[str, ArrayWriter], middle: int, at: tuple[int, int]) -> None:
    """Phases of the halves of the frames relative to all frames, and their errors, from batches."""
    y, x = swept.source.ranges(at)
    batches = (0, swept.n_batches)
    phase, sigma = (
        ArrayReader(swept.folder / name).read(batches, y, x).astype(np.float32)
        for name in BATCH_MAPS
    )
    halves = [mean_of(phase[part], sigma[part]) for part in (slice(middle), slice(middle, None))]
    for n, name in enumerate(("half_phase", "half_sigma")):
        writers[name].write((0, y[0], x[0]), np.stack([f[n] for f in halves]))


def mean_of(maps: F32, sigma: F32) -> tuple[F32, F32]:
    """Weighted mean (y, x) of maps (batch, y, x) and its error; NaN without data."""
    mean, error, _ = weighted_mean(maps.astype(float), sigma.astype(float))
    return mean.astype(np.float32), error.astype(np.float32)


def _correct_tile(
    swept: Swept, target: Path, writers: dict[str, ArrayWriter], at: tuple[int, int]
) -> None:
    y, x = swept.source.ranges(at)
    part = swept.around(y, x)
    inside = swept.inside(y, x)
    maps, good, known = maps_of(swept, part)
    border = border_change(swept, part)
    maps = maps.phase_shifted(border)
    after, steps = corrected(maps, swept.effects)
    change = np.sum(steps, axis=0) if steps else np.zeros(maps.theta.shape[1:])
    moved = (change + border)[inside].astype(np.float32)
    phase = wrapped(ArrayReader(swept.folder / "phase").read(y, x) + moved)
    factor = _noise_factor(swept, maps)[inside]
    own_error = ArrayReader(swept.folder / "sigma").read(y, x) * factor
    beside = _of_neighbours(swept, maps, after, known, part)[inside]
    left = np.sum(parameter_variance(swept, maps, good, inside), axis=0)
    sigma = np.sqrt(own_error**2 + beside**2 + left).astype(np.float32)
    iota, alpha = after.theta[0][inside], np.hypot(after.theta[1], after.theta[2])[inside]
    variants: list[F64] = []
    errors: list[F64] = []
    for n in range(HALVES * swept.has_halves):
        half = ArrayReader(target / "half_phase").read((n, n + 1), *swept.within(part))[0]
        half_phase = padded(half.astype(float), swept, part)
        its = corrected(maps.phase_shifted(half_phase), swept.effects)[1]
        rest = np.sum(its, axis=0) - change if its else 0.0
        variants.append((half_phase + rest)[inside])
        errors.append(ArrayReader(target / "half_sigma").read((n, n + 1), y, x)[0] * factor)
    variants += [-step[inside] for step in steps]
    errors += [sigma] * len(steps)
    start = (y[0], x[0])
    for name, values in (("iota", iota), ("alpha", alpha), ("phase", phase), ("sigma", sigma)):
        writers[name].write(start, values.astype(np.float32))
    several = np.array(variants, np.float32).reshape(-1, *phase.shape)
    if len(several):
        writers["batch_phase"].write((0, *start), several)
        writers["batch_sigma"].write((0, *start), np.array(errors, np.float32))
    ratio = iota / np.maximum(alpha, 1e-9)
    row = _sums(swept, at, phase, sigma, ratio, good[inside], several)
    writers["sums"].write((*at, 0), row[None, None])


def _of_neighbours(
    swept: Swept, maps: FringeMaps, after: FringeMaps, known: Mask, part: Part
) -> F64:
    """Error (y, x) of a pixel's phase from neighbours of unknown light, rad."""
    if known.all() or not any(effect.undo_halo for effect in swept.effects):
        return np.zeros(known.shape)
    within = padded(np.ones([b - a for a, b in swept.within(part)], bool), swept, part, False)
    phase = ArrayReader(swept.folder / "phase").read(*swept.within(part)).astype(float)
    others = perturbed(maps, within & ~known, ~within, phase)
    steps = [phase_change(after.theta, corrected(o, swept.effects)[0].theta) for o in others]
    error = np.sqrt(np.mean(np.square(steps), axis=0))
    return np.asarray(np.where(known, error, 0.0))


def _noise_factor(swept: Swept, maps: FringeMaps) -> F64:
    """Ratio (y, x) of the noise after the correction to that before."""
    light = maps.theta[0] if maps.flat is None else maps.theta[0] * maps.flat
    factor = np.ones(light.shape)
    for effect in swept.effects:
        factor *= effect.noise_factor(float(light.mean()), swept.read_noise, maps)
    return factor


def _sums(
    swept: Swept, at: tuple[int, int], phase: F32, sigma: F32, ratio: F64, good: Mask, variants: F32
) -> F64:
    """Sums to which shapes are fitted, in the format of the sweep."""
    stored = ArrayReader(swept.folder / "sums").read((at[0], at[0] + 1), (at[1], at[1] + 1))
    (old,) = TileSums.of_rows(stored.reshape(1, -1)).planes
    k, ratios = (old.kx, old.ky), ratio.astype(np.float32)
    plane = tile_plane(phase, sigma, ratios, good, k, old.centre)
    return sum_row(phase, sigma, good, variants, swept.carrier, plane)


# Surroundings of the pixels of a tile: flagged pixels, and pixels beyond the window


def perturbed(maps: FringeMaps, unknown: Mask, beyond: Mask, phase: F64) -> list[FringeMaps]:
    """The maps with unknown pixels perturbed by their errors, with the signs of `SIGNS`.

    ``unknown``: pixels with any light up to twice that around them; ``beyond``: pixels outside the
    window, whose unknown offsets scatter like ``phase`` (y, x), rad.
    """
    scatter = np.nan_to_num(robust_sigma(np.diff(phase, axis=1)) / np.sqrt(2))
    y, x = np.indices(unknown.shape)
    y, x = y + maps.origin[0], x + maps.origin[1]
    variants = []
    for a, b in SIGNS:
        sign = 1.0 - 2.0 * ((a * y + b * x) % 2)
        moved = maps.phase_shifted(scatter * sign * beyond)
        moved.theta[1:] *= np.where(unknown, 1 + sign, 1.0)
        variants.append(moved)
    return variants


def sides_of(sets: Sequence[Swept]) -> Sides:
    """Sides at which the detector extends beyond the window, from the maps of all sets."""
    misfits = np.zeros((4, 2))
    for swept in sets:
        # Pixels beyond the window matter if a correction moves charge.
        moves = any(effect.undo_halo for effect in (*swept.effects, *swept.samples))
        if moves and min(swept.source.shape) >= 2 * DEPTH:
            for side in range(4):
                misfits[side] += [_misfit(swept, side, is_open) for is_open in (False, True)]
    return open_sides(misfits)


def _misfit(swept: Swept, side: int, is_open: bool) -> float:
    """Misfit of the pixels at one side, assumed open or closed."""
    axis, last = divmod(side, 2)
    shape, (kx, ky) = swept.source.shape, swept.k
    length = shape[1 - axis]
    middle = max(0, (length - ALONG) // 2)
    along = (middle, min(length, middle + ALONG))
    across = (shape[axis] - DEPTH, shape[axis]) if last else (0, DEPTH)
    y, x = (along, across) if axis else (across, along)
    top, bottom, left, right = (is_open and n == side for n in range(4))
    one = replace(swept, open_sides=(top, bottom, left, right))
    inside = one.inside(y, x)
    maps, good = without_sample_effects(one, one.around(y, x))
    theta, good = corrected(maps, swept.effects)[0].theta[(slice(None), *inside)], good[inside]
    if axis:
        theta, good, kx, ky = theta.swapaxes(1, 2), good.T, ky, kx
    if last:
        theta, good, ky = theta[:, ::-1], good[::-1], -ky
    return border_misfit(theta, (kx, ky), good)


def border_misfit(theta: F64, k: tuple[float, float], good: Mask) -> float:
    """Chi-square of the first line of a strip (3, line, pixel) against the trend of the next lines.

    ``k``: along the lines and from line to line, rad/px.
    """
    lines, pixels = good.shape
    y, x = np.arange(lines)[:, None], np.arange(pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (theta[2] + 1j * theta[1]) / theta[0] * np.exp(-1j * (k[0] * x + k[1] * y))
        z /= np.nanmean(np.where(good, z, np.nan))
        value = np.log(z)
    depth = np.arange(SKIPPED, lines)
    total = 0.0
    for part in (value.real, value.imag):
        values = np.where(good & np.isfinite(part), part, np.nan)
        values = values - np.nanmedian(values[SKIPPED:], axis=0)
        mean = np.nanmedian(values, axis=1)
        spread = robust_sigma(values[SKIPPED:] - mean[SKIPPED:, None])
        error = spread * np.sqrt(np.pi / 2 / max(int(good[0].sum()), 1))
        if not (error > 0 and np.isfinite(mean).all()):
            continue
        slope, start = np.polyfit(depth, mean[depth], 1)
        # Residuals of an imperfectly known effect in lines do not indicate a border.
        lines_apart = robust_sigma(mean[depth] - start - slope * depth)
        total += float((mean[0] - start) ** 2 / (error**2 + lines_apart**2))
    return total


def open_sides(misfits: F64) -> Sides:
    """Which sides are open, from the chi-squares (side, closed or open)."""
    gain = misfits[:, 0] - misfits[:, 1]
    top, bottom, left, right = np.where(np.abs(gain) > CLEAR, gain > 0, gain.sum() > 0).tolist()
    return top, bottom, left, right
