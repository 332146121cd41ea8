"""What couplings do to the covariance of neighbours beyond the first order of their shares."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixcal.estimators.crosstalk.covariance import NORMAL, TERMS, Products
from pixcal.estimators.crosstalk.links import Place
from pixcal.estimators.crosstalk.residuals import UNIT
from pixcal.kernels.crosstalk import Coupling, outflow
from pixcal.model.arrays import F64


def to_first_order(
    found: Products, couplings: Sequence[Coupling], links: Sequence[Place], first: Place
) -> Products:
    """Products from which shares follow to first order, from those that are measured.

    A pixel keeps less than all of its charge, so that ``k (1 - outflow)`` is measured; a third
    pixel that gives to both partners adds the product of its shares; a share that changes with the
    charge adds to the square of it; and all are measured in the shot noise of a pixel. ``first``
    are the first row and column of the arrays in the window.
    """
    shape = (found.right.shape[-2], found.right.shape[-1])
    right = found.right / np.float32(found.shot)
    kept = 1 - outflow(couplings, shape, first)
    third = _third_pixels(couplings, shape, first)
    for n, step in enumerate(links):
        there, back, curved = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        for c in couplings:
            here, receiver = c.places(shape, first)
            if (c.dy, c.dx) == step:
                there[here] += c.share
                curved[here] += 2 * c.share * c.per_ke * UNIT * 1e-3
            elif (-c.dy, -c.dx) == step:
                back[receiver] += c.share
                curved[receiver] += 2 * c.share * c.per_ke * UNIT * 1e-3
        # Beyond the border there are no products, so that what rolls over does not count.
        partner = np.roll(kept, (-step[0], -step[1]), (0, 1))
        shared = third.get(step, np.zeros(shape)) / 2
        offsets = {0: there * (kept - 1) + shared, 1: back * (partner - 1) + shared, 4: curved / 2}
        for i in range(TERMS):
            for j, offset in offsets.items():
                right[n, i] -= found.normal[n, NORMAL[min(i, j), max(i, j)]] * offset
    return replace(found, right=right)


def _third_pixels(couplings: Sequence[Coupling], shape: Place, first: Place) -> dict[Place, F64]:
    """By step: at the first pixel of a link, product of what both partners get of a third."""
    given = []
    for c in couplings:
        source = np.zeros(shape)
        source[c.places(shape, first)[0]] = c.share
        given.append(source)
    found: dict[Place, F64] = {}
    for a, of_a in zip(couplings, given, strict=True):
        for b, of_b in zip(couplings, given, strict=True):
            step = (b.dy - a.dy, b.dx - a.dx)
            if step > (0, 0):
                product = np.roll(of_a * of_b, (a.dy, a.dx), (0, 1))
                found[step] = found.get(step, np.zeros(shape)) + product
    return found
