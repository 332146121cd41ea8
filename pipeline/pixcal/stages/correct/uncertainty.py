"""What the errors of an effect's parameters leave in the corrected offsets."""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from pixcal.effects import parse_effects
from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.corrected import phase_change, straight_modes
from pixcal.estimators.modes import solve_modes
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect
from pixcal.stages.correct.undoing import PIXEL_BYTES, Swept, maps_of
from pixcal.stages.fit.scouting import scout_tiles

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
    swept: Swept, errors: Mapping[str, Mapping[str, float]], runtime: Runtime
) -> dict[str, float | None]:
    """Rms (px) of what the errors of each effect's parameters leave in the offsets of a set.

    Parameters are moved one by one, and what each does is added in squares: errors that go together
    are not known here.

    Parameters
    ----------
    swept : Swept
    errors : mapping
        By effect, then by parameter.
    runtime : Runtime

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
        partial(_tile, swept, others),
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
    swept: Swept, others: Mapping[str, Sequence[Effect]], at: tuple[int, int]
) -> list[tuple[float, int]]:
    """Sum of squares (px²) and pixels, for each effect."""
    y, x = swept.source.ranges(at)
    part = swept.around(y, x)
    inside = swept.inside(y, x)
    maps, good, _ = maps_of(swept, part)
    size = float(np.hypot(*swept.k))
    found = []
    for effect in swept.effects:
        after = effect.undo(maps)
        assert after is not None
        modes = straight_modes(after.theta[(slice(None), *inside)], swept.k)[:, good[inside]]
        square = 0.0
        for other in others[effect.name]:
            off = other.undo(maps)
            assert off is not None
            change = phase_change(after.theta, off.theta)[inside][good[inside]] / size
            taken = solve_modes(modes @ modes.T, (modes @ change)[:, None])[:, 0]
            square += float(((change - taken @ modes) ** 2).sum())
        found.append((square, int(good[inside].sum())))
        maps = after
    return found
