"""Transfer of charge out of the pixels, which leaves some of it behind."""

import numpy as np

from pixcal.model.arrays import F32


def left_behind(charge: F32, share: F32, begins: F32, weights: F32, normal: F32) -> F32:
    """Electrons that stay in each pixel, each by its own chance: binomial, as a normal variate.

    Parameters
    ----------
    charge : (y, x) e-
    share : (y, x) chance of an electron, on the mean
    begins, weights : (band,) where bands of the charge begin (e-), and the chance in each over the
        mean one
    normal : (y, x) standard normals; zero for the mean
    """
    ends = (*begins[1:], np.float32(np.inf))
    mean = np.zeros_like(charge)
    for n, (begin, end, weight) in enumerate(zip(begins, ends, weights, strict=True)):
        part = np.minimum(charge, end) - begin
        # The first band holds all below the second one.
        mean += weight * (part if n == 0 else np.maximum(part, 0))
    mean *= share
    scatter = np.sqrt(np.maximum(mean * (1 - share), 0))
    found: F32 = np.clip(mean + scatter * normal, 0, np.maximum(charge, 0))
    return found


def fill_traps(taken: F32, keep: float, most: float) -> tuple[F32, F32]:
    """Net loss of each frame (t, ...), and what comes out with it, as traps fill and empty; e-.

    ``taken`` is the charge that empty traps would take. Of what they hold they keep a part from
    frame to frame; they take a frame's share of the charge until they hold the ``most``.
    """
    lost, released = np.empty_like(taken), np.empty_like(taken)
    held, part = np.zeros_like(taken[0]), np.float32(keep)
    for t in range(len(taken)):
        left = part * held
        after = np.minimum(left + taken[t], np.float32(most))
        lost[t], released[t], held = after - held, held - left, after
    return lost, released
