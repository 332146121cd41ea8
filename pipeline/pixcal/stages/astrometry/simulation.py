"""Simulated stars, each observed and fitted at several dithered positions."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.star_centroids.centroids import Star
from pixcal.stages.astrometry.detector import Patch, PixelPositions, generator

F64 = NDArray[np.float64]

BATCH = 16  # stars of a task
# a place is not used where masked pixels would tell more than so much of the position
MOST_LOST = 0.1
# errors of a star at a place: pixels taken for a perfect grid, or where the maps say; without and
# with photon noise; and the first two as `centroids.Star.weights` predicts them
KINDS = ("perfect", "measured", "perfect_photons", "measured_photons", "linear", "linear_measured")


@dataclass(frozen=True)
class Observation:
    """What is observed."""

    star: Star
    stars: int
    positions: int  # places of each star
    dither: float  # they lie within so many px of the first, along x and y


def observe(detector: PixelPositions, plan: Observation, runtime: Runtime) -> F64:
    """Observe and fit stars all over the detector.

    Returns
    -------
    (star, position, kind, component) float64
        Errors of the centroids along the components' axes, px; NaN at places that are not used,
        and where a fit has failed.
    """
    batches = [range(n, min(n + BATCH, plan.stars)) for n in range(0, plan.stars, BATCH)]
    errors = run_tasks(partial(_batch, detector, plan), batches, runtime, label="stars")
    return np.concatenate(errors)


def core_weights(star: Star, axes: F64) -> F64:
    """Weight of each pixel in the centroid of a centred star, (component, y, x), sum 1."""
    weights = -star.weights(np.zeros(2))
    return np.asarray(np.einsum("ka,abyx,kb->kyx", axes, weights, axes))


def _batch(detector: PixelPositions, plan: Observation, stars: range) -> F64:
    core = core_weights(plan.star, detector.axes)
    return np.stack([_star(detector, plan, core, n) for n in stars])


def _star(detector: PixelPositions, plan: Observation, core: F64, number: int) -> F64:
    """Errors of one star (position, kind, component)."""
    star, half, axes = plan.star, plan.star.half, detector.axes
    rng = generator(detector.seed, 2, number)
    # The whole window lies on the detector.
    first = np.full(2, half - 0.5)
    last = np.array(detector.shape[::-1]) - half - 0.5
    middle = rng.uniform(first, last)
    low, high = np.maximum(first, middle - plan.dither), np.minimum(last, middle + plan.dither)
    at = rng.uniform(low, high, (plan.positions, 2))
    at[0] = middle
    pixel = np.floor(at + 0.5).astype(int)
    corner, end = pixel.min(axis=0) - half, pixel.max(axis=0) + half + 1
    patch = detector.patch((corner[1], end[1]), (corner[0], end[0]))
    windows = _windows(patch, pixel - corner, half)
    errors = _errors(star, at - pixel, windows, axes, rng)
    lost = np.einsum("kyx,nyx->nk", core, ~windows.good)
    errors[(lost > MOST_LOST).any(axis=1)] = np.nan
    return errors


def _windows(patch: Patch, middle: NDArray[np.int64], half: int) -> Patch:
    """Windows about some pixels (x, y) of a patch, the number of the star before other axes."""
    cut = [
        (slice(y - half, y + half + 1), slice(x - half, x + half + 1)) for x, y in middle.tolist()
    ]
    return Patch(
        np.stack([patch.true[:, *at] for at in cut]),
        np.stack([patch.known[:, *at] for at in cut]),
        np.stack([patch.good[at] for at in cut]),
    )


def _errors(star: Star, place: F64, windows: Patch, axes: F64, rng: np.random.Generator) -> F64:
    """Errors of the fits of some stars, (star, kind, component)."""
    true, known = (np.einsum("nkyx,ka->nayx", d, axes) for d in (windows.true, windows.known))
    mean = star.expected(place, true)
    noise = np.sqrt(star.read_variance) * rng.standard_normal(mean.shape)
    noisy = rng.poisson(np.maximum(mean, 0.0)) + noise
    errors = [
        star.fit(data, grid, windows.good)[:, :2] - place
        for data in (mean, noisy)
        for grid in (np.zeros_like(known), known)
    ]
    weights = np.stack([star.weights(p, g) for p, g in zip(place, windows.good, strict=True)])
    errors += [
        np.einsum("nabyx,nbyx->na", weights, displacement) for displacement in (true, true - known)
    ]
    return np.asarray(np.einsum("jna,ka->njk", np.stack(errors), axes))
