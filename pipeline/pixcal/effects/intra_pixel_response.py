"""Intra-pixel response: the fringe is averaged over each pixel."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.frame_series.fringe_motion import CROSSED
from pixcal.estimators.maps.visibility_scatter import Products, visibility_products
from pixcal.kernels import optics
from pixcal.kernels.beams import LightMaps
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.kernels.scene import TILE, DetectorMaps, Rows, chip_map, geometry
from pixcal.kernels.significance import SIGNIFICANT, root_with_error
from pixcal.model.arrays import F32, F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, FringeMaps, Stage
from pixcal.simulation.recording import Recording

REPEAT = 0.002  # assumed relative agreement of the visibilities of two fibre pairs
_ALIKE = "the visibility scatters equally in sets of crossed fringes"
SHARED = f"{_ALIKE}, which pixel widths do not cause"
UNTESTED = f"{_ALIKE}; a second fringe period along an axis shows whether pixel widths cause it"
_MIN_PIXELS = 200
_APART = 1.1
_STEP = 1e-3  # change of the width for derivatives, px
_SQUARE = 1e-4  # the same of its square, px²


@dataclass(frozen=True)
class IntraPixelResponse(Effect):
    """Each pixel responds uniformly over a width along x and y, which differs from pixel to pixel.

    Lithography varies the two widths independently, charge diffusion equally.

    `predict` and `undo` take the mean width.
    """

    name = "intra_pixel_response"
    title = "intra-pixel response"
    acts_at = Stage.PIXEL
    order = 1
    domains = ("space",)
    strengths = ("width_px", "width_rms_px")
    frames_needed = ("baseline",)
    sources = (
        "Janesick, Scientific Charge-Coupled Devices (SPIE 2001), chapter 4: the aperture of a "
        "pixel has the transfer function sin(u) / u",
        "Barron et al. 2007, PASP 119, 466: the response within pixels, measured by spots, is "
        "nearly a box, blurred by diffusion",
    )

    width_px: tuple[float, float] = quantity((0.95, 0.95), unit="px", low=0, high=3)
    """mean width of the response along x and y"""
    width_rms_px: float = quantity(0.005, unit="px", low=0, high=0.5)
    """rms of the width from pixel to pixel, each axis"""
    alike: float = quantity(0.0, low=0, high=1)
    """share of that variance which is common to both axes of a pixel"""

    def pixels(
        self, light: LightMaps, recording: Recording, rows: Rows, maps: DetectorMaps
    ) -> LightMaps:
        if recording.kind != "fringes":
            return light
        detector = recording.bench.detector
        k = optics.paraxial_vector(geometry(recording.bench, recording.number))
        factor = np.ones(light.iota.shape)

        def drawn(of: object) -> F32:
            return chip_map(detector, rows, f"{self.name}-{of}", lambda r: r.standard_normal(TILE))

        common = np.sqrt(self.alike) * drawn("both") if self.alike else 0.0
        for axis, (width, rate) in enumerate(zip(self.width_px, k, strict=True)):
            pattern = common + np.sqrt(1 - self.alike) * drawn(axis)
            factor *= transfer(rate, np.maximum(width + self.width_rms_px * pattern, 0))
        kept = factor.astype(np.float32)
        return replace(light, alpha_sin=light.alpha_sin * kept, alpha_cos=light.alpha_cos * kept)

    def predict(self, maps: FringeMaps) -> FringeMaps:
        return replace(maps, theta=maps.theta * self._factors(maps)[:, None, None])

    def undo(self, maps: FringeMaps) -> FringeMaps:
        return replace(maps, theta=maps.theta / self._factors(maps)[:, None, None])

    def _factors(self, maps: FringeMaps) -> F64:
        kept = np.prod([transfer(k, w) for k, w in zip(maps.k, self.width_px, strict=True)])
        return np.array([1.0, kept, kept])

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Width, the same along both axes, from the visibility of sets of other fringe spacing."""
        sets = [f for f in evidence.fringes.values() if np.count_nonzero(f.good) > _MIN_PIXELS]
        spacing = [np.hypot(*f.k) for f in sets]
        if not sets or max(spacing) < _APART * min(spacing):
            return None
        k = np.array([f.k for f in sets])
        square, error = _width(k, np.array([_log_visibility(f) for f in sets]))
        width, width_error = map(float, root_with_error(min(square, 9.0), error))
        scatter = _scatter(sets, max(width, 0.5), visibility_products(evidence, sets))
        rms, rms_error = map(float, root_with_error(scatter.variance, scatter.error))
        # A wider response changes the visibility more for the same scatter of its width.
        rms_error = float(np.hypot(rms_error, rms * width_error / max(width, 0.5)))
        return Estimate(
            cls((width, width), min(rms, 0.5), scatter.alike),
            {
                "width_px[0]": width_error,
                "width_px[1]": width_error,
                "width_rms_px": rms_error,
                **({"alike": scatter.alike_error} if scatter.alike else {}),
            },
            # Of the scatter only, because unequal fibre powers also change a visibility.
            scatter.variance / scatter.error,
            "visibility that varies from pixel to pixel, more strongly at shorter fringe periods",
            refused=scatter.refused,
        )


