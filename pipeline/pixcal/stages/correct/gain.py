"""Effect of the correction: change of the maps, periodic patterns, agreement of sets and halves.

Everything is measured on pixels that are good before and after.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.arrays import F64, Mask
from pixcal.stages.correct.swept import HALVES
from pixcal.stages.correct.undoing import mean_of
from pixcal.stages.reduced_set import ReducedSet
from pixcal.storage.cube import ArrayReader

PERIOD = 4  # rows or columns after which patterns repeat (paper, section 5.1: period of four rows)
WORSE = 4.0  # errors from which a pattern, or a disagreement of sets, is larger than before
ALIGNED = 0.985  # cosine between the axes of sets that see the same offsets (10 degrees)


@dataclass(frozen=True)
class Maps:
    """Maps of the sets before and after."""

    before: Path  # before, after: `fit.zarr` and `corrected.zarr`
    after: Path
    source: ReducedSet  # for the tiles
    names: tuple[str, ...]  # of the sets
    axes: Mapping[str, tuple[float, float]]  # unit vector (x, y) that each measures along
    has_halves: Mapping[str, bool]  # which sets have maps of both halves of the frames
    effects: int  # undone on maps: the variants that follow the halves

    @property
    def pairs(self) -> list[tuple[str, str, float]]:
        """Sets along one axis, and the sign of the second one's offsets to those of the first."""
        aligned = []
        for a, b in combinations(self.names, 2):
            along = float(np.dot(self.axes[a], self.axes[b]))
            if abs(along) > ALIGNED:
                aligned.append((a, b, float(np.sign(along))))
        return aligned

    def read(self, group: Path, name: str, array: str, *ranges: tuple[int, int]) -> F64:
        """A part of a map."""
        return np.asarray(ArrayReader(group / name / array).read(*ranges), float)


@dataclass
class SetSums:
    """Sums over pixels of one set."""

    count: int
    # (1 + effect, 2) sum of squares and largest of the change of offsets: of all, then of each
    # effect on maps; last of those on samples
    moved: F64
    # rows, columns: (3, n) sums over each row and column of the offsets before and after, and
    # the count
    rows: F64
    columns: F64
    # (2, 3) before and after: squares of half the difference, what errors let expect of them, count
    halves: F64
    square: float  # sum of the squared offsets after


@dataclass(frozen=True)
class TileGain:
    """Sums of one tile: of its sets, and of pairs of them (as `SetSums.halves`)."""

    sets: list[SetSums]
    pairs: list[F64]


def measure_gain(maps: Maps, runtime: Runtime) -> dict[str, Any]:
    """Statistics of ``sets``, by name, and of ``pairs`` of sets along one axis."""
    cy, cx = maps.source.signal.chunks[1:]
    variants = HALVES + maps.effects
    batches = max(_batches(maps.before / name) for name in maps.names)
    need = cy * cx * (16 * (variants + 2 * batches) + 60 * len(maps.names) + 100)
    runtime = within_memory("measuring the gain", need, 0, runtime)
    sums = run_tasks(partial(_tile, maps), maps.source.tiles(), runtime, label="gain")
    sets = {
        name: _described(_total([one.sets[n] for one in sums], maps.source))
        for n, name in enumerate(maps.names)
    }
    pairs = [
        {"sets": [a, b]} | _agreement(np.sum([t.pairs[n] for t in sums], axis=0))
        for n, (a, b, _) in enumerate(maps.pairs)
    ]
    return {"sets": sets, "pairs": pairs}


def worsened(sets: Mapping[str, Any], pairs: Sequence[Mapping[str, Any]]) -> str:
    """Where the corrected maps are worse than those before; empty where they are not.

    A wrong correction leaves a periodic pattern in a map, or sets apart that see the same offsets.
    """
    for name, facts in sets.items():
        for lines in ("rows", "columns"):
            own = facts[lines]
            if own is None or None in (own["before_px"], own["after_px"]):
                continue
            if own["after_px"] > np.hypot(own["before_px"], WORSE * own["chance_px"]):
                return (
                    f"in set {name} the pattern of {lines} grows from {own['before_px']:.2g} to "
                    f"{own['after_px']:.2g} px"
                )
    for pair in pairs:
        excess = {
            when: pair[f"{when}_px"] ** 2 - pair[f"{when}_expected_px"] ** 2
            for when in ("before", "after")
        }
        pixels = min(sets[name]["pixels"] for name in pair["sets"])
        chance = pair["after_expected_px"] ** 2 * np.sqrt(2 / max(pixels, 1))
        # Errors fall with a correction, so sets that are closer than before may exceed them more.
        apart = pair["after_px"] > pair["before_px"]
        if apart and excess["after"] > max(excess["before"], 0.0) + WORSE * chance:
            return (
                f"the offsets of {' and '.join(pair['sets'])} are {pair['after_px']:.2g} px apart, "
                f"{pair['before_px']:.2g} px before"
            )
    return ""


def _batches(folder: Path) -> int:
    return int(ArrayReader(folder / "batch_count").shape[0])


def _tile(maps: Maps, at: tuple[int, int]) -> TileGain:
    y, x = maps.source.ranges(at)
    groups = (maps.before, maps.after)
    delta, error = (
        {name: [maps.read(group, name, array, y, x) for group in groups] for name in maps.names}
        for array in ("delta", "sigma")
    )
    sets = [_of_set(maps, name, delta[name], (y, x)) for name in maps.names]
    pairs = []
    for a, b, sign in maps.pairs:
        apart = [delta[a][n] - sign * delta[b][n] for n in (0, 1)]
        expected = [error[a][n] ** 2 + error[b][n] ** 2 for n in (0, 1)]
        pairs.append(_squares(apart, expected))
    return TileGain(sets, pairs)


