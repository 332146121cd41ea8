"""What the errors of an effect's parameters leave in the corrected offsets."""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.effects import parse_effects
from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.corrected import phase_change, straight_modes
from pixcal.estimators.modes import solve_modes
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect
from pixcal.stages.correct.swept import Swept, maps_of, undone
from pixcal.stages.correct.undoing import PIXEL_BYTES
from pixcal.stages.fit.scouting import scout_tiles

F64 = NDArray[np.float64]

TILES = 9
"""Tiles, spread over the window, that tell for all: errors of parameters repeat over it."""


def moved(effect: Effect, errors: Mapping[str, float]) -> list[Effect]:
    """The effect with each of its parameters in turn off by its error.

    Parameters
    ----------
    effect : Effect
    errors : mapping
        1-sigma errors by the parameters' names, such as ``couplings[0].share``.
    """
    found: list[Effect] = []
    for name, error in errors.items():
        for step in (error, -error):
            plain = to_plain(effect)
            try:
                _add(plain, re.findall(r"\w+", name), step)
                found += parse_effects({effect.name: plain}, name, {effect.name: type(effect)})
            except (InputError, LookupError, TypeError):
                continue  # beyond what the parameter may be: to the other side
            break
    return found


def _add(plain: Any, path: Sequence[str], step: float) -> None:
    """Add to a number of nested plain data."""
    first, *rest = path
    key: Any = int(first) if isinstance(plain, list) else first
    if rest:
        _add(plain[key], rest, step)
    else:
        plain[key] += step


def parameter_errors(
    swept: Swept,
    errors: Mapping[str, Mapping[str, float]],
    runtime: Runtime,
    covariances: Mapping[str, F64] = {},
) -> dict[str, float | None]:
    """Rms (px) of what the errors of each effect's parameters leave in the offsets of a set.

    Where their covariance is known and the effect tells what each does (`Effect.phase_slopes`), all
    together; else parameters are moved one by one, and what each does is added in squares.

    Parameters
    ----------
    swept : Swept
    errors : mapping
        By effect, then by parameter.
    runtime : Runtime
    covariances : mapping
        By effect: of all parameters that have slopes.

    Returns
    -------
    dict
        By effect; None where no errors are given.
    """
    others = {e.name: moved(e, errors.get(e.name, {})) for e in swept.effects}
    tiles = scout_tiles(swept.source.grid, TILES)
    cy, cx = swept.source.signal.chunks[1:]
    need = (cy + 2 * swept.halo) * (cx + 2 * swept.halo) * PIXEL_BYTES
    plan = make_plan("errors of the parameters", need, 0, runtime)
    told = run_tasks(
        partial(_tile, swept, others, covariances),
        tiles,
        runtime.with_workers(plan.workers),
        label="parameters",
    )
    total = np.sum(told, axis=0)
    return {
        name: float(np.sqrt(square / max(count, 1))) if others[name] else None
        for name, (square, count) in zip(others, total, strict=True)
    }


def _tile(
    swept: Swept,
    others: Mapping[str, Sequence[Effect]],
    covariances: Mapping[str, F64],
    at: tuple[int, int],
) -> list[tuple[float, int]]:
    """Sum of squares (px²) and pixels, for each effect."""
    y, x = swept.source.ranges(at)
    part = swept.around(y, x)
    inside = swept.inside(y, x)
    maps, good, _ = maps_of(swept, part)
    size = float(np.hypot(*swept.k))
    found = []
    for effect in swept.effects:
        after, _ = undone(maps, (effect,))
        modes = straight_modes(after.theta[(slice(None), *inside)], swept.k)[:, good[inside]]
        covariance = covariances.get(effect.name)
        slopes = None if covariance is None else effect.phase_slopes(after)
        if covariance is None or slopes is None:
            steps = [o for other in others[effect.name] if (o := other.undo(maps)) is not None]
            slopes = np.array([phase_change(after.theta, o.theta) for o in steps])
            covariance = np.eye(len(steps))
        square = 0.0
        if len(slopes):
            change = slopes[(slice(None), *inside)][:, good[inside]] / size
            change -= solve_modes(modes @ modes.T, modes @ change.T).T @ modes
            square = float(np.einsum("np,np->", covariance @ change, change))
        found.append((square, int(good[inside].sum())))
        maps = after
    return found
