"""One fringe set: the shape of its fringes, from the sums of the sweep over each tile."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixcal.estimators.fringe_fit.modes import ModeBasis
from pixcal.estimators.fringe_fit.shapes import FringeShape, Polynomial, Start, fringe_models
from pixcal.estimators.fringe_fit.tile_sums import Carrier, TilePlane, TileSums, unwrap
from pixcal.model.acquisition import Acquisition
from pixcal.model.arrays import F64
from pixcal.model.errors import InputError
from pixcal.stages.fitted_shape import nominal_geometry
from pixcal.stages.reduced_set import ReducedSet
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.place import Local

MAX_STEPS = 8  # Gauss-Newton steps of a shape; it is nearly linear (physics note, section 4)
STEP_RAD = 1e-7  # iteration stops once a step changes phases by less, rms
# fall in chi-square above which ``auto`` chooses hyperbolic fringes: one chance in a hundred for
# three terms. A false choice costs three modes of the map; missed curvature stays in it entirely.
MIN_CHI2_DROP = 12.0
QUADRATIC = 3  # second-order terms, the leading ones of hyperbolic fringes
# ratio of power at large to small scales above which the map has large-scale structure
LARGE_SCALE_RATIO = 2.5
# fall then required of each term over that of spurious terms: the power of steps falls with the
# order of the term, and two stitches reach 15
MIN_DROP_OVER_SPURIOUS = 50.0
# relative difference of the fringe period from nominal above which a note is added
FAR_PERIOD = 0.15


@dataclass(frozen=True)
class SetFit:
    """A shape fitted to a set."""

    basis: ModeBasis  # the shape and the modes about it
    # (mode, 1 + batch) coefficients to subtract from the phases of the run and of each batch
    coefficients: F64
    covariance: F64  # (mode, mode) of the shape's coefficients and the gauge's
    square: float  # weighted square of the residual map
    spread: float  # same per pixel: variance of the map over that of its noise
    steps: int  # Gauss-Newton steps taken


@dataclass(frozen=True)
class SetWithShape:
    """A set with its fitted shape, before its maps are written."""

    name: str
    source: ReducedSet
    swept: Local  # ``sweep.zarr/<set name>``
    facts: dict[str, Any]  # summary of the set's sweep
    planes: list[TilePlane]  # unwrapped, one a tile
    fit: SetFit
    shape: FringeShape  # with the fitted parameters
    model: str  # model, evidence: name of the shape, and why it was chosen
    evidence: str
    # difference of maps of the two halves of the frames over its error, if that is too small
    excess: float = 1.0

    @property
    def carrier(self) -> Carrier:
        """Carrier of the sweep's phases."""
        return self.fit.basis.carrier

    @property
    def vector(self) -> tuple[float, float]:
        """Fringe vector (kx, ky) at the centre of the window, rad/px."""
        ny, nx = self.source.shape
        return self.shape.vector((ny - 1) / 2, (nx - 1) / 2)

    @property
    def sigma_scale(self) -> float:
        """Errors of the phases over those of the noise model."""
        return self.excess * float(np.sqrt(self.facts["chi2_reduced"]))

    @property
    def n_batches(self) -> int:
        """Batches of the run."""
        return int(self.fit.coefficients.shape[1]) - 1


def fit_sets(
    sweep: Local, reduced: Local, facts: Mapping[str, Any], acquisition: Acquisition, model: str
) -> list[SetWithShape]:
    """Fit the shape of the fringes of every set, see `fit_set`."""
    swept = sweep / "sweep.zarr"
    return [
        fit_set(swept / name, ReducedSet(reduced / name), facts[name], acquisition, model)
        for name in (listed.name for listed in acquisition.frames.fringes)
    ]


def fit_set(
    swept: Local, source: ReducedSet, facts: dict[str, Any], acquisition: Acquisition, model: str
) -> SetWithShape:
    """Fit the shape of a set's fringes, of this ``model`` or ``auto``, to its sweep."""
    name, rows = source.folder.name, ArrayReader(swept / "sums").read()
    tiles = TileSums.of_rows(rows.reshape(-1, rows.shape[-1]))
    if not any(np.isfinite(p.sigma) for p in tiles.planes):
        raise InputError(
            f"fringe set {name!r}: no pixel can be fitted; its fringes are too faint for "
            f"{source.n_frames} frames, or the mask leaves no pixel"
        )
    tiles = replace(tiles, planes=list(unwrap(tiles.planes, source.grid)))
    reference: tuple[float, float] = tuple(facts["reference"])
    nominal = nominal_geometry(acquisition, name, reference)
    start = Start(tuple(facts["k"]), reference, max(source.shape) / 2, tiles.planes, nominal)
    fitted, evidence = _choose(model, tiles, start)
    shape = fitted.basis.shape.moved(fitted.coefficients[: len(fitted.basis.shape.names), 0])
    chosen = next(n for n, cls in fringe_models().items() if isinstance(shape, cls))
    return SetWithShape(name, source, swept, facts, tiles.planes, fitted, shape, chosen, evidence)


