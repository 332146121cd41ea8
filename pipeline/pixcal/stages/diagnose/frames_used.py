"""Frames and windows that a diagnosis used; the fields are keys of ``diagnosis.json``."""

from dataclasses import dataclass

from pixcal.stages.diagnose.parts import Half
from pixcal.stages.evidence import Part

# of an array: first and last frame, and how many
Frames = dict[str, tuple[int, int, int]]


def frames_of(half: Half) -> Frames:
    """Frames of a half, by array."""
    return {name: (int(own[0]), int(own[-1]), len(own)) for name, own in half.items()}


@dataclass(frozen=True)
class FittedOn:
    """Window and frames to which effects were fitted."""

    window: Part
    frames: Frames


@dataclass(frozen=True)
class HeldOut:
    """Windows and frames on which effects were tested."""

    windows: tuple[Part, ...]
    frames: Frames


@dataclass(frozen=True)
class LeftOut:
    """A window that could not be fitted."""

    window: Part
    reason: str


@dataclass(frozen=True)
class FramesUsed:
    """Entry ``looked_at`` of ``diagnosis.json``."""

    shape: tuple[int, int]  # rows and columns of the detector
    fitted_on: FittedOn
    tried_on: HeldOut
    left_out: tuple[LeftOut, ...]
    # arrays too short to split: effects are fitted and tested on the same frames
    shared: tuple[str, ...]
    kinds: tuple[str, ...]  # of calibration frames
    sets: dict[str, tuple[float, float]]  # baseline of each fringe set, mm
    missing_frames: dict[str, str]  # `recommended_frames.missing_frames`

    @property
    def on_the_same_pixels(self) -> bool:
        """Whether effects were tested on pixels to which they were fitted."""
        (y0, y1), (x0, x1) = self.fitted_on.window
        return any(
            y0 < b1 and b0 < y1 and x0 < a1 and a0 < x1
            for (b0, b1), (a0, a1) in self.tried_on.windows
        )
