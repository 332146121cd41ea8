"""The detector of the simulated stars: true and measured positions of its pixels.

The true offsets of a real detector are not known, but the maps say what they may be: the measured
offset and a draw of its error. That draw is what the maps do not know; a centroid that takes pixels
where the maps say errs by it alone. Against a perfect grid such a detector is worse than the real
one, its offsets holding the maps' errors twice (once in the maps, once in the draw):
`errors` takes both off. Where a truth is given, it is the detector, less
the modes that no fringes can tell from the bench.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.model.errors import InputError
from pixcal.stages.astrometry.modes import DegenerateModes
from pixcal.storage.fits_map import FitsMap

F64 = NDArray[np.float64]
Range = tuple[int, int]

DRAW_TILE = 64  # side of the tiles of pixels that share a generator of errors, px
LARGEST = 1.0  # an offset beyond is no offset; such a pixel is left out, px
AXES = {"delta_x": ("x", (1.0, 0.0)), "delta_y": ("y", (0.0, 1.0))}


def generator(seed: int, *key: int) -> np.random.Generator:
    """Random generator keyed by purpose and position, independent of the task."""
    return np.random.default_rng([seed, *key])


@dataclass(frozen=True)
class Component:
    """The offsets along one axis."""

    name: str  # `x`, `y` or `fringe`
    axis: tuple[float, float]  # unit vector (x, y)
    delta: FitsMap  # delta, sigma, mask: product of the fit
    sigma: FitsMap
    mask: FitsMap
    # the true offset is the sum of the maps times the numbers; empty where it is not known
    truth: tuple[tuple[float, FitsMap], ...] = ()
    modes: DegenerateModes | None = None  # what the truth is freed from

    def true(self, y: Range, x: Range) -> F64:
        """The true offset along the axis, modes included, px."""
        return np.asarray(
            sum(share * image.read(y, x).astype(float) for share, image in self.truth)
        )


@dataclass(frozen=True)
class Patch:
    """A part of the detector."""

    # true, known: (component, y, x) where pixels lie and where the maps say, px; zero where not
    # `good`
    true: F64
    known: F64
    good: NDArray[np.bool_]  # (y, x) pixels whose offset is known


@dataclass(frozen=True)
class PixelPositions:
    """The whole detector; picklable, read on demand."""

    components: tuple[Component, ...]
    seed: int

    @property
    def shape(self) -> tuple[int, int]:
        """(y, x) size, px."""
        return self.components[0].delta.shape

    @property
    def drawn(self) -> bool:
        """Whether the true positions are the maps plus a random draw of their errors."""
        return not self.components[0].truth

    @property
    def axes(self) -> F64:
        """Unit vectors (x, y) of the components, (component, 2)."""
        return np.array([component.axis for component in self.components])

    def patch(self, y: Range, x: Range) -> Patch:
        """A part, (start, stop) of rows and of columns; beyond the detector no pixel is good."""
        ny, nx = self.shape
        shape = (len(self.components), y[1] - y[0], x[1] - x[0])
        part = Patch(np.zeros(shape), np.zeros(shape), np.zeros(shape[1:], bool))
        here, across = (max(0, y[0]), min(ny, y[1])), (max(0, x[0]), min(nx, x[1]))
        if here[0] >= here[1] or across[0] >= across[1]:
            return part
        at = tuple(slice(a - o, b - o) for (a, b), o in ((here, y[0]), (across, x[0])))
        true, known, good = self._inside(here, across)
        part.true[:, *at], part.known[:, *at], part.good[at] = true, known, good
        return part

    def _inside(self, y: Range, x: Range) -> tuple[F64, F64, NDArray[np.bool_]]:
        known = np.stack([c.delta.read(y, x).astype(float) for c in self.components])
        if self.drawn:
            sigma = np.stack([c.sigma.read(y, x).astype(float) for c in self.components])
            true = known + sigma * self._draw(y, x)
        else:
            true = np.stack([c.true(y, x) for c in self.components])
            for component, values in zip(self.components, true, strict=True):
                if component.modes is not None:
                    values -= component.modes.on(y, x)
        flags = np.stack([c.mask.read(y, x) for c in self.components])
        with np.errstate(invalid="ignore"):
            fine = (np.abs(true) < LARGEST) & (np.abs(known) < LARGEST) & (flags == 0)
        good = fine.all(axis=0)
        return np.where(good, true, 0.0), np.where(good, known, 0.0), good

    def _draw(self, y: Range, x: Range) -> F64:
        """Standard normals of the pixels, the same in every patch that holds them."""
        out = np.empty((len(self.components), y[1] - y[0], x[1] - x[0]))
        side = DRAW_TILE
        for i in range(y[0] // side, -(-y[1] // side)):
            for j in range(x[0] // side, -(-x[1] // side)):
                normals = generator(self.seed, 1, i, j).standard_normal((len(out), side, side))
                (a0, a1), (b0, b1) = (
                    (max(start, n * side), min(stop, (n + 1) * side))
                    for n, (start, stop) in ((i, y), (j, x))
                )
                out[:, a0 - y[0] : a1 - y[0], b0 - x[0] : b1 - x[0]] = normals[
                    :, a0 - i * side : a1 - i * side, b0 - j * side : b1 - j * side
                ]
        return out


def open_components(run_dir: Path, fit: dict[str, Any], truth: Path | None) -> list[Component]:
    """The products of a run as components, with their truth where one is given.

    Raises
    ------
    InputError
        If a map is missing or damaged, or the truth is not one of this detector.
    """
    true = _open_truth(truth) if truth is not None else {}
    components = []
    for output in fit["outputs"]:
        file = run_dir / "products" / f"{output}.fits"
        if not file.exists():
            raise InputError(f"{file}: not there; run 'pixcal fit {run_dir}' again")
        axis_x, axis_y = next(iter(fit["sets"].values()))["axis"]
        name, axis = AXES.get(output, ("fringe", (axis_x, axis_y)))
        delta, sigma, mask = (FitsMap.open(file, n) for n in (0, "SIGMA", "MASK"))
        shares = tuple((s, true[n]) for s, n in zip(axis, AXES, strict=True) if true and s)
        for _, image in shares:
            if image.shape != delta.shape:
                raise InputError(
                    f"{image.path}: {image.shape} pixels (y, x), the run's maps have "
                    f"{delta.shape}; give the truth of this acquisition"
                )
        components.append(Component(name, axis, delta, sigma, mask, shares))
    return components


def _open_truth(folder: Path) -> dict[str, FitsMap]:
    for name in AXES:
        if not (folder / f"{name}.fits").exists():
            raise InputError(
                f"--truth {folder}: no {name}.fits there; give what 'pixcal simulate' left beside "
                "the acquisition (ACQ-truth)"
            )
    return {name: FitsMap.open(folder / f"{name}.fits") for name in AXES}
