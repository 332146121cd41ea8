"""Coupling between pixels: a pixel loses what another receives, so the total is conserved.

Couplings are directed and sparse: the pixels of every n-th row and every m-th column give a share
of their signal to the pixel at a fixed step. Nothing crosses the edge of the window: a pixel whose
partner is outside keeps its signal (as at the edge of the chip).

Uniform light gives a uniform signal only if every pixel gains as much as it loses; a kernel that
differs from row to row leaves rows in a flat.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from pixcal.model.arrays import F64
from pixcal.model.config import quantity
from pixcal.model.errors import InputError

Place = tuple[slice, slice]

# most steps of the inverse; each gains a factor of one over the shares that leave a pixel
STEPS = 60
CONVERGED = 1e-13
# arrays up to this size have maps of shares: one step then is that of all sources of a distance
MAP_PIXELS = 1 << 17
FILL_PX = 2.0  # radius of the neighbourhood that replaces a pixel without data, px,
FILL_REACH = 16  # and how far it goes


@dataclass(frozen=True)
class Coupling:
    """A share of the signal of a class of pixels that is read at others.

    Rows and columns are counted from the window's first. The source loses this share.
    """

    dy: int = quantity(unit="px", low=-1024, high=1024, doc="rows from source to receiver")
    dx: int = quantity(unit="px", low=-1024, high=1024, doc="columns from source to receiver")
    share: float = quantity(
        low=-0.2, high=0.2, doc="share of the signal of the source, at small signals"
    )
    every_rows: int = quantity(1, low=1, high=1024, doc="period of the rows with sources")
    row: int = quantity(0, low=0, high=1023, doc="the first of these rows")
    every_columns: int = quantity(
        1, low=1, high=1024, doc="period of the columns that hold sources"
    )
    column: int = quantity(0, low=0, high=1023, doc="the first of these columns")
    per_ke: float = quantity(
        0.0, unit="1/ke-", low=-0.2, high=50.0,
        doc="relative change of the share with the source's signal",
    )  # fmt: skip

    def __post_init__(self) -> None:
        if self.dy == 0 and self.dx == 0:
            raise InputError(
                "dy and dx are both 0: a pixel does not couple to itself; give steps to another"
            )
        if self.row >= self.every_rows:
            raise InputError(f"row: {self.row} is not below every_rows ({self.every_rows})")
        if self.column >= self.every_columns:
            raise InputError(
                f"column: {self.column} is not below every_columns ({self.every_columns})"
            )

    def scaled(self, factor: float) -> "Coupling":
        """The same with another share."""
        return replace(self, share=self.share * factor)

    def places(self, shape: tuple[int, ...], first: tuple[int, int]) -> tuple[Place, Place]:
        """Source and receiver pixels that are both in a sub-window (y, x).

        ``first`` are its first row and column in the window.
        """
        rows = _spans(shape[0], first[0], self.every_rows, self.row, self.dy)
        columns = _spans(shape[1], first[1], self.every_columns, self.column, self.dx)
        return (rows[0], columns[0]), (rows[1], columns[1])


def _spans(size: int, first: int, every: int, at: int, step: int) -> tuple[slice, slice]:
    low, high = max(0, -step), size - max(0, step)
    begin = low + (at - first - low) % every
    if begin >= high:
        return slice(0, 0), slice(0, 0)
    return slice(begin, high, every), slice(begin + step, high + step, every)


@dataclass(frozen=True)
class _Step:
    """Transfer from sources to the pixels at one step (rows and columns)."""

    # sources, receivers, and the share of all of these, or of each (y, x), of the samples' type
    parts: tuple[tuple[Place, Place, Any], ...]
    per_ke: float


@lru_cache(maxsize=6)  # some megabytes each
def _steps(
    couplings: tuple[Coupling, ...], shape: tuple[int, ...], first: tuple[int, int],
    kind: np.dtype[Any],
) -> tuple[_Step, ...]:  # fmt: skip
    """Couplings in the order of their distances; one part per distance on small arrays."""
    alike: dict[tuple[int, int, float], list[Coupling]] = {}
    for c in couplings:
        if c.share != 0:
            alike.setdefault((c.dy, c.dx, c.per_ke), []).append(c)
    steps: list[_Step] = []
    for (dy, dx, per_ke), group in alike.items():
        parts = [(*c.places(shape, first), kind.type(c.share)) for c in group]
        if len(group) > 1 and shape[0] * shape[1] <= MAP_PIXELS:
            share, times = np.zeros(shape, kind), np.zeros(shape, int)
            for here, _, value in parts:
                share[here] = value
                times[here] += 1
            # Several shares of a pixel over one distance are given one after the other.
            if times.max(initial=0) == 1:
                here, there = Coupling(dy, dx, 0.0).places(shape, first)
                parts = [(here, there, share[here])]
        steps.append(_Step(tuple(parts), per_ke))
    return tuple(steps)


def couple(
    signal: NDArray[Any], couplings: Sequence[Coupling], first: tuple[int, int] = (0, 0)
) -> NDArray[Any]:
    """Signal (..., y, x) that is read, from the signal collected.

    In electrons where shares change with the signal, else in any unit; ``first`` is the array's
    first row and column in the window.
    """
    out = signal.copy()
    for step in _steps(tuple(couplings), signal.shape[-2:], first, signal.dtype):
        moved = []
        for here, _, share in step.parts:
            source = signal[(..., *here)]
            moved.append(source * share)
            if step.per_ke:
                moved[-1] *= 1 + source * signal.dtype.type(step.per_ke * 1e-3)
        _move(out, step, moved)
    return out


def _move(out: NDArray[Any], step: _Step, moved: Sequence[NDArray[Any]]) -> None:
    # All losses first, then all gains: the last bits do not depend on how sources are grouped.
    for (here, _, _), charge in zip(step.parts, moved, strict=True):
        out[(..., *here)] -= charge
    for (_, there, _), charge in zip(step.parts, moved, strict=True):
        out[(..., *there)] += charge


def couple_fringes(
    theta: F64, couplings: Sequence[Coupling], first: tuple[int, int] = (0, 0)
) -> F64:
    """Maps theta (3, y, x), e-, of a fit after the couplings (physics note, section 5).

    They are as collected: not divided by a flat. A share that changes with the signal is evaluated
    for frames of intensity and amplitude 1: the mean takes the mean of the squared signal, ``iota²
    + alpha² / 2``, the fringe its slope, ``2 iota alpha``; the second harmonic is not in the maps.
    """
    out = theta.copy()
    for step in _steps(tuple(couplings), theta.shape[1:], first, theta.dtype):
        moved = []
        for here, _, share in step.parts:
            source = theta[(slice(None), *here)]
            moved.append(share * source)
            if step.per_ke:
                iota, square = source[0], source[1] ** 2 + source[2] ** 2
                moved[-1][0] += share * step.per_ke * 1e-3 * (iota**2 + square / 2)
                moved[-1][1:] *= 1 + 2e-3 * step.per_ke * iota
        _move(out, step, moved)
    return out


def uncouple(
    signal: NDArray[Any],
    couplings: Sequence[Coupling],
    first: tuple[int, int] = (0, 0),
    steps: int = STEPS,
) -> NDArray[Any]:
    """Signal collected, from the signal that is read: the inverse of `couple`."""
    return _inverse(signal, lambda trial: couple(trial, couplings, first), steps)


def uncouple_fringes(
    theta: F64, couplings: Sequence[Coupling], first: tuple[int, int] = (0, 0)
) -> F64:
    """The inverse of `couple_fringes`."""
    return _inverse(theta, lambda trial: couple_fringes(trial, couplings, first))


def _inverse(
    data: NDArray[Any], forward: Callable[[NDArray[Any]], NDArray[Any]], steps: int = STEPS
) -> NDArray[Any]:
    """Inverse by fixed-point iteration: the remainder is added back."""
    # Each step shrinks the rest by the shares that leave a pixel: for a tenth, some 15 steps to the
    # last digit.
    inverse = data.copy()
    size = float(np.max(np.abs(data), initial=0.0))
    before = np.inf
    for _ in range(steps):
        rest = data - forward(inverse)
        left = float(np.max(np.abs(rest), initial=0.0))
        # A trial of couplings that grow steeply with the signal may have no inverse.
        if not left <= 2 * before:
            break
        inverse += rest
        if left <= CONVERGED * size:
            break
        before = left
    return inverse


def outflow(
    couplings: Sequence[Coupling], shape: tuple[int, ...], first: tuple[int, int] = (0, 0)
) -> F64:
    """Share (y, x) of its signal that each pixel loses."""
    out = np.zeros(shape)
    for c in couplings:
        out[c.places(shape, first)[0]] += c.share
    return out


def largest_outflow(couplings: Sequence[Coupling]) -> float:
    """Largest sum of absolute shares that can leave a pixel."""
    rows = {(c.every_rows, c.row, c.every_columns, c.column) for c in couplings}

    def meets(a: Coupling, of: tuple[int, int, int, int]) -> bool:
        return bool(
            (a.row - of[1]) % np.gcd(a.every_rows, of[0]) == 0
            and (a.column - of[3]) % np.gcd(a.every_columns, of[2]) == 0
        )

    return max((sum(abs(c.share) for c in couplings if meets(c, of)) for of in rows), default=0.0)


def noise_shares(
    couplings: Sequence[Coupling], shape: tuple[int, ...], first: tuple[int, int] = (0, 0)
) -> tuple[F64, F64]:
    """Noise of a pixel read through the couplings, and after their correction, both (y, x).

    The first is the variance for shot noise of 1 in every pixel; the second that of read noise of 1
    after the inverse, to second order in the shares.
    """
    kept, got = 1 - outflow(couplings, shape, first), np.zeros(shape)
    for c in couplings:
        got[c.places(shape, first)[1]] += c.share**2
    return kept**2 + got, 1 / kept**2 + got


def filled(theta: F64, k: tuple[float, float]) -> F64:
    """Maps (3, y, x) with NaN taken from neighbours, turned as fringes of vector k (rad/px) are."""
    good = np.isfinite(theta).all(axis=0)
    if good.all() or not good.any():
        return np.where(good, theta, 0.0)
    ny, nx = good.shape
    carrier = np.exp(1j * (k[1] * np.arange(ny)[:, None] + k[0] * np.arange(nx)))
    iota = np.where(good, theta[0], 0.0)
    fringe = np.where(good, theta[2] + 1j * theta[1], 0.0) * carrier.conj()
    around = {"sigma": FILL_PX, "mode": "constant", "truncate": FILL_REACH / FILL_PX}
    weight = np.maximum(gaussian_filter(good.astype(float), **around), 1e-300)
    smooth = gaussian_filter(fringe.real, **around) + 1j * gaussian_filter(fringe.imag, **around)
    smooth = smooth / weight * carrier
    light = gaussian_filter(iota, **around) / weight
    return np.where(good, theta, np.stack([light, smooth.imag, smooth.real]))
