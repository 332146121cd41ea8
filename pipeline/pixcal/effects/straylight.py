"""Light that does not interfere: laser light scattered in the bench, of a smooth pattern."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.evidence import Evidence, FringeEvidence
from pixcal.estimators.map_fit import MapFit, MapPart, centred, fit_maps, gauge_terms
from pixcal.estimators.row_ramp import RowRamp, enough_for_rows
from pixcal.kernels.scene import DetectorMaps, LightMaps, Rows
from pixcal.kernels.significance import sigmas_of_chi2
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, FringeMaps, Stage
from pixcal.simulation.recording import Recording

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_MIN_PIXELS = 200
_SURE = 5.0
_CROSSED = 0.3
"""Sine of the angle between two baselines that tell of both slopes."""


@dataclass(frozen=True)
class Straylight(Effect):
    """Incoherent light in the fringe frames, in units of the fibres' own at the same place.

    It follows the laser's power. The mean light becomes ``1 + share + slope·r`` times what it was,
    the fringe stays: the visibility falls, the offsets keep still. Flats, of another lamp, do not
    have it. Where the pattern would be negative there is none.
    """

    name = "straylight"
    title = "scattered light that does not interfere"
    stage = Stage.LIGHT
    domains = ("space",)
    strengths = ("share", "slope_per_px")
    told_by = ("axis",)
    sources = (
        "Rousset et al., eq. 3: straylight is a part of the mean term B iota (design/paper.txt)",
        "Harvey et al. 2012, Opt. Eng. 51, 013402: a clean surface of 2 nm rms scatters "
        "(4 pi 2 / 633)^2 = 0.16 %; black walls reflect some per cent of what misses the detector",
    )

    share: float = quantity(
        0.02, low=0, high=10, doc="of the fibres' light, in the window's first pixel"
    )
    slope_per_px: tuple[float, float] = quantity(
        (4e-5, -2e-5), unit="1/px", low=-1, high=1, doc="how the share grows along x and y"
    )

    def pattern(self, rows: Rows, columns: Rows) -> F64:
        """Share (y, x) on some rows and columns of the window (first, one after the last)."""
        y, x = np.arange(*rows)[:, None], np.arange(*columns)
        share = self.share + self.slope_per_px[0] * x + self.slope_per_px[1] * y
        return np.asarray(np.maximum(share, 0.0))

    def light(
        self, light: LightMaps, recording: Recording, rows: Rows, maps: DetectorMaps
    ) -> LightMaps:
        """As in `Effect.light`."""
        if recording.kind != "fringes":
            return light
        more = 1 + self.pattern(rows, (0, light.iota.shape[1]))
        return replace(light, iota=light.iota * more.astype(np.float32))

    def predict(self, maps: FringeMaps) -> FringeMaps:
        """As in `Effect.predict`: iota alone changes."""
        return replace(maps, theta=np.stack([maps.theta[0] * self._more(maps), *maps.theta[1:]]))

    def undo(self, maps: FringeMaps) -> FringeMaps:
        """As in `Effect.undo`."""
        return replace(maps, theta=np.stack([maps.theta[0] / self._more(maps), *maps.theta[1:]]))

    def _more(self, maps: FringeMaps) -> F64:
        (row, column), (ny, nx) = maps.origin, maps.theta.shape[1:]
        return 1 + self.pattern((row, row + ny), (column, column + nx))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Slopes of the pattern from the gradient of the visibility, if it is that of all sets.

        Fibres of unequal light change the visibility along the baseline, or where their beams point
        apart; that differs from set to set, and what differs widens the errors. What rows lose to
        the next frame (`rolling_shutter`) is known from the residuals, and taken out. Where all
        baselines are parallel only the slope across them counts, and beams that point apart look
        alike. A share that is the same everywhere cannot be told from a lower visibility of the
        laser: what is given is the least that the slopes allow, for light is never negative, with
        an error that reaches to the most, where the laser's visibility is one.
        """
        sets = [f for f in evidence.fringes.values() if np.count_nonzero(f.good) > _MIN_PIXELS]
        if not sets:
            return None
        axes, fit, scale = _slopes(sets)
        most = max(1 / min(_visibility(f) for f in sets) - 1, 0.0)
        # The logarithm of 1 + share + slope x grows by slope / (1 + share).
        slope = np.clip(axes @ fit.values * (1 + most / 2), -1, 1)
        errors = np.sqrt(np.diag(axes @ fit.covariance @ axes.T) * scale)
        least, its_error = _least_share(evidence, slope, errors)
        unknown = max(most - least, 0.0) / np.sqrt(12)
        errors = np.hypot(errors * (1 + most / 2), np.abs(slope) * unknown)
        named = {f"slope_per_px[{n}]": float(e) for n, e in enumerate(errors) if e > 0}
        return Estimate(
            cls(least, (float(slope[0]), float(slope[1]))),
            named | {"share": float(np.hypot(its_error, unknown))},
            sigmas_of_chi2(fit.gain / scale, len(fit.values)),
            "gradient of the visibility that is common to all sets",
            {"share_at_most": most, "chi2_per_term_between_sets": scale},
        )


