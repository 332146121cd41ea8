"""A joint fit of pixels and frames in plain NumPy."""

import numpy as np


def fit_jointly(samples, theta, g, turns=60):
    """Maps and frames (B, A cos phi, A sin phi), fitted in turn, weighted by photon noise."""
    maps, pixels = theta.reshape(3, -1).copy(), samples.reshape(len(samples), -1)
    weight = 1 / np.maximum(g @ maps, 1)
    for _ in range(turns):
        normal = np.einsum("tp,ti,tj->pij", weight, g, g)
        maps = np.linalg.solve(normal, np.einsum("tp,ti,tp->pi", weight, g, pixels)[..., None])
        maps = maps[..., 0].T
        normal = np.einsum("tp,ip,jp->tij", weight, maps, maps)
        g = np.linalg.solve(normal, np.einsum("tp,ip,tp->ti", weight, maps, pixels)[..., None])
        g = g[..., 0]
    return maps.reshape(theta.shape), g
