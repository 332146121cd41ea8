"""What couplings do to the covariance of neighbours beyond the first order of their shares."""

from collections.abc import Sequence
from dataclasses import replace
from math import lcm

import numpy as np

from pixcal.estimators.crosstalk.covariance import NORMAL, TERMS, Products
from pixcal.estimators.crosstalk.links import Place
from pixcal.estimators.crosstalk.residuals import UNIT
from pixcal.kernels.crosstalk import Coupling, outflow
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F64

_ONE_LAW = (0, 1, 2, 4)  # `TERMS` without brighter-fatter's own


def to_first_order(
    found: Products, couplings: Sequence[Coupling], links: Sequence[Place], first: Place
) -> Products:
    """Products from which shares follow to first order, from those that are measured.

    A pixel keeps less than all of its charge, so that ``k (1 - outflow)`` is measured; a third
    pixel that gives to both partners adds the product of its shares; shares that change with the
    charge, all alike, add to the square of it; and all are measured in the shot noise of a pixel.
    ``first`` are the first row and column of the arrays in the window.
    """
    shape = (found.right.shape[-2], found.right.shape[-1])
    right = found.right / np.float32(found.shot)
    kept = 1 - outflow(couplings, shape, first)
    third = _third_pixels(couplings, shape, first)
    falls = 2 * _per_unit(couplings)
    for n, step in enumerate(links):
        there, back = np.zeros(shape), np.zeros(shape)
        for c in couplings:
            here, receiver = c.places(shape, first)
            if (c.dy, c.dx) == step:
                there[here] += c.share
            elif (-c.dy, -c.dx) == step:
                back[receiver] += c.share
        # Beyond the border there are no products, so that what rolls over does not count.
        partner = np.roll(kept, (-step[0], -step[1]), (0, 1))
        shared = third.get(step, np.zeros(shape)) / 2
        offsets = {0: there * (kept - 1) + shared, 1: back * (partner - 1) + shared}
        if falls:
            both = there * kept + back * partner
            offsets[3] = falls * (there * (kept - 1) + back * (partner - 1))
            offsets[4] = falls * (both / 2 + 2 * shared)
        for i in range(TERMS):
            for j, offset in offsets.items():
                right[n, i] -= found.normal[n, NORMAL[min(i, j), max(i, j)]] * offset
    return replace(found, right=right)


def level_dependence(
    found: Products, couplings: Sequence[Coupling], links: Sequence[Place]
) -> tuple[float, float]:
    """Relative change of the shares with the source's charge, 1/ke-, and its error.

    Beside what the couplings have already. From covariance that rises with the square of the charge
    otherwise than the variance does: a bent response makes less of both alike. ``found``: as
    `to_first_order` gives it.
    """
    sizes = {(c.dy, c.dx): 0.0 for c in couplings}
    lost = got = 0.0
    for c in couplings:
        some = 1 / (c.every_rows * c.every_columns)
        sizes[c.dy, c.dx] += some * c.share
        lost, got = lost + some * c.share, got + some * c.share**2
    right = weight = 0.0
    for n, (dy, dx) in enumerate(links):
        slope = (sizes.get((dy, dx), 0.0) + sizes.get((-dy, -dx), 0.0)) * UNIT * 1e-3
        if not slope:
            continue
        sums = found.normal[n].sum(axis=(1, 2), dtype=float)
        normal = np.array(
            [[sums[NORMAL[min(i, j), max(i, j)]] for j in _ONE_LAW] for i in _ONE_LAW]
        )
        covariance = inverse_normal(normal)
        value = float(covariance[-1] @ found.right[n, list(_ONE_LAW)].sum(axis=(1, 2), dtype=float))
        right += slope * value / float(covariance[-1, -1])
        weight += slope**2 / float(covariance[-1, -1])
    if not weight:
        return 0.0, np.inf
    # The slope of the variance of a pixel that loses less at high charge, beside what others give.
    own = 4 * _per_unit(couplings) * (got - lost * (1 - lost)) / ((1 - lost) ** 2 + got)
    per_ke = 1 / (2 * UNIT * 1e-3)
    more = right / weight - (found.curve - own) * per_ke
    # Terms of higher order, with the square of the level dependence, are of this size.
    beyond = lost * (couplings[0].per_ke + more)
    return more, float(np.linalg.norm([weight**-0.5, found.curve_error * per_ke, beyond]))


def _per_unit(couplings: Sequence[Coupling]) -> float:
    """Relative change of the shares, which all have in common, 1/(10⁴ e-)."""
    return couplings[0].per_ke * UNIT * 1e-3 if couplings else 0.0


def _third_pixels(couplings: Sequence[Coupling], shape: Place, first: Place) -> dict[Place, F64]:
    """By step: at the first pixel of a link, product of what both partners get of a third.

    Of one period of the kernel, repeated over the piece: third pixels beyond it count as well.
    """
    period = lcm(*(c.every_rows for c in couplings)), lcm(*(c.every_columns for c in couplings))
    given: dict[Place, F64] = {}
    for c in couplings:
        rows = slice((c.row - first[0]) % c.every_rows, None, c.every_rows)
        columns = slice((c.column - first[1]) % c.every_columns, None, c.every_columns)
        given.setdefault((c.dy, c.dx), np.zeros(period))[rows, columns] += c.share
    found: dict[Place, F64] = {}
    for a, of_a in given.items():
        for b, of_b in given.items():
            step = (b[0] - a[0], b[1] - a[1])
            if step > (0, 0):
                product = np.roll(of_a * of_b, a, (0, 1))
                found[step] = found.get(step, 0.0) + product
    repeats = -(-shape[0] // period[0]), -(-shape[1] // period[1])
    return {s: np.tile(own, repeats)[: shape[0], : shape[1]] for s, own in found.items()}
