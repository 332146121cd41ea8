"""Maps of a fit as they would be in frames that an effect on samples was undone on."""

from dataclasses import replace

import numpy as np

from pixcal.simulation.effect import Effect, FringeMaps

PHASES = 12
"""Frames, spread over a fringe, of which an effect on samples is undone."""
LEAST_SIGNAL = 1.0
"""Of a sample (e-), below which its shot noise is not taken."""


def undone_on_samples(effect: Effect, maps: FringeMaps) -> FringeMaps | None:
    """Maps that a fit finds in frames without noise that an effect was undone on.

    None where the effect is not one of samples.
    """
    phi = 2 * np.pi * np.arange(PHASES) / PHASES
    frames = np.stack([np.ones(PHASES), np.cos(phi), np.sin(phi)])
    flat = np.ones(maps.theta.shape[1:]) if maps.flat is None else maps.flat
    charge = np.einsum("mt,myx->tyx", frames, maps.theta * flat)
    undone = effect.undo_samples(charge.astype(np.float32))
    if undone is None:
        return None
    weight = 1 / np.maximum(charge, LEAST_SIGNAL)
    normal = np.einsum("mt,nt,tyx->yxmn", frames, frames, weight)
    right = np.einsum("mt,tyx->yxm", frames, weight * undone)
    theta = np.moveaxis(np.linalg.solve(normal, right[..., None])[..., 0], -1, 0)
    return replace(maps, theta=theta)