def _of_set(
    maps: Maps, name: str, delta: Sequence[F64], part: tuple[tuple[int, int], tuple[int, int]]
) -> SetSums:
    before, after = delta
    good = np.isfinite(before) & np.isfinite(after)
    first = HALVES * maps.has_halves[name]
    steps = [
        after - maps.read(maps.after, name, "batch_delta", (n, n + 1), *part)[0]
        for n in range(first, first + maps.effects)
    ]
    total = after - before
    moved = [total, *steps, total - np.sum(steps, axis=0)]
    halves = np.zeros((2, 3))
    if maps.has_halves[name]:
        halves = _of_halves(maps, name, good, part)
    profiles = np.stack([np.where(good, values, 0.0) for values in (before, after, good)])
    return SetSums(
        int(good.sum()),
        np.array([[(m[good] ** 2).sum(), np.abs(m[good]).max(initial=0.0)] for m in moved]),
        profiles.sum(axis=2),
        profiles.sum(axis=1),
        halves,
        float((after[good] ** 2).sum()),
    )


def _of_halves(
    maps: Maps, name: str, good: Mask, part: tuple[tuple[int, int], tuple[int, int]]
) -> F64:
    """Of half the difference between the halves of the frames, which is the noise of the map."""
    batches = _batches(maps.before / name)
    arrays = ("batch_delta", "batch_sigma")
    stored = [ArrayReader(maps.before / name / array).read((0, batches), *part) for array in arrays]
    parts = (slice(batches // 2), slice(batches // 2, None))
    before = np.stack([mean_of(stored[0][cut], stored[1][cut]) for cut in parts], axis=1)
    after = np.stack([maps.read(maps.after, name, array, (0, HALVES), *part) for array in arrays])
    apart, variance = [], []
    for delta, sigma in (before.astype(float), after):
        apart.append(np.where(good, (delta[0] - delta[1]) / 2, np.nan))
        variance.append((sigma**2).sum(axis=0) / 4)
    return _squares(apart, variance)


def _squares(apart: Sequence[F64], expected: Sequence[F64]) -> F64:
    """Sums (before or after; square, expected square, count) over pixels that have all."""
    good = np.isfinite(np.stack([*apart, *expected])).all(axis=0)
    both = zip(apart, expected, strict=True)
    return np.array([[(a[good] ** 2).sum(), v[good].sum(), good.sum()] for a, v in both])


def _total(tiles: Sequence[SetSums], source: ReducedSet) -> SetSums:
    rows, columns = (np.zeros((3, n)) for n in source.shape)
    for at, one in zip(source.tiles(), tiles, strict=True):
        y, x = source.ranges(at)
        rows[:, slice(*y)] += one.rows
        columns[:, slice(*x)] += one.columns
    squares, most = np.moveaxis(np.stack([one.moved for one in tiles]), -1, 0)
    return SetSums(
        sum(one.count for one in tiles),
        np.stack([squares.sum(axis=0), most.max(axis=0)], axis=1),
        rows,
        columns,
        np.sum([one.halves for one in tiles], axis=0),
        sum(one.square for one in tiles),
    )


def _described(total: SetSums) -> dict[str, Any]:
    pixels = max(total.count, 1)
    change = [
        {"rms_px": float(np.sqrt(square / pixels)), "max_px": float(most)}
        for square, most in total.moved
    ]
    return {
        "pixels": total.count,
        "change": change[0],
        "change_by_effect": change[1:-1],
        "change_on_samples": change[-1],
        "rows": _patterns(total.rows, total),
        "columns": _patterns(total.columns, total),
        "halves": _agreement(total.halves) if total.halves[:, 2].all() else None,
    }


def _patterns(profile: F64, total: SetSums) -> dict[str, Any] | None:
    """Rms of what repeats every `PERIOD` rows (px), before and after, and of offsets that do not.

    None where the window is too small.
    """
    if profile.shape[1] < 3 * PERIOD:
        return None
    count = profile[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        means = np.where(count > 0, profile[:2] / count, np.nan)
    chance = np.sqrt(total.square * (PERIOD - 1)) / max(total.count, 1)
    before, after = (repeating(profile_of) for profile_of in means)
    return {"period_px": PERIOD, "before_px": before, "after_px": after, "chance_px": float(chance)}


def repeating(profile: F64) -> float | None:
    """Rms of what repeats every `PERIOD` places of a profile; NaN are left out.

    What changes slowly is taken off first: the mean over a period about each place, which is that
    of any pattern that repeats.
    """
    half = PERIOD // 2
    kernel = np.ones(PERIOD + 1)
    kernel[[0, -1]] = 0.5
    rest = profile[half:-half] - np.convolve(profile, kernel / PERIOD, "valid")
    good = np.isfinite(rest)
    classes = np.arange(len(rest)) % PERIOD
    count = np.bincount(classes[good], minlength=PERIOD)
    if not count.all():
        return None
    means = np.bincount(classes[good], rest[good], PERIOD) / count
    return float(np.sqrt(((means - means.mean()) ** 2).mean()))


def _agreement(sums: F64) -> dict[str, Any]:
    """Rms (px) before and after, and that expected from the errors."""
    rms: dict[str, Any] = {}
    for (square, expected, count), when in zip(sums, ("before", "after"), strict=True):
        rms[f"{when}_px"] = float(np.sqrt(square / max(count, 1)))
        rms[f"{when}_expected_px"] = float(np.sqrt(expected / max(count, 1)))
    return rms
