"""A frame in simulation, as presented to an effect."""

from typing import Any

import numpy as np

from pixcal.kernels.beams import LightMaps
from pixcal.kernels.scene import DetectorMaps, FrameStates, Rows
from pixcal.model.arrays import F32
from pixcal.model.bench import Bench
from pixcal.simulation.recording import Recording


class Shot:
    """Context of a simulated frame for the effect at one place in the chain.

    Attributes
    ----------
    bench : Bench
    recording : Recording
        Recording of the frame; ``recording.kind`` distinguishes bias, dark, flat and fringes.
    frame : int
        Its number in the recording.
    rows : (int, int)
        Present rows of the window: first, and one after the last.
    maps : DetectorMaps
        Of these rows.
    """

    def __init__(self, chain: Any, frame: int, at: int) -> None:
        # A chain of `pixcal.simulation.exposure`.
        self._chain, self._at = chain, at
        self.recording: Recording = chain.recording
        self.bench: Bench = chain.camera.bench
        self.maps: DetectorMaps = chain.camera.maps
        self.rows: Rows = chain.camera.rows
        self.frame = frame

    @property
    def time_s(self) -> float:
        """Start of the frame, from the start of the acquisition."""
        return self.start_of(self.frame)

    def start_of(self, frame: int) -> float:
        """Start of another frame, s; numbers as in `charge`."""
        chain, frame = self._chain.of(frame)
        recording: Recording = chain.recording
        return recording.start_s + float(recording.times_s[frame])

    def end_of(self, frame: int) -> float:
        """When another frame is read, s: as the next one starts, or a period after the last one."""
        chain, number = self._chain.of(frame)
        recording: Recording = chain.recording
        if number + 1 < recording.count:
            return self.start_of(frame + 1)
        return self.start_of(frame) + recording.period_s

    @property
    def states(self) -> FrameStates:
        """States of all frames of the recording."""
        states: FrameStates = self._chain.states
        return states

    @property
    def light(self) -> LightMaps:
        """Mean and fringe amplitude of the recording on these rows, e-."""
        light: LightMaps = self._chain.light
        return light

    def mean(self, frame: int) -> F32 | None:
        """Mean electrons of another frame, without this effect; None outside the recording."""
        inside = 0 <= frame < self.recording.count
        return self._chain.mean(frame, self._at) if inside else None

    def charge(self, frame: int) -> F32 | None:
        """Charge of another frame, without this effect; None outside the recording.

        Frames -1, -2, ... are the last ones of the preceding recordings, if known.
        """
        chain, frame = self._chain.of(frame)
        inside = 0 <= frame < chain.recording.count
        return chain.charge(frame, self._at) if inside else None

    def surrounded(self, charge: F32, reach: int) -> F32:
        """Charge (y, x) of this frame with ``reach`` more pixels on every side, e-.

        The added pixels hold the mean charge from the light of the frame: fringes continue, pixels
        are like those at the edge, and there is no noise.
        """
        wide: F32 = self._chain.beyond(self.frame, reach)
        inside = slice(reach, -reach)
        wide[inside, inside] = charge
        return wide

    def rng(self, effect: str, *key: int) -> np.random.Generator:
        """Random numbers of an effect in this frame, the same for all rows.

        Quantities that differ from pixel to pixel are drawn with ``recording.pixel_rng``.
        """
        return self.recording.rng(effect, self.frame, *key)

    def normals(self, effect: str) -> F32:
        """Standard normals (y, x) of an effect, independent of the range of rows; read only."""
        chain, frame = self._chain.of(self.frame)
        acting = chain.effects[self._at]
        again = acting.frames_back > 0 and effect.startswith(acting.name)
        normals: F32 = chain.normals(effect, frame, keep=again)
        return normals
