"""What each cause does to the map of offsets: how far it moves them, and what is to be done."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pixcal.estimators.fringe_fit.modes import solve_modes
from pixcal.estimators.maps.corrected import phase_change, straight_modes
from pixcal.model.arrays import F64
from pixcal.simulation.effect import Effect
from pixcal.stages.diagnose.fitted_set import FittedSet
from pixcal.stages.treatment import fitted_shapes, treatment_of


def on_map(effect: Effect, fits: Iterable[FittedSet], run_dir: Path) -> dict[str, Any]:
    """Rms and maximum (px) of the change of the offsets by an effect, and what is to be done.

    The change is that of undoing the effect on the maps of every fringe set and window, without the
    modes that the fit removes. It is zero where the free parameters of the fit take the effect up.
    """
    action = treatment_of(effect, *fitted_shapes(run_dir)).action
    square, count, most = 0.0, 0, 0.0
    for fit in fits if action != "unaffected" else ():
        change = _change(effect, fit)
        square += float(change @ change)
        count += change.size
        most = max(most, float(np.max(np.abs(change), initial=0.0)))
    rms = float(np.sqrt(square / count)) if count else 0.0
    return {"rms_px": _rounded(rms), "max_px": _rounded(most), "action": action}


def _change(effect: Effect, fit: FittedSet) -> F64:
    """Change (pixel,) of the offsets of good pixels by an effect, px; modes taken off."""
    good = np.isfinite(fit.theta).all(axis=0) & np.isfinite(fit.delta)
    maps = fit.maps
    after = fit.undone(effect, maps) or effect.predict(maps)
    if after is None or not good.any():
        return np.zeros(0)
    change = -phase_change(maps.theta, after.theta)[good]
    modes = straight_modes(maps.theta, fit.k)[:, good]
    taken = solve_modes(modes @ modes.T, (modes @ change)[:, None])[:, 0]
    return np.asarray((change - taken @ modes) / np.hypot(*fit.k))


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
