"""The modes of offset maps that no fringes can tell from the bench (physics note, section 2).

Smooth modes (a plane; what moving a fibre does to hyperbolic fringes) act on stars like distortion
of the telescope, which a mission has to measure anyway. The fringe and its harmonic are lost to
free intensities; over a large window they hold next to nothing of the true offsets.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels.optics import PARAMETERS, Geometry, phase, phase_jacobian
from pixcal.model.acquisition import Acquisition

F64 = NDArray[np.float64]
Range = tuple[int, int]


@dataclass(frozen=True)
class SetModes:
    """Modes of one fringe set, beside a plane."""

    middle: tuple[float, float]  # of the detector, (x, y), px
    k: tuple[float, float]  # fringe vector (x, y), rad/px
    geometry: Geometry | None  # of exact fringes

    @classmethod
    def of_fit(
        cls, shape: tuple[int, int], facts: Mapping[str, Any], acquisition: Acquisition
    ) -> "SetModes":
        """Modes of a set from its entry in ``fit.json``."""
        geometry = None
        if facts["model"] == "hyperbolic":
            geometry = Geometry(
                acquisition.fibres.wavelength_nm * 1e-6,
                acquisition.detector.pitch_um * 1e-3,
                *(facts["geometry"][f"{name}_mm"] for name in PARAMETERS),
            )
        middle = (shape[1] - 1) / 2, (shape[0] - 1) / 2
        return cls(middle, (facts["kx"], facts["ky"]), geometry)

    def smooth(self, x: F64, y: F64) -> F64:
        """What moving the fibres does, (mode, y, x); nothing for straight fringes."""
        x, y = np.broadcast_arrays(x, y)
        if self.geometry is None:
            return np.empty((0, *x.shape))
        away = phase_jacobian(x, y, self.geometry) - phase_jacobian(*self.middle, self.geometry)
        return np.moveaxis(away, -1, 0)

    def fringes(self, x: F64, y: F64) -> F64:
        """The fringe and its harmonic, (4, y, x)."""
        straight = self.k[0] * x + self.k[1] * y
        turn = np.exp(1j * (straight if self.geometry is None else phase(x, y, self.geometry)))
        return np.stack([turn.real, turn.imag, (turn**2).real, (turn**2).imag])


@dataclass(frozen=True)
class Modes:
    """A combination of the modes of all sets."""

    shape: tuple[int, int]  # of the detector, (y, x)
    sets: tuple[SetModes, ...]
    coefficients: tuple[float, ...] = ()  # px each; the smooth modes first

    @property
    def n_smooth(self) -> int:
        """Number of smooth modes."""
        return 3 + sum(len(PARAMETERS) for modes in self.sets if modes.geometry is not None)

    @property
    def number(self) -> int:
        """Number of modes."""
        return self.n_smooth + 4 * len(self.sets)

    def basis(self, y: Range, x: Range) -> F64:
        """All modes (mode, y, x) on a part of the detector."""
        (ny, nx), size = self.shape, (y[1] - y[0], x[1] - x[0])
        rows, columns = np.arange(*y, dtype=float)[:, None], np.arange(*x, dtype=float)[None, :]
        plane = np.empty((3, *size))
        plane[0], plane[1], plane[2] = 1.0, columns / nx - 0.5, rows / ny - 0.5
        smooth = [modes.smooth(columns, rows) for modes in self.sets]
        return np.concatenate([plane, *smooth, *(m.fringes(columns, rows) for m in self.sets)])

    def on(self, y: Range, x: Range) -> F64:
        """Their sum on a part of the detector, px."""
        return np.asarray(np.tensordot(self.coefficients, self.basis(y, x), 1))
