"""Result of the correction: change of the maps, periodic patterns, agreement of sets and halves.

All statistics use pixels that are good before and after.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.arrays import F64
from pixcal.stages.correct.correct_maps import mean_of
from pixcal.stages.correct.sweep_to_correct import HALVES, Swept
from pixcal.stages.tiles import Part
from pixcal.storage.cube_reader import ArrayReader

PERIOD = 4  # rows or columns after which patterns repeat (paper, section 5.1: period of four rows)
WORSE = 4.0  # sigma above which a pattern, or a disagreement of sets, is larger than before
LARGER = 1.05  # least difference of the halves over its error that enlarges the errors
ALIGNED = 0.985  # least cosine between axes of sets that measure the same offsets (10 degrees)


@dataclass(frozen=True)
class MapsOfSets:
    """Maps of the sets before and after."""

    before: Path  # before, after: `fit.zarr` and `corrected.zarr`
    after: Path
    sets: Mapping[str, Swept]  # by name, as they were corrected
    axes: Mapping[str, tuple[float, float]]  # unit vector (x, y) along which each set measures

    @property
    def pairs(self) -> list[tuple[str, str, float]]:
        """Pairs of sets along one axis, and relative sign of their offsets."""
        both = combinations(self.sets, 2)
        pairs = [(a, b, float(np.dot(self.axes[a], self.axes[b]))) for a, b in both]
        return [(a, b, float(np.sign(along))) for a, b, along in pairs if abs(along) > ALIGNED]

    def batches(self, name: str) -> int:
        """Batches of a set as it was fitted."""
        return int(ArrayReader(self.before / name / "batch_count").shape[0])


class SetSums(NamedTuple):
    """Sums over the pixels of one set."""

    pixels: int
    # (1 + effect, 2) sum of squares and largest change of offsets: total, then of each effect on
    # maps; last, of the effects on samples
    moved: F64
    # rows, columns: (3, n) sums of the offsets over each row and column, before and after, and the
    # count
    rows: F64
    columns: F64
    # (2, 3) before and after: squares of half the difference, values expected from errors, count
    halves: F64
    square: float  # sum of the squared offsets after


def measure_gain(maps: MapsOfSets, runtime: Runtime) -> dict[str, Any]:
    """Statistics of ``sets``, by name, and of ``pairs`` of sets along one axis."""
    source = next(iter(maps.sets.values())).source
    cy, cx = source.signal.chunks[1:]
    variants = HALVES + max(len(swept.effects) for swept in maps.sets.values())
    batches = max(map(maps.batches, maps.sets))
    need = cy * cx * (16 * (variants + 2 * batches) + 60 * len(maps.sets) + 100)
    runtime = within_memory("measuring the gain", need, 0, runtime)
    parts = [source.ranges(tile) for tile in source.tiles()]
    of_sets, of_pairs = zip(
        *run_tasks(partial(_tile, maps), parts, runtime, label="gain"), strict=True
    )
    sets = {
        name: _described([one[n] for one in of_sets], parts, source.shape)
        for n, name in enumerate(maps.sets)
    }
    pairs = [
        {"sets": [a, b]} | _agreement(np.sum([one[n] for one in of_pairs], axis=0))
        for n, (a, b, _) in enumerate(maps.pairs)
    ]
    return {"sets": sets, "pairs": pairs}


def excess(facts: Mapping[str, Any]) -> float:
    """Difference of the corrected halves of a set over its error; 1 where they agree."""
    # A correction that does not fit leaves errors that vary with the phases of the frames, and a
    # drift of the bench does so too.
    halves = facts["halves"]
    if halves is None or not halves["after_expected_px"]:
        return 1.0
    ratio = float(halves["after_px"] / halves["after_expected_px"])
    chance = WORSE * np.sqrt(2 / max(facts["pixels"], 1))
    return ratio if ratio > LARGER and ratio**2 > 1 + chance else 1.0


def worsened(sets: Mapping[str, Any], pairs: Sequence[Mapping[str, Any]]) -> str:
    """In which respects the corrected maps are worse than before; empty if in none."""
    # A wrong correction leaves a periodic pattern in a map, or causes disagreement of sets that
    # measure the same offsets.
    for name, facts in sets.items():
        for lines in ("rows", "columns"):
            change = facts[lines]
            if change is None or None in (change["before_px"], change["after_px"]):
                continue
            if change["after_px"] > np.hypot(change["before_px"], WORSE * change["chance_px"]):
                return (
                    f"in set {name} the pattern of {lines} grows from {change['before_px']:.2g} to "
                    f"{change['after_px']:.2g} px"
                )
    for pair in pairs:
        before, after = (
            pair[f"{when}_px"] ** 2 - pair[f"{when}_expected_px"] ** 2
            for when in ("before", "after")
        )
        pixels = min(sets[name]["pixels"] for name in pair["sets"])
        chance = pair["after_expected_px"] ** 2 * np.sqrt(2 / max(pixels, 1))
        # A correction reduces errors, so sets may agree better yet exceed their errors by more.
        apart = pair["after_px"] > pair["before_px"]
        if apart and after > max(before, 0.0) + WORSE * chance:
            return (
                f"the offsets of {' and '.join(pair['sets'])} differ by {pair['after_px']:.2g} px, "
                f"and by {pair['before_px']:.2g} px before the correction"
            )
    return ""


def _tile(maps: MapsOfSets, part: Part) -> tuple[list[SetSums], list[F64]]:
    """Sums of one tile: of its sets, and of pairs of them (as `SetSums.halves`)."""
    delta, variance = (
        {
            name: [
                ArrayReader(group / name / array).read(*part).astype(float) ** power
                for group in (maps.before, maps.after)
            ]
            for name in maps.sets
        }
        for array, power in (("delta", 1), ("sigma", 2))
    )
    sets = [_of_set(maps, name, delta[name], part) for name in maps.sets]
    pairs = [
        _squares(
            [one - sign * other for one, other in zip(delta[a], delta[b], strict=True)],
            np.add(variance[a], variance[b]),
        )
        for a, b, sign in maps.pairs
    ]
    return sets, pairs


def _of_set(maps: MapsOfSets, name: str, delta: Sequence[F64], part: Part) -> SetSums:
    before, after = delta
    good = np.isfinite(before) & np.isfinite(after)
    swept, halves = maps.sets[name], np.zeros((2, 3))
    variants = ArrayReader(maps.after / name / "batch_delta")
    steps = after - variants.read((0, variants.shape[0]), *part).astype(float)
    if swept.has_halves:
        steps = steps[HALVES:]
        halves = _of_halves(maps, name, np.where(good, 0.0, np.nan), part)
    total = after - before
    moved = [m[good] for m in (total, *steps, total - np.sum(steps, axis=0))]
    profiles = np.stack([np.where(good, values, 0.0) for values in (before, after, good)])
    return SetSums(
        int(good.sum()),
        np.array([[(m**2).sum(), np.abs(m).max(initial=0.0)] for m in moved]),
        profiles.sum(axis=2),
        profiles.sum(axis=1),
        halves,
        float((after[good] ** 2).sum()),
    )


def _of_halves(maps: MapsOfSets, name: str, masked: F64, part: Part) -> F64:
    """Sums of half the difference of the halves of the frames, which is the noise of the map."""
    batches, arrays = maps.batches(name), ("batch_delta", "batch_sigma")
    stored = [ArrayReader(maps.before / name / n).read((0, batches), *part) for n in arrays]
    parts = (slice(batches // 2), slice(batches // 2, None))
    before = zip(*(mean_of(stored[0][cut], stored[1][cut]) for cut in parts), strict=True)
    after = (ArrayReader(maps.after / name / n).read((0, HALVES), *part) for n in arrays)
    both = [(np.array([*d], float), np.array([*s], float)) for d, s in (before, after)]
    apart = [(delta[0] - delta[1]) / 2 + masked for delta, _ in both]
    return _squares(apart, [(sigma**2).sum(axis=0) / 4 for _, sigma in both])


def _squares(apart: Sequence[F64], expected: Sequence[F64] | F64) -> F64:
    """Sums (before or after; square, expected square, count) over pixels valid in all maps."""
    good = np.isfinite(np.stack([*apart, *expected])).all(axis=0)
    both = zip(apart, expected, strict=True)
    return np.array([[(a[good] ** 2).sum(), v[good].sum(), good.sum()] for a, v in both])


def _described(
    tiles: Sequence[SetSums], parts: Sequence[Part], shape: tuple[int, int]
) -> dict[str, Any]:
    rows, columns = (np.zeros((3, n)) for n in shape)
    for one, (y, x) in zip(tiles, parts, strict=True):
        rows[:, slice(*y)] += one.rows
        columns[:, slice(*x)] += one.columns
    pixels = sum(one.pixels for one in tiles)
    moved = np.stack([one.moved for one in tiles])
    squares, most = moved[..., 0].sum(axis=0), moved[..., 1].max(axis=0)
    change = [
        {"rms_px": float(np.sqrt(square / max(pixels, 1))), "max_px": float(largest)}
        for square, largest in zip(squares, most, strict=True)
    ]
    chance = np.sqrt(sum(one.square for one in tiles) * (PERIOD - 1)) / max(pixels, 1)
    halves = np.sum([one.halves for one in tiles], axis=0)
    return {
        "pixels": pixels,
        "change": change[0],
        "change_by_effect": change[1:-1],
        "change_on_samples": change[-1],
        "rows": _patterns(rows, float(chance)),
        "columns": _patterns(columns, float(chance)),
        "halves": _agreement(halves) if halves[:, 2].all() else None,
    }


def _patterns(profile: F64, chance: float) -> dict[str, Any] | None:
    """Rms (px) of the pattern of period `PERIOD`, and by chance; None in a small window."""
    if profile.shape[1] < 3 * PERIOD:
        return None
    before, after = map(repeating, profile[:2] / np.where(profile[2] > 0, profile[2], np.nan))
    return {"period_px": PERIOD, "before_px": before, "after_px": after, "chance_px": chance}


def repeating(profile: F64) -> float | None:
    """Rms of the part of a profile with period `PERIOD`; NaN are left out."""
    # First subtract slow changes: the mean over a period about each place, which is constant for a
    # repeating pattern.
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
    return float(np.std(means))


def _agreement(sums: F64) -> dict[str, float]:
    """Rms (px) before and after, and rms expected from the errors."""
    rms = np.sqrt(sums[:, :2] / np.maximum(sums[:, 2:], 1))
    names = ("before_px", "before_expected_px", "after_px", "after_expected_px")
    return dict(zip(names, rms.ravel().tolist(), strict=True))