def transfer(k: Any, width: Any) -> Any:
    """Factor of the visibility of fringes of k rad/px by a box of given width, px."""
    return np.sinc(k * width / (2 * np.pi))


def _log_visibility(fringes: FringeEvidence) -> float:
    alpha = np.hypot(fringes.theta[1], fringes.theta[2])[fringes.good]
    return float(np.log(np.median(alpha / fringes.theta[0][fringes.good])))


def _width(k: F64, seen: F64) -> tuple[float, float]:
    """Square of the width and its error, px², from the logarithms of the visibilities."""

    def law(square: float) -> F64:
        """Logarithms of the visibilities, about their mean."""
        near = np.clip(square, 1e-6, 9)
        log, more = (
            np.log(np.abs(transfer(k, np.sqrt(near + step))).prod(axis=1)) for step in (0, _SQUARE)
        )
        # For negative squares the law is extended linearly, so that noise is not one-sided.
        model = log + (more - log) / _SQUARE * (square - near)
        return np.asarray(model - model.mean())

    fit = least_squares(lambda square: (seen - seen.mean() - law(*square)) / REPEAT, [0.0])
    return float(fit.x[0]), 1 / float(np.linalg.norm(fit.jac))


@dataclass(frozen=True)
class _Scatter:
    """Variance of the widths of pixels, px², from the visibilities of their fringes."""

    variance: float
    error: float
    alike: float = 0.0  # alike, alike_error: share that is common to both axes
    alike_error: float = 0.0
    refused: str = ""  # why widths do not explain the scatter, if they do not


def _scatter(sets: list[FringeEvidence], width: float, scatter: Products) -> _Scatter:
    """Widths that scatter independently along both axes, unless crossed fringes show otherwise."""
    # A part of the visibility that is independent of the fringes, which no width explains, is free.
    pairs, products, errors = scatter
    terms = np.empty((len(pairs), 3))
    for at, (m, n) in enumerate(pairs):
        slopes = _slopes(sets[m], width), _slopes(sets[n], width)
        terms[at] = slopes[0] @ slopes[1], 1.0, slopes[0].sum() * slopes[1].sum()
    crossed = [at for at, (m, n) in enumerate(pairs) if _cross(sets, m, n)]

    def fit(rows: slice, columns: slice) -> tuple[F64, F64]:
        design = terms[rows, columns] / errors[rows, None]
        covariance = inverse_normal(design.T @ design, 1e-15)
        return covariance @ design.T @ (products[rows] / errors[rows]), covariance

    (variance, _), covariance = fit(np.s_[: len(sets)], np.s_[:2])
    rest = products - terms[:, 0] * max(variance, 0.0)
    most = [np.sqrt(np.maximum(products[list(pairs[at])], 0).prod()) / 2 for at in crossed]
    shared = any(
        rest[at] > max(SIGNIFICANT * errors[at], m) for at, m in zip(crossed, most, strict=True)
    )
    if shared and len(pairs) > terms.shape[1]:
        (single, free, common), every = fit(np.s_[:], np.s_[:])
        # Twice the part that no width explains must be less than any crossed fringes share.
        of_widths = 2 * free < min(products[at] for at in crossed)
        if of_widths and common > SIGNIFICANT * np.sqrt(every[2, 2]):
            own, total = max(single, 0.0), single + common
            by_parts = np.array([[1.0, 0.0, 1.0], [-common, 0.0, own] / (own + common) ** 2])
            error, of_share = np.sqrt(np.diag(by_parts @ every @ by_parts.T)).tolist()
            return _Scatter(float(total), error, float(common / (own + common)), of_share)
    why = (SHARED if len(pairs) > terms.shape[1] else UNTESTED) if shared else ""
    return _Scatter(float(variance), float(np.sqrt(covariance[0, 0])), refused=why)


def _cross(sets: list[FringeEvidence], m: int, n: int) -> bool:
    """Whether the fringes of two sets differ in direction."""
    k, other = np.array([sets[m].k, sets[n].k])
    area = abs(k[0] * other[1] - k[1] * other[0])
    return bool(area >= CROSSED * np.hypot(*k) * np.hypot(*other))


def _slopes(fringes: FringeEvidence, width: float) -> F64:
    """Change (2,) of the logarithm of the visibility per pixel of width, along each axis."""
    k = np.array(fringes.k)
    wide, narrow = (np.log(np.abs(transfer(k, width + step))) for step in (_STEP, -_STEP))
    return np.asarray((wide - narrow) / (2 * _STEP))
