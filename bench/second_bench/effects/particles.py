"""Particles that cross the detector."""

import numpy as np
from scipy.stats import moyal

from second_bench.effects.law import Drawn, law
from second_bench.model import F64, Bench, Frame

PAIRS_PER_UM = 80.0
"""Electrons that a minimum-ionising particle frees in silicon."""
DEPTH_UM = 8.0
STEP_UM = 0.5


def _deposit(e: F64, x_um: F64, y_um: F64, charge: F64, pitch_um: float) -> None:
    column, row = np.floor(x_um / pitch_um).astype(int), np.floor(y_um / pitch_um).astype(int)
    ny, nx = e.shape
    inside = (column >= 0) & (column < nx) & (row >= 0) & (row < ny)
    np.add.at(e, (row[inside], column[inside]), charge[inside])


@law("cosmic_hits", "tracks", 0.05, 15, "a frame")
def tracks(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """Muons from above: straight tracks through the sensitive layer, energies after Landau."""
    ny, nx = bench.shape

    def hits(e: F64, frame: Frame) -> F64:
        if frame.run.kind == "bias":
            return e
        own, out = frame.rng, e.copy()
        for _ in range(own.poisson(size)):
            start = own.uniform(0, 1, 2) * (nx, ny) * bench.pitch_um
            tilt = np.arccos(own.uniform(0.05, 1))
            azimuth, length = own.uniform(0, 2 * np.pi), DEPTH_UM / np.cos(tilt)
            along = np.arange(0, length, STEP_UM)
            x = start[0] + along * np.sin(tilt) * np.cos(azimuth) + own.normal(0, 1, len(along))
            y = start[1] + along * np.sin(tilt) * np.sin(azimuth) + own.normal(0, 1, len(along))
            freed = PAIRS_PER_UM * STEP_UM * max(1 + 0.2 * moyal.rvs(random_state=own), 0.3)
            _deposit(out, x, y, own.poisson(freed, len(along)).astype(float), bench.pitch_um)
        return out

    bench.charge.append(hits)


@law("cosmic_hits", "spots", 0.05, 15, "a frame")
def spots(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Radioactivity of the glass: short-ranged electrons, charge in a few pixels."""
    ny, nx = bench.shape
    typical = float(rng.uniform(1000, 6000))

    def hits(e: F64, frame: Frame) -> F64:
        if frame.run.kind == "bias":
            return e
        own, out = frame.rng, e.copy()
        for _ in range(own.poisson(size)):
            count = int(own.exponential(typical) / 20) + 5
            place = own.uniform(0, 1, 2) * (nx, ny) * bench.pitch_um
            x, y = place[:, None] + own.normal(0, own.uniform(1, 4), (2, count))
            _deposit(out, x, y, np.full(count, 20.0), bench.pitch_um)
        return out

    bench.charge.append(hits)
    return {"typical_e": typical}
