"""Pairs of pixels that may couple, and classes of pixels that may couple in the same way."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from pixcal.kernels.crosstalk import Coupling
from pixcal.model.arrays import F32, F64, Indices

Place = tuple[int, int]

REACH = 5  # rows and columns within which couplings are sought
MAX_PERIOD = 8  # longest period of a kernel, rows and columns
MAX_CLASSES = 16  # most classes of pixels that a period in both directions may make
MIN_REPEATS = 4  # periods that the window must hold at least


def links(shape: tuple[int, ...], reach: int = REACH) -> tuple[Place, ...]:
    """Steps (dy, dx) from a pixel to a partner; the opposite ones are the same pairs."""
    high, wide = min(reach, shape[0] // 2), min(reach, shape[1] // 2)
    steps = product(range(high + 1), range(-wide, wide + 1))
    return tuple(step for step in steps if step > (0, 0))


@dataclass(frozen=True)
class PixelClasses:
    """Pixels whose row and column have the same remainder modulo the period."""

    rows: int  # rows, columns: period
    columns: int
    first: Place  # first row and column of the arrays, in the window

    @property
    def count(self) -> int:
        """Number of classes."""
        return self.rows * self.columns

    def of(self, y: Indices, x: Indices) -> Indices:
        """Class of pixels of the arrays."""
        row, column = (y + self.first[0]) % self.rows, (x + self.first[1]) % self.columns
        return np.asarray(row * self.columns + column)


def couplings_of(classes: PixelClasses, links: Iterable[Place]) -> tuple[Coupling, ...]:
    """Couplings over each link, there and back, of each class of pixels; without their shares."""
    couplings = []
    for (dy, dx), (row, column) in product(links, np.ndindex(classes.rows, classes.columns)):
        period = {"every_rows": classes.rows, "every_columns": classes.columns}
        couplings.append(Coupling(dy, dx, 0.0, row=row, column=column, **period))
        # From the partner, which is of another class.
        partner = {"row": (row + dy) % classes.rows, "column": (column + dx) % classes.columns}
        couplings.append(Coupling(-dy, -dx, 0.0, **partner, **period))
    return tuple(couplings)


def shares_of(every: Iterable[Coupling], known: Iterable[Coupling]) -> F64:
    """Shares of all couplings, given those of some, whose periods may be shorter."""

    def same(c: Coupling, k: Coupling) -> bool:
        own = c.dy, c.dx, c.row % k.every_rows, c.column % k.every_columns
        return own == (k.dy, k.dx, k.row, k.column)

    known = tuple(known)
    return np.array([sum(k.share for k in known if same(c, k)) for c in every], float)


def periods(shape: tuple[int, ...]) -> list[Place]:
    """Periods (rows, columns) that fit a window, the shortest first."""
    rows = range(1, max(1, min(MAX_PERIOD, shape[0] // MIN_REPEATS)) + 1)
    columns = range(1, max(1, min(MAX_PERIOD, shape[1] // MIN_REPEATS)) + 1)
    both = ((n, m) for n in rows for m in columns if n * m <= MAX_CLASSES)
    return sorted(both, key=lambda p: (p[0] * p[1], p))


def class_sums(
    values: F32 | F64, first: Place, only: Place | None = None
) -> Iterator[tuple[PixelClasses, F64]]:
    """Sums (..., class) of maps (..., y, x) over the pixels of each class, for every period.

    ``only``: for this period.
    """
    # Rows first, then columns of those sums: row periods dominate the cost.
    wanted = periods(values.shape[-2:]) if only is None else [only]
    by_rows: dict[int, F32 | F64] = {}
    for n in sorted({n for n, _ in wanted}, reverse=True):
        # Sums for a multiple of the period are fewer to add up.
        multiple = next((sums for longer, sums in by_rows.items() if longer % n == 0), None)
        source, start = (values, first[0]) if multiple is None else (multiple, 0)
        sums = [source[..., (a - start) % n :: n, :].sum(-2, dtype=float) for a in range(n)]
        by_rows[n] = np.stack(sums, -2)
    for n, m in wanted:
        rows = by_rows[n]
        both = np.stack([rows[..., (b - first[1]) % m :: m].sum(-1) for b in range(m)], -1)
        yield PixelClasses(n, m, first), both.reshape(*both.shape[:-2], n * m)