def _choose(model: str, tiles: TileSums, start: Start) -> tuple[SetFit, str]:
    """Fit the requested shape; ``auto``: hyperbolic fringes if the map requires them."""
    # True large-scale structure imitates curvature: polynomial terms beyond the hyperbolic shape
    # measure how much of it is spurious.
    shapes = fringe_models()
    if model != "auto":
        return _fit_shape(tiles, shapes[model], start), "asked for"
    straight = _fit_shape(tiles, shapes["paraxial"], start)
    smooth = _fit_shape(tiles, Polynomial, start)
    most = (straight.square - smooth.square) / smooth.spread
    if most < MIN_CHI2_DROP:
        return straight, f"no curvature: chi-square falls by {most:.0f} at most"
    exact = _fit_shape(tiles, shapes["hyperbolic"], start)
    gain = (straight.square - exact.square) / smooth.spread
    others = len(smooth.basis.names) - len(straight.basis.names) - QUADRATIC
    beyond = max(exact.square - smooth.square, 0.0) / smooth.spread / others
    background = max(1.0, beyond)
    needed = MIN_CHI2_DROP
    if background > LARGE_SCALE_RATIO:
        needed = QUADRATIC * MIN_DROP_OVER_SPURIOUS * background
    reason = (
        f"hyperbolic fringes lower chi-square by {gain:.0f}; {needed:.0f} is required, because "
        f"large scales have {background:.1f} times the power of small ones"
    )
    if gain <= needed:
        return straight, reason
    return _fit_shape(tiles, shapes["hyperbolic"], start, background), reason


def _fit_shape(
    tiles: TileSums, cls: type[FringeShape], start: Start, background: float = 1.0
) -> SetFit:
    """Fit a shape and the gauge modes to all pixels by Gauss-Newton steps."""
    shape = cls.start(start)
    size = len(shape.names)
    pixels = max(float(tiles.pixels.sum()), 1.0)
    carrier = Carrier(start.k, start.reference)
    for steps in range(1, MAX_STEPS + 1):
        basis = ModeBasis(shape, carrier)
        normal, right, square = basis.sums(tiles)
        free = np.linalg.lstsq(normal, right[:, 0], rcond=1e-12)[0]
        spread = background * max(1.0, float(square - free @ right[:, 0]) / pixels)
        c = basis.solve(normal, right, spread)
        step = c[:size, 0]
        moved = np.sqrt(
            abs(step @ normal[:size, :size] @ step) / max(np.trace(normal[:1, :1]), 1e-300)
        )
        if shape.linear or moved < STEP_RAD or steps == MAX_STEPS:
            break
        shape = shape.moved(step)
    rest = float(square - 2 * c[:, 0] @ right[:, 0] + c[:, 0] @ normal @ c[:, 0])
    return SetFit(basis, c, basis.covariance(normal, spread), rest, spread, steps)


def describe(fitted: SetWithShape, masked: int, sigma_px: float) -> dict[str, Any]:
    """Entry of a set in ``fit.json``; ``sigma_px``: median error of unmasked pixels."""
    source, facts, shape, fit = fitted.source, fitted.facts, fitted.shape, fitted.fit
    ny, nx = source.shape
    kx, ky = fitted.vector
    k = float(np.hypot(kx, ky))
    ratio = np.median([p.ratio for p in fitted.planes if np.isfinite(p.sigma)])
    count = len(shape.names)
    origin = float(shape.phase(np.zeros(1), np.zeros(1))[0])
    return {
        "frames": source.n_frames,
        "pixels": ny * nx,
        "pixels_masked": masked,
        "interfringe_px": 2 * np.pi / k,
        "geometry": shape.facts(fit.covariance[:count, :count]),
        "kx": kx,
        "ky": ky,
        "nominal_kx": facts["nominal_k"][0],
        "nominal_ky": facts["nominal_k"][1],
        "period_note": _period_note(k, float(np.hypot(*facts["nominal_k"]))),
        "phase_at_origin_rad": float(np.remainder(origin, 2 * np.pi)),
        "axis": [kx / k, ky / k],
        "visibility": float(1 / ratio),
        "sigma_median_px": sigma_px,
        "crb_median_px": None if facts["bound_rad"] is None else facts["bound_rad"] / k,
        "chi2_reduced": facts["chi2_reduced"],
        "sigma_scale": fitted.sigma_scale,
        "fringe_vector_moves": facts["moving"],
        "iterations": fit.steps,
        "passes": facts["chunks_read"] / facts["chunks"],
        "chunks_read": facts["chunks_read"],
        "chunks": facts["chunks"],
        "batch_frames": facts["batch_frames"],
        "batch_period_s": facts["batch_period_s"],
        "batch_note": facts["batch_note"],
        "removed_modes": list(fit.basis.names),
        "model": fitted.model,
        "evidence": fitted.evidence,
    }


def _period_note(k: float, nominal: float) -> str:
    """Note on a fringe vector (rad/px) far from the nominal length; "" if close."""
    if abs(nominal / k - 1) <= FAR_PERIOD:
        return ""
    return (
        f"the fringe period is {2 * np.pi / k:.3g} px, but baseline_mm, wavelength_nm and "
        f"distance_mm of acquisition.yaml give {2 * np.pi / nominal:.3g} px; correct whichever is "
        "wrong"
    )
