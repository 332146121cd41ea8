"""Removal, from a truth, of the modes that are degenerate with the bench."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.run import Runtime, run_tasks
from pixcal.stages.astrometry.detector import Component
from pixcal.stages.astrometry.modes import DegenerateModes

F64 = NDArray[np.float64]

ENOUGH = 4_000_000  # pixels that determine the modes; of larger detectors some bands are left out
BAND = 16  # rows of a task


def free_from_modes(
    components: Sequence[Component], modes: DegenerateModes, runtime: Runtime
) -> tuple[list[Component], dict[str, dict[str, float]]]:
    """Fit the modes to truth minus maps, and remove them from the truth.

    Returns
    -------
    list of Component
    dict
        For each component the rms (px) of the ``smooth`` and of the ``fringe`` modes taken off.
    """
    ny, nx = modes.shape
    # An odd step: bands must not keep pace with fringes.
    step = (ny * nx // ENOUGH) | 1
    bands = [(y, min(y + BAND, ny)) for y in range(0, ny, BAND * step)]
    task = partial(_sums, tuple(components), modes)
    parts = run_tasks(task, bands, runtime, label="modes of the truth")
    groups = {"smooth": slice(modes.n_smooth), "fringe": slice(modes.n_smooth, None)}
    freed, removed = [], {}
    for n, component in enumerate(components):
        normal, right, count = (sum(part[n][k] for part in parts) for k in range(3))
        normal = np.asarray(normal)
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        # Modes of two sets overlap: of all combinations that do, the least.
        fit = np.linalg.lstsq(normal / np.outer(scale, scale), right / scale, rcond=1e-10)[0]
        c = fit / scale
        freed.append(replace(component, modes=replace(modes, coefficients=tuple(c.tolist()))))
        removed[component.name] = {
            group: float(np.sqrt(c[p] @ normal[p, p] @ c[p] / max(count, 1)))
            for group, p in groups.items()
        }
    return freed, removed


def _sums(
    components: tuple[Component, ...], modes: DegenerateModes, y: tuple[int, int]
) -> list[tuple[F64, F64, int]]:
    """Normal equations of the modes in truth minus map over a band, for each component."""
    x = (0, modes.shape[1])
    basis, sums = modes.basis(y, x), []
    for component in components:
        difference = component.true(y, x) - component.delta.read(y, x)
        good = np.isfinite(difference) & (component.mask.read(y, x) == 0)
        chosen = basis[:, good]
        sums.append((chosen @ chosen.T, chosen @ difference[good], int(good.sum())))
    return sums
