"""Fields of a detector that the foundry stitched from masks with small misalignments.

A field displaces all its pixels equally: offsets have steps along a grid of rows and columns, which
contribute to every smooth pattern. With the fields known, the offset of each is a free term of a
fit. Lines are found one by one, by the score test of an independent step in every field that a line
would cut, with smooth terms and the present fields free.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import chdtrc

from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F64, Indices, Mask

MIN_SIDE = 4  # least side of a field, px
USUAL_SIDE = 12  # least mean side, px: more lines than that are a pattern, not stitching
FALSE_ALARM_RATE = 1e-3  # of a line anywhere in a map of white noise without steps
_ROUNDS = 3  # iterations in which each line is sought again given all others
# share of a step's information, and number of pixels, that regularise its normal matrix where
# smooth terms absorb the step, or no pixel is good
_STEADY, _PIXELS = 1e-6, 1e-9

Lines = tuple[tuple[int, ...], tuple[int, ...]]  # first row, and first column, of later fields


def fields(maps: Sequence[F64], free: Sequence[F64]) -> Indices:
    """Number (y, x) of the field of each pixel; all zeros without significant steps.

    ``maps``: (y, x) each, with white noise and steps along the same lines; NaN where masked.
    ``free``: (term, y, x) free smooth patterns of each map, without the constant.
    """
    shape = maps[0].shape
    lines: Lines = ((), ())
    while (more := _with_line(maps, free, lines, (0, 1))) != lines:
        lines = more
        if any(len(places) * USUAL_SIDE > n for places, n in zip(lines, shape, strict=True)):
            return _numbers(shape, ((), ()))
    for _ in range(_ROUNDS):
        before = lines
        # A line found early may be superfluous or displaced once all are found.
        for axis in (0, 1):
            for place in before[axis]:
                others = _replaced(lines, axis, set(lines[axis]) - {place})
                lines = _with_line(maps, free, others, (axis,))
        if lines == before:
            break
    return _numbers(shape, lines)


def _replaced(lines: Lines, axis: int, places: Iterable[int]) -> Lines:
    ordered = tuple(sorted(places))
    return (ordered, lines[1]) if axis == 0 else (lines[0], ordered)


def _with_line(
    maps: Sequence[F64], free: Sequence[F64], lines: Lines, axes: Sequence[int]
) -> Lines:
    """Lines, and the best further one along given axes if it is significant."""
    field = _numbers(maps[0].shape, lines)
    fits = [FieldFit.of(values, terms, field) for values, terms in zip(maps, free, strict=True)]
    by_axis = {axis: _best_line(fits, lines, axis) for axis in axes}
    axis = min(by_axis, key=lambda one: by_axis[one])
    log_chance, _, place = by_axis[axis]
    if log_chance > np.log(FALSE_ALARM_RATE):
        return lines
    return _replaced(lines, axis, {*lines[axis], place})


def within(columns: F64, field: Indices) -> F64:
    """Columns (pixel, n) less their means in each field (pixel,)."""
    count = np.maximum(np.bincount(field), 1)
    means = np.stack([np.bincount(field, column) / count for column in columns.T], axis=1)
    return np.asarray(columns - means[field])


def _numbers(shape: tuple[int, ...], lines: Lines) -> Indices:
    row, column = (
        np.searchsorted(places, np.arange(n), side="right")
        for places, n in zip(lines, shape, strict=True)
    )
    return np.asarray(row[:, None] * (len(lines[1]) + 1) + column)


@dataclass(frozen=True)
class FieldFit:
    """Terms fitted to a map together with an offset of each field."""

    values: F64  # (term,) coefficients
    covariance: F64  # (term, term) for a noise variance of 1 per pixel
    # (1 + term, y, x) residual map, then the terms without field means; zero where masked
    columns: F64
    good: Mask
    steps: F64  # (y, x) offset of the field of each pixel; zero where all are masked
    dof: int  # number of good pixels minus that of fitted parameters

    @classmethod
    def of(cls, values: F64, terms: F64, field: Indices) -> "FieldFit":
        """Fit terms (term, y, x) to a map (y, x), NaN masked, with fields (y, x)."""
        good = np.isfinite(values)
        # All pixels, zero where masked: selecting the good ones would take longer than the fit.
        used, number = good.ravel().astype(float), field.ravel()
        columns = np.concatenate([np.where(good, values, 0.0)[None], terms]).reshape(-1, good.size)
        columns[1:] *= used
        count = np.bincount(number, used)
        sums = np.stack([np.bincount(number, column) for column in columns])
        means = sums / np.maximum(count, 1)
        columns -= means[:, number] if len(count) > 1 else means
        columns *= used
        inside = columns[1:]
        covariance = inverse_normal(inside @ inside.T)
        size = covariance @ (inside @ columns[0])
        columns[0] -= size @ inside
        steps = means[0] - size @ means[1:]
        dof = int(good.sum()) - len(size) - int(np.count_nonzero(count))
        shaped = columns.reshape(-1, *good.shape)
        return cls(size, covariance, shaped, good, steps[field], dof)

    @property
    def variance(self) -> float:
        """Residual variance of a pixel."""
        return float((self.columns[0] ** 2).sum()) / max(self.dof, 1)

    @property
    def rest(self) -> F64:
        """Residual map (y, x); NaN where masked."""
        return np.where(self.good, self.columns[0], np.nan)

    def turned(self) -> "FieldFit":
        """The fit with rows and columns exchanged."""
        return replace(
            self, columns=self.columns.swapaxes(1, 2), good=self.good.T, steps=self.steps.T
        )

    def gains(self, begin: Indices, first: int, places: Indices, last: int) -> F64:
        """Chi-square (place,) of a line before each column, with a step in each row of fields."""
        inside = slice(first, last)
        sums = np.add.reduceat(self.columns[:, :, inside], begin, axis=1).cumsum(axis=2)
        count = np.add.reduceat(self.good[:, inside], begin, axis=0, dtype=float).cumsum(axis=1)
        left, whole = count[:, places - first - 1], count[:, -1:]
        size = left * (whole - left) / np.maximum(whole, 1)
        step, shared = np.split(np.moveaxis(sums[:, :, places - first - 1], 2, 0), [1], axis=1)
        normal = np.eye(len(begin)) * ((1 + _STEADY) * size.T + _PIXELS)[:, None, :]
        normal -= shared.swapaxes(1, 2) @ (self.covariance @ shared)
        right = step[:, 0, :, None]
        gains = (right * np.linalg.solve(normal, right)).sum(axis=(1, 2))
        return np.asarray(gains / max(self.variance, 1e-300))


def _best_line(fits: Sequence[FieldFit], lines: Lines, axis: int) -> tuple[float, float, int]:
    """Best new line along an axis: logarithm of its chance, minus its gain, its place."""
    begin = np.array([0, *lines[1 - axis]])
    turned = [one.turned() if axis == 0 else one for one in fits]
    end = turned[0].good.shape[1]
    gains = np.full(end, -np.inf)
    edges = [0, *lines[axis], end]
    for first, last in pairwise(edges):
        places = np.arange(first + MIN_SIDE, last - MIN_SIDE + 1)
        if len(places):
            gains[places] = sum(one.gains(begin, first, places, last) for one in turned)
    place = int(np.argmax(gains))
    if not np.isfinite(gains[place]):
        return 0.0, 0.0, 0
    chance = float(chdtrc(len(begin) * len(fits), gains[place]))
    log_chance = math.log(chance) if chance > 0 else -math.inf
    # Where the chance underflows, the gain decides.
    return log_chance + float(np.log(sum(turned[0].good.shape))), -float(gains[place]), place