def _slopes(sets: list[FringeEvidence]) -> tuple[F64, MapFit, float]:
    """Axes (2, n) of the slopes that can be told, their fit, and by how much its variances grow."""
    k = np.array([f.k for f in sets])
    k /= np.hypot(*k.T)[:, None]
    if len(sets) == 1 or np.abs(k[1:, 0] * k[0, 1] - k[1:, 1] * k[0, 0]).max() < _CROSSED:
        across = np.array([[-k[0, 1]], [k[0, 0]]])
        return across, fit_maps([_part(f, across) for f in sets]), 1.0
    parts = [_part(f, np.eye(2)) for f in sets]
    fit = fit_maps(parts)
    own = [fit_maps([p]) for p in parts]
    apart = sum(
        (o.values - fit.values) @ np.linalg.solve(o.covariance, o.values - fit.values) for o in own
    )
    return np.eye(2), fit, max(1.0, float(apart) / (2 * len(sets) - 2))


def _visibility(found: FringeEvidence) -> float:
    alpha = np.hypot(found.theta[1], found.theta[2])[found.good]
    return float(np.median(alpha / found.theta[0][found.good]))


def _lost_by_rows(found: FringeEvidence) -> F64:
    """Share of the fringe (y, 1) that rows lose to the frame next to it, where that is sure."""
    lost = np.zeros(found.good.shape[0])
    if enough_for_rows(found):
        ramps = [RowRamp.of([found], way) for way in (1, -1)]
        for ramp in ramps:
            if ramp.slope > _SURE * ramp.error:
                lost += ramp.share(found)
    return lost[:, None]


def _part(found: FringeEvidence, axes: F64) -> MapPart:
    """Logarithm of iota / alpha, with slopes along some axes (2, n) as its signals."""
    alpha = np.hypot(found.theta[1], found.theta[2])
    good = found.good & (alpha > 0) & (found.theta[0] > 0)
    inverse = np.zeros(good.shape)
    inverse[good] = np.log(found.theta[0][good] / alpha[good])
    inverse -= _lost_by_rows(found)
    y, x = np.broadcast_arrays(*centred(good.shape))
    along = (found.k[0] * x + found.k[1] * y) / np.hypot(*found.k)
    # Unequal fibres: 1 / cosh of a straight line along the baseline.
    free = [np.ones(good.shape), along**2, *gauge_terms(found)]
    if axes.shape[1] == 1:
        free.append(along)
    slopes = np.einsum("an,ayx->nyx", axes, np.stack([x, y]))
    return MapPart.of(slopes, inverse, np.stack(free), good)


def _least_share(evidence: Evidence, slope: F64, errors: F64) -> tuple[float, float]:
    """Share in the first pixel that keeps the pattern above zero all over the part."""
    ny, nx = evidence.good.shape
    row, column = evidence.origin
    ends = np.array([[column + i * (nx - 1), row + j * (ny - 1)] for i in (0, 1) for j in (0, 1)])
    lowest = ends[np.argmin(ends @ slope)]
    share = abs(float(np.clip(-(lowest @ slope), 0.0, 10.0)))
    return share, float(max(np.hypot(*(ends.max(axis=0) * errors)), 1e-12))
