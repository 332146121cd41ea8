"""Errors of the offset maps of a case against its truth, as fitted and as corrected.

Modes that are degenerate with the bench (piston, modes of the fitted fringes and of the free
intensities) are removed from the difference; the rest is given in Cramér-Rao bounds.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blind_examination.benches import Layout
from blind_examination.cases import effects_of
from blind_examination.draw import Truth
from blind_examination.second import second_offsets
from pixcal.estimators.fringe_fit.gauge import fringe_modes
from pixcal.model.acquisition import Acquisition, load_acquisition
from pixcal.model.bench import Bench
from pixcal.simulation.exposure import Camera
from pixcal.stages.compare.sides import PART_OF
from pixcal.stages.fitted_shape import fitted_shape
from pixcal.storage.manifest import read_json
from pixcal.storage.products import read_map

F64 = NDArray[np.float64]
Sets = Mapping[str, Mapping[str, Any]]

AXES = ("x", "y")
BIASED = 1.1  # ratio to the bound above which the error of a fitted map is more than noise


@dataclass(frozen=True)
class AxisError:
    """Error of the offsets along one axis."""

    axis: str  # `x` or `y`
    bound_px: float  # Cramér-Rao bound of an offset in the ordinary fit
    # before, after: root mean square of the error over the bound, of the maps as fitted and as
    # corrected; equal without a correction
    before: float
    after: float
    pull: float  # root mean square of the error over `SIGMA`, as fitted

    @property
    def biased(self) -> bool:
        """Whether the error of the fitted map exceeds noise."""
        return self.before > BIASED


def true_offsets(truth: Truth, bench: Bench, layout: Layout) -> tuple[F64, F64]:
    """True offsets (y, x) along x and y, px, of the simulator that made the case."""
    if truth.second is not None:
        return second_offsets(truth.second, layout)
    maps = Camera(bench, (0, bench.detector.shape[0]), effects_of(truth, bench)).maps
    return np.asarray(maps.delta_x, float), np.asarray(maps.delta_y, float)


def offset_errors(
    products: Path, acquisition: Path, truth: Truth, bench: Bench, layout: Layout
) -> tuple[AxisError, ...]:
    """Errors of the maps of a case in ``products``, as ``pixcal fit --with-diagnosis`` left them.

    InputError if a map is damaged, or fitted by a model whose modes are not known.
    """
    fitted: Sets = read_json(products / "fit.json")["sets"]
    if any(facts["crb_median_px"] is None for facts in fitted.values()):
        return ()
    correction = read_json(products / "correction.json")
    described = load_acquisition(acquisition)
    corrected: Sets = {name: facts["fit"] for name, facts in correction["sets"].items()}
    errors = []
    for n, (axis, true) in enumerate(zip(AXES, true_offsets(truth, bench, layout), strict=True)):
        product = products / f"delta_{axis}.fits"
        if not product.is_file():
            continue
        before, sigma, *_ = read_map(product)
        bound = _bound(fitted, n)
        off = _less_modes(before - true, _modes(products, fitted, described, n, true.shape))
        rest = off
        if correction["outputs"]:
            after, *_ = read_map(products / f"delta_{axis}_corrected.fits")
            modes = _modes(products, corrected, described, n, true.shape)
            rest = _less_modes(after - true, modes)
        good = np.isfinite(off) & np.isfinite(rest) & (sigma > 0)
        if good.any():
            sizes = (off[good] / bound, rest[good] / bound, off[good] / sigma[good])
            errors.append(AxisError(axis, bound, *(float(np.sqrt((s**2).mean())) for s in sizes)))
    return tuple(errors)


def _bound(sets: Sets, axis: int) -> float:
    """Bound of the offset along x or y from all sets together, px."""
    information = np.zeros((2, 2))
    for facts in sets.values():
        information += np.outer(facts["axis"], facts["axis"]) / facts["crb_median_px"] ** 2
    return float(np.sqrt(np.linalg.inv(information)[axis, axis]))


def _modes(
    products: Path, sets: Sets, acquisition: Acquisition, axis: int, shape: tuple[int, int]
) -> F64:
    """Modes removed from the maps of the sets that contribute to an axis, (mode, y, x)."""
    y, x = np.arange(shape[0], dtype=float)[:, None], np.arange(shape[1], dtype=float)[None, :]
    modes = []
    for facts in sets.values():
        if abs(facts["axis"][axis]) > PART_OF:
            fringes = fitted_shape(products, facts, acquisition, shape)
            ratio = np.asarray(1 / facts["visibility"])
            modes += [fringes.modes(y, x), np.stack(fringe_modes(fringes.phase(y, x), ratio))]
    return np.concatenate(modes)


def _less_modes(error: F64, modes: F64) -> F64:
    """An error map (y, x) minus the modes; NaN stay NaN."""
    good = np.isfinite(error)
    scaled = modes / np.sqrt((modes**2).mean(axis=(1, 2)))[:, None, None]
    taken = np.linalg.lstsq(scaled[:, good].T, error[good], rcond=None)[0]
    return np.asarray(error - np.tensordot(taken, scaled, 1))
