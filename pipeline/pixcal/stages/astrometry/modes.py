"""Modes of offset maps that are degenerate with the bench (physics note, section 2).

Smooth modes (a plane; what moving a fibre does to hyperbolic fringes) act on stars like distortion
of the telescope, which a mission has to measure anyway. The fringe and its harmonic are lost to
free intensities; over a large window they contain almost no part of the true offsets.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.fringe_fit.gauge import fringe_modes
from pixcal.estimators.fringe_fit.models import FringeShape
from pixcal.estimators.fringe_fit.models.paraxial import Paraxial

F64 = NDArray[np.float64]
Range = tuple[int, int]


@dataclass(frozen=True)
class DegenerateModes:
    """A combination of the modes of all sets."""

    shape: tuple[int, int]  # of the detector, (y, x)
    sets: tuple[FringeShape, ...]  # as fitted
    coefficients: tuple[float, ...] = ()  # px each; the smooth modes first

    @property
    def n_smooth(self) -> int:
        """Number of smooth modes."""
        return 3 + sum(len(s.names) - 1 for s in self.sets if not s.linear)

    @property
    def number(self) -> int:
        """Number of modes."""
        return self.n_smooth + 4 * len(self.sets)

    def basis(self, y: Range, x: Range) -> F64:
        """All modes (mode, y, x) on a part of the detector."""
        rows, columns = np.arange(*y, dtype=float)[:, None], np.arange(*x, dtype=float)[None, :]
        middle = (self.shape[0] - 1) / 2, (self.shape[1] - 1) / 2
        plane = Paraxial(0.0, 0.0, 0.0, middle, max(self.shape) / 2).modes(rows, columns)
        curved = [s.modes(rows, columns)[1:] for s in self.sets if not s.linear]
        fringes = [fringe_modes(s.phase(rows, columns), np.asarray(1.0)) for s in self.sets]
        return np.concatenate([plane, *curved, *map(np.stack, fringes)])

    def on(self, y: Range, x: Range) -> F64:
        """Their sum on a part of the detector, px."""
        return np.asarray(np.tensordot(self.coefficients, self.basis(y, x), 1))
