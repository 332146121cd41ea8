"""Normal matrices of all pixels from sums over frames alone.

Weights w = f / (1 + rho + V sin(psi + phi)), with a factor f = 1 / B of each frame, are a Fourier
series in psi + phi. The normal matrix of a pixel, the sum over frames of w g g', is then a function
of its phase alone, made of the frames' own moments ``sum f exp(i k phi) g g'``: nothing of it is
summed sample by sample (physics note, section 3). What such weights leave out is the scatter of the
visibility from frame to frame.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels.fringe_sums import frame_moments, interpolate_periodic

F64 = NDArray[np.float64]
C128 = NDArray[np.complex128]

# smallest read variance over level in the weights: below, their series becomes too long, and they
# gain nothing that matters
MIN_RHO = 0.005
ORDERS = 192  # terms kept: the series falls as 0.905^k at V = 1 and `MIN_RHO`, to 5e-9 here
# Phases at which normal matrices are tabulated; linear in between. Errors are under 8e-5 for w and
# 2e-4 for its square at the limits, and act on the step from the start model only.
TABLE = 4096


@dataclass(frozen=True)
class PhaseWeights:
    """Weights of a tile: 1 / (1 + rho + visibility * sin(psi + phi))."""

    visibility: float
    rho: float

    @classmethod
    def of(cls, visibility: float, rho: float) -> "PhaseWeights":
        """Within the limits that keep the series short."""
        return cls(float(np.clip(visibility, 0.0, 1.0)), float(max(rho, MIN_RHO)))

    def series(self, power: int) -> C128:
        """Fourier coefficients, orders 0 to `ORDERS`, of the weight to a power."""
        u = np.arange(TABLE) * (2 * np.pi / TABLE)
        values = (1 + self.rho + self.visibility * np.sin(u)) ** -power
        return np.asarray(np.fft.rfft(values)[: ORDERS + 1] / TABLE)


def frame_weights(g: F64) -> F64:
    """Weight of each frame (t,): shot noise grows with its intensity B."""
    return np.asarray(1 / np.maximum(g[:, 0], 0.01))


def moments(g: F64) -> C128:
    """Moments of frames: ``sum_t f_t exp(i k phi_t) g_i g_j``.

    Parameters
    ----------
    g : (t, 3) float64
        (B, A cos phi, A sin phi).

    Returns
    -------
    (6, ORDERS + 1) complex128
        Pairs ij in the order 00, 01, 02, 11, 12, 22.
    """
    out = np.zeros((6, ORDERS + 1), complex)
    frame_moments(np.ascontiguousarray(g), frame_weights(g), out)
    return out


@dataclass
class FrameMoments:
    """Frames at a point, as the sums want them, and moments of those that follow one another."""

    exact: F64  # (t, 3) (B, A cos phi, A sin phi)
    rows: NDArray[np.float32]  # (t, 5) (B, A, cos phi, sin phi, f), f the frame's own weight
    kept: dict[tuple[int, int], C128] = field(default_factory=dict)

    @classmethod
    def of(cls, g: F64) -> "FrameMoments":
        """Of frames (t, 3)."""
        amplitude = np.maximum(np.hypot(g[:, 1], g[:, 2]), 1e-30)
        unit = g[:, 1:] / amplitude[:, None]
        rows = np.column_stack([g[:, 0], amplitude, unit, frame_weights(g)])
        return cls(g, rows.astype(np.float32))

    def sums(self, part: slice) -> C128:
        """`moments` of some frames."""
        key = (part.start, part.stop)
        if key not in self.kept:
            self.kept[key] = moments(self.exact[part])
        return self.kept[key]


def normal_matrices(frame_sums: C128, weights: C128, psi: F64) -> F64:
    """Normal sums of pixels of given phases.

    Parameters
    ----------
    frame_sums : (6, ORDERS + 1) complex128
        From `moments`.
    weights : (ORDERS + 1,) complex128
        From `PhaseWeights.series`.
    psi : (...) float64
        Phases, rad.

    Returns
    -------
    (6, ...) float64
        Upper triangle of ``sum_t w^power g g'``.
    """
    table = normal_table(frame_sums, weights)
    return np.asarray(interpolate_periodic(table, psi.ravel()).reshape(6, *psi.shape))


def normal_table(frame_sums: C128, weights: C128, size: int = TABLE) -> F64:
    """Normal sums (6, size) over one turn of the phase; arguments as `normal_matrices`."""
    return np.asarray(np.fft.irfft(frame_sums * weights, n=size, axis=1) * size)
