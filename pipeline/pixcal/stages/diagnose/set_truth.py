"""What the nominal bench knows of a fringe set."""

from dataclasses import dataclass

import numpy as np

from pixcal.model.arrays import F32, F64


@dataclass(frozen=True)
class SetTruth:
    """One fringe set of the nominal bench."""

    light: F32  # (y, x) mean, for unit response, e-
    contrast: F32  # (y, x) fringe amplitude over the mean, a smooth surface
    psi: F64  # (y, x) phase of the pixels if they had no offsets, rad
    k: tuple[float, float]  # fringe vector, rad/px
    step: float  # of a ramp of the phase, rad; zero: no ramp
    phi: F64  # (t,) measured phase of every frame, rad; NaN for frames that were not fitted

    def phase(self, delta_x: F32, delta_y: F32) -> F64:
        """Phase (y, x) of the pixels at their offsets (px), rad."""
        return np.asarray(self.psi + self.k[0] * delta_x + self.k[1] * delta_y)
