"""Errors of the corrected offsets from the errors of an effect's parameters."""

from collections.abc import Mapping
from contextlib import suppress
from functools import partial

import numpy as np

from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.fringe_fit.modes import solve_modes
from pixcal.estimators.maps.corrected import phase_change, straight_modes
from pixcal.model.arrays import F64, Mask
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, FringeMaps
from pixcal.simulation.forward import numbers, with_numbers
from pixcal.stages.correct.sweep_to_correct import Swept, corrected, maps_of
from pixcal.stages.fit.scouting import scout_tiles

PIXEL_BYTES = 500  # peak memory of a tile's task per pixel, surroundings included (measured),
EFFECT_BYTES = 40  # per effect,
SLOPE_BYTES = 24  # and per parameter with a slope


def moved(effect: Effect, errors: Mapping[str, float]) -> list[Effect]:
    """The effect with each parameter moved by its error; keys as in ``couplings[0].share``."""
    variants: list[Effect] = []
    values = numbers(effect)
    for name in (name for name in errors if name in values):
        for value in (values[name] + errors[name], values[name] - errors[name]):
            with suppress(InputError):
                other = with_numbers(effect, {name: value})
                # Outside the range of the parameter: try the other side.
                if numbers(other)[name] == value:
                    variants.append(other)
                    break
    return variants


def parameter_errors(swept: Swept, runtime: Runtime) -> dict[str, float | None]:
    """Rms error (px) of a set's offsets from each effect's parameters; None without errors."""
    tiles = scout_tiles(swept.source.grid, 9)  # spread over the window
    runtime = within_memory("errors of the parameters", task_bytes(swept), 0, runtime)
    total = np.sum(run_tasks(partial(_tile, swept), tiles, runtime, label="parameters"), axis=0)
    return {
        t.effect.name: float(np.sqrt(square / max(count, 1))) if t.errors else None
        for t, (square, count) in zip(swept.treatments, total, strict=True)
    }


def task_bytes(swept: Swept) -> int:
    """Peak memory of a task that corrects a tile and computes the slopes of the parameters."""
    slopes = [0 if t.covariance is None else len(t.covariance) for t in swept.treatments]
    cy, cx = swept.source.signal.chunks[1:]
    pixel = PIXEL_BYTES + EFFECT_BYTES * len(slopes) + SLOPE_BYTES * max(slopes, default=0)
    return (cy + 2 * swept.halo) * (cx + 2 * swept.halo) * pixel


def _tile(swept: Swept, at: tuple[int, int]) -> list[tuple[float, int]]:
    """Sum of squares (px²) and pixels, for each effect."""
    y, x = swept.source.ranges(at)
    inside = swept.inside(y, x)
    maps, good, _ = maps_of(swept, swept.around(y, x))
    size = float(np.hypot(*swept.k))
    some = good[inside]
    return [
        (float(variance[some].sum()) / size**2, int(some.sum()))
        for variance in parameter_variance(swept, maps, good, inside)
    ]


def parameter_variance(
    swept: Swept, maps: FringeMaps, good: Mask, inside: tuple[slice, slice]
) -> list[F64]:
    """Variance of the phase (y, x), rad², from the errors of each effect's parameters.

    With covariances if these and `Effect.phase_slopes` are known, else parameter by parameter;
    without the modes that the fit removes from the tile ``inside`` the maps.
    """
    variances = []
    for treatment in swept.treatments:
        effect, covariance = treatment.effect, treatment.covariance
        after, _ = corrected(maps, (effect,))
        theta = after.theta[(slice(None), *inside)]
        slopes = None if covariance is None else effect.phase_slopes(after)
        if covariance is None or slopes is None:
            perturbed = moved(effect, treatment.errors)
            steps = [o for other in perturbed if (o := other.undo(maps)) is not None]
            slopes = np.array([phase_change(after.theta, o.theta) for o in steps])
            covariance = np.eye(len(steps))
        variance = np.zeros(theta.shape[1:])
        if len(slopes):
            modes = straight_modes(theta, swept.k).reshape(-1, variance.size)
            change = slopes[(slice(None), *inside)].reshape(len(slopes), -1)
            use = good[inside].ravel()
            taken = solve_modes(modes[:, use] @ modes[:, use].T, modes[:, use] @ change[:, use].T)
            change = change - taken.T @ modes
            variance = np.einsum("np,np->p", covariance @ change, change).reshape(variance.shape)
        variances.append(variance)
        maps = after
    return variances
