"""Fitted maps of a fringe set, and the frames to which they were fitted, as effects see them."""

from dataclasses import dataclass, replace

import numpy as np

from pixcal.model.arrays import F64


@dataclass(frozen=True)
class FittedFrames:
    """Frames to which maps were fitted, for effects that depend on their order."""

    g: F64  # (t, 3) intensity, and amplitude times cosine and sine of the phase
    # first and number of the rows over which effects along rows extend: those of the window or, if
    # only a part is simulated, of the part
    rows: tuple[int, int]
    read_noise_e: float
    exptime_s: float
    period_s: float
    vectors_free: bool  # whether each frame has its own fringe vector


@dataclass(frozen=True)
class FringeMaps:
    """Fitted maps of one fringe set, for effects that are linear in the intensity."""

    theta: F64  # (3, y, x) iota, alpha sin psi, alpha cos psi, e-
    k: tuple[float, float]  # fringe vector (kx, ky) at the centre, rad/px
    origin: tuple[int, int] = (0, 0)  # first row and column of these maps in the detector's window
    # (y, x) relative response from flats, by which samples were divided; None without flats. An
    # effect that also acts on flats changes it
    flat: F64 | None = None
    name: str = ""  # of the fringe set
    frames: FittedFrames | None = None

    def phase_shifted(self, phase: F64) -> "FringeMaps":
        """The maps with the phase shifted by (y, x) rad; no shift where that is NaN."""
        iota, sine, cosine = self.theta
        z = (cosine + 1j * sine) * np.exp(1j * np.nan_to_num(phase))
        return replace(self, theta=np.stack([iota, z.imag, z.real]))
