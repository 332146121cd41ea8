"""``pixcal diagnose``: differences of data and simulation, their causes, and the residual gap.

The frames are split in blocks: effects are fitted to half of them and tested on the other half.
The same stages reduce and fit the data and every simulation.
"""

import hashlib
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pixcal.effects import check_known, known_effects, parse_effects
from pixcal.engine.malloc import keep_arrays
from pixcal.engine.run import Runtime
from pixcal.estimators.fringe_fit.modes import solve_modes
from pixcal.estimators.maps.corrected import phase_change, straight_modes
from pixcal.model.arrays import F64
from pixcal.model.bench import load_bench
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError, naming
from pixcal.model.options import Diagnose as Config
from pixcal.simulation.effect import Effect
from pixcal.stages.diagnose.candidates import Considered
from pixcal.stages.diagnose.comparison import rounded
from pixcal.stages.diagnose.diagnosis_input import prepare_input
from pixcal.stages.diagnose.fitted_set import FittedSet
from pixcal.stages.diagnose.search_run import run_search
from pixcal.stages.diagnose.trial import Effects
from pixcal.stages.treatment import Treatment, fitted_shapes, treatment_of_kind
from pixcal.storage.artefact import Build
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import Manifest, write_json
from pixcal.storage.stage import make, require, working


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Diagnose a reduced run: make ``RUN/diagnose`` and the product ``diagnosis.json``."""
    require(run_dir, "reduce")
    known = known_effects(config.own)
    kinds = _kinds(config, known)
    nominal = config.nominal
    base = parse_effects(load_bench(nominal).effects, str(nominal), known) if nominal else ()
    plain = {
        "effects": sorted(kinds),
        "own": [hashlib.sha256(path.read_bytes()).hexdigest() for path in config.own],
        "nominal": {e.name: to_plain(e) for e in base},
    }
    with working(run_dir, "reduce") as inputs:
        body = partial(_diagnose, run_dir, kinds, base, runtime)
        return make(run_dir, STAGES["diagnose"], plain, inputs, body)


def _diagnose(
    run_dir: Path, kinds: Mapping[str, type[Effect]], base: Effects, runtime: Runtime, made: Build
) -> None:
    made.scratch.mkdir(exist_ok=True)
    keep_arrays()
    inputs = prepare_input(run_dir, runtime, Considered(kinds, base))
    with naming("--nominal" if base else f"{run_dir}: the nominal simulation failed"):
        described, places = run_search(inputs, made.scratch)
    diagnosis = described.diagnosis(places)
    named = {effect.name: effect for effect in described.search.final.effects}
    fits = [fit for window in inputs.windows for fit in window.bench.fits]
    shapes = fitted_shapes(run_dir)
    for cause in diagnosis["causes"]:
        cause["on_map"] = on_map(named[cause["effect"]], fits, shapes)
    write_json(made.folder / "diagnosis.json", diagnosis)
    write_json(made.folder / "curves.json", list(described.curves.values()))
    made.summary.update(
        verdict=diagnosis["verdict"], causes=[cause["effect"] for cause in diagnosis["causes"]]
    )


def _kinds(config: Config, known: Mapping[str, type[Effect]]) -> dict[str, type[Effect]]:
    for name in (*config.only, *config.without):
        check_known(name, known, "--effects")
        if name in config.only and name in config.without:
            raise InputError(
                f"--effects: {name} is a candidate and left out; write either '{name}' or '-{name}'"
            )
    kinds = {
        name: kind
        for name, kind in known.items()
        if (not config.only or name in config.only) and name not in config.without
    }
    if not kinds:
        raise InputError("--effects: every effect is left out; keep at least one as a candidate")
    return kinds


# Change of the offset map by a cause


def on_map(
    effect: Effect, fits: Sequence[FittedSet], shapes: tuple[str, Mapping[str, str]]
) -> dict[str, Any]:
    """Rms and maximum (px) change of the offsets by undoing an effect, and the treatment."""
    # On maps of every set and window, modes removed; zero if free parameters absorb it.
    treated = treatment_of_kind(type(effect), *shapes)
    action = Treatment(effect, "diagnosis", {}, *treated).action
    if not fits and action == "corrected":
        action = "unaffected"  # without fringes there are no maps
    square, count, most = 0.0, 0, 0.0
    for fit in fits if action != "unaffected" else ():
        change = _change(effect, fit)
        square += float(change @ change)
        count += change.size
        most = max(most, float(np.max(np.abs(change), initial=0.0)))
    rms = float(np.sqrt(square / count)) if count else 0.0
    return {"rms_px": rounded(rms), "max_px": rounded(most), "action": action}


def _change(effect: Effect, fit: FittedSet) -> F64:
    """Change (pixel,) of the offsets of good pixels by an effect, px; modes removed."""
    good = np.isfinite(fit.theta).all(axis=0) & np.isfinite(fit.delta)
    maps = fit.maps
    after = fit.corrected(effect, maps) or effect.predict(maps)
    if after is None or not good.any():
        return np.zeros(0)
    change = -phase_change(maps.theta, after.theta)[good]
    modes = straight_modes(maps.theta, fit.k)[:, good]
    taken = solve_modes(modes @ modes.T, (modes @ change)[:, None])[:, 0]
    return np.asarray((change - taken @ modes) / np.hypot(*fit.k))
