"""A frame being made, as an effect sees it."""

from typing import Protocol

import numpy as np

from pixcal.kernels.beams import LightMaps
from pixcal.kernels.scene import DetectorMaps, FrameStates, Rows
from pixcal.model.arrays import F32
from pixcal.model.bench import Bench
from pixcal.simulation.recording import Recording


class Shot(Protocol):
    """Where, when and of what a frame is taken.

    Attributes
    ----------
    bench : Bench
    recording : Recording
        That the frame belongs to; ``recording.kind`` tells bias, dark, flat and fringes apart.
    frame : int
        Its number in the recording.
    rows : (int, int)
        Rows of the window at hand: first, and one after the last.
    maps : DetectorMaps
        Of these rows.
    """

    bench: Bench
    recording: Recording
    frame: int
    rows: Rows
    maps: DetectorMaps

    @property
    def time_s(self) -> float:
        """Start of the frame after that of the acquisition."""

    @property
    def states(self) -> FrameStates:
        """Of all frames of the recording."""

    @property
    def light(self) -> LightMaps:
        """Mean and fringe amplitude of the recording on these rows, e-."""

    def mean(self, frame: int) -> F32 | None:
        """Mean electrons of another frame, without this effect; None outside the recording."""

    def charge(self, frame: int) -> F32 | None:
        """Charge of another frame, without this effect; None outside the recording.

        Frames -1, -2, ... are the last ones of the recording before, where it is known.
        """

    def surrounded(self, charge: F32, reach: int) -> F32:
        """Charge (y, x) of this frame with ``reach`` more pixels on every side, e-.

        Beyond the rows at hand and the window's columns lies what the light of the frame collects
        there: fringes go on, pixels are like those at the edge, without noise.
        """

    def rng(self, effect: str, *key: int) -> np.random.Generator:
        """Random numbers of an effect in this frame, the same for all rows.

        What differs from pixel to pixel is drawn with ``recording.pixel_rng``.
        """

    def normals(self, effect: str, frame: int | None = None) -> F32:
        """Standard normals (y, x) of an effect, the same however rows are cut.

        Of this frame, or of another one of the recording.
        """
