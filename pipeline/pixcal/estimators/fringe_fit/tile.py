"""A part of the window whose samples are fitted at once, and how samples are stored."""

from dataclasses import dataclass

from pixcal.model.arrays import F32, Mask


@dataclass(frozen=True)
class Coding:
    """Electrons of a code: ``scale * code + offset``; ``fill`` marks a sample without weight."""

    scale: float
    offset: float
    fill: int


@dataclass
class Tile:
    """A part of the window."""

    y: tuple[int, int]  # y, x: first pixel and the one after the last, along each axis
    x: tuple[int, int]
    read: F32  # read, shot: (y, x) variance of a sample: `shot * model + read` (e-²)
    shot: F32
    good: Mask  # (y, x) pixels to learn from

    @property
    def shape(self) -> tuple[int, int]:
        """(y, x) size."""
        return self.y[1] - self.y[0], self.x[1] - self.x[0]

    @property
    def centre(self) -> tuple[float, float]:
        """Centre (y, x) in pixels of the window."""
        return (self.y[0] + self.y[1] - 1) / 2, (self.x[0] + self.x[1] - 1) / 2
