"""Bright pixels shrink, because collected charge deflects the charge that follows."""

from dataclasses import dataclass

import numpy as np

from pixcal.estimators.crosstalk.boundaries import SharedCharge, shared_charge
from pixcal.estimators.detector.response import Boundaries, boundaries_alone, boundaries_beside
from pixcal.estimators.diagnosis.central_crop import central_crop
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.boundaries import REACH, boundary_shifts, moved_charge
from pixcal.kernels.significance import sigmas_of_chi2
from pixcal.model.arrays import F32, F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

_FITTED = ("shift_px_per_e", "along_y", "falloff_px")
_DISAGREE = 4.0
_LAW_ERROR = 0.1  # relative, of the shift: near noise and far harmonics may differ by it
# significance, with a free response, above which it may explain all harmonics
_HINTED = 1.5
_NEEDED = 12.0  # chi-square of three terms above which they are needed: one in 130 by chance
_APART = 9.0  # chi-square above which shifts along x and y differ
_MAX_ALONG_Y = 10.0  # largest ratio of the shift along y to that along x
_MAX_SHIFT = 1e-3  # px/e-; wells of a few thousand electrons have 1e-5 and more
_TURNS = 4  # iterations of the inverse; each cuts the error to a few per cent


@dataclass(frozen=True)
class BrighterFatter(Effect):
    """Pixel boundaries shift with the charge around them (`pixcal.kernels.boundaries`)."""

    name = "brighter_fatter"
    title = "brighter-fatter effect"
    acts_at = Stage.CHARGE
    order = 1
    domains = ("intensity", "noise", "space")
    strengths = ("shift_px_per_e",)
    frames_needed = ("ladder", "baseline")
    remedy = (
        "already included in the measured gain; bright spots broaden with signal: correct "
        "fitted widths"
    )
    quick = False
    sources = (
        "Antilogus et al. 2014, JINST 9, C03048: spots grow by up to 2 % over the full range; "
        "thinned sensors have it too",
        "Guyonnet et al. 2015, A&A 575, A41: boundaries that shift in proportion to the charges",
        "Astier et al. 2019, A&A 629, A36: covariance of flats, C_ij = a_ij mu^2",
        "Plazas et al. 2018, PASP 130, 065004: the same in a CMOS-read H2RG",
    )

    shift_px_per_e: float = quantity(2.0e-7, unit="px/e-", low=0, high=_MAX_SHIFT)
    """shift of a pixel's boundaries by each electron in it"""
    falloff_px: float = quantity(0.5, unit="px", above=0, high=10)
    """distance over which the shift falls by a factor e"""
    along_y: float = quantity(1.0, low=0, high=_MAX_ALONG_Y)
    """ratio of the shift along y to that along x"""

    @property
    def halo(self) -> int:
        return REACH

    @property
    def _shifts(self) -> F64:
        return self.shift_px_per_e * boundary_shifts(self.falloff_px)

    def charge(self, charge: F32, shot: Shot) -> F32:
        wide = shot.surrounded(charge, REACH)
        inside = slice(REACH, -REACH)
        # Dark current is generated inside pixels, that of hot ones at single defects.
        dark = np.pad(shot.maps.dark_rate * np.float32(shot.recording.exptime_s), REACH, "edge")
        moved = moved_charge(wide, self._shifts, self.along_y, wide - dark)
        return charge + moved[inside, inside]

    def undo_samples(self, charge: F32) -> F32:
        corrected = charge
        for _ in range(_TURNS):
            corrected = charge - moved_charge(corrected, self._shifts, self.along_y)
        return corrected

    @property
    def undo_halo(self) -> int:
        return _TURNS * (REACH + 1)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """From the covariance of neighbours and the second harmonic of the fringes."""
        evidence = central_crop(evidence)
        alone = _explaining(evidence, cls().falloff_px) if evidence.fringes else None
        # With another falloff than that of the harmonics, noise might seem to contradict them.
        falloff = cls().falloff_px if alone is None else alone.falloff_px
        noise = shared_charge(evidence, boundary_shifts(falloff))
        if noise is None:
            return None
        size, variance = noise.size, noise.variance
        significance = float(size / np.sqrt(variance))
        why = "covariance of neighbours that rises with the square of the level"
        along_y = 1.0
        if not evidence.fringes:
            size, variance, along_y, significance = _by_axis(noise)
            why += ", which crosstalk with a share that grows with the level would cause as well"
        else:
            shift, of_shift, _ = boundaries_beside(evidence, falloff)
            if _agree(noise, shift, of_shift):
                known = size, variance + (_LAW_ERROR * shift) ** 2
                size, variance, gain = boundaries_beside(evidence, falloff, known)
                significance = float(np.copysign(np.sqrt(max(gain, 0.0)), size))
                why += ", and a second harmonic of the fringes that depends on their direction"
        errors: dict[str, float] = {"shift_px_per_e": float(np.sqrt(variance))}
        together: list[dict[str, float]] = []
        if alone is not None and significance > _HINTED:
            mean = alone.shift * (1 + alone.along_y) / 2
            if _agree(noise, mean, alone.steps[0, 0] ** 2):
                size, along_y = alone.shift, alone.along_y
                sizes = np.linalg.norm(alone.steps, axis=0)
                errors, *together = (
                    {n: float(v) for n, v in zip(_FITTED, step, strict=True) if v}
                    for step in (sizes, *alone.steps)
                )
                why += "; no nonlinearity is needed in addition"
        effect = cls(float(np.clip(size, 0, _MAX_SHIFT)), falloff, along_y)
        alike = () if evidence.fringes else ("ipc",)  # its shares may grow with the level
        return Estimate(effect, errors, significance, why, tuple(together), alike=alike)


def _by_axis(noise: SharedCharge) -> tuple[float, float, float, float]:
    """Shift between columns, its variance, ratio of the shift between rows, significance."""
    together = noise.size**2 / noise.variance
    chi2 = float(noise.axes @ np.linalg.solve(noise.covariance, noise.axes))
    if chi2 - together < _APART:
        return noise.size, noise.variance, 1.0, float(noise.size / np.sqrt(noise.variance))
    along_x, along_y = noise.axes
    size = max(along_x, along_y / _MAX_ALONG_Y, 0.0)
    ratio = float(np.clip(along_y / size, 0, _MAX_ALONG_Y)) if size > 0 else 1.0
    sigmas = sigmas_of_chi2(chi2, 2) if size > 0 else -1.0
    return size, float(noise.covariance[0, 0]), ratio, sigmas


def _explaining(evidence: Evidence, otherwise_px: float) -> Boundaries | None:
    """Boundaries that explain all harmonics; None if a nonlinear response is also needed."""
    boundaries = boundaries_alone(evidence, otherwise_px)
    return boundaries if boundaries.against <= max(_NEEDED, boundaries.shapes) else None


def _agree(noise: SharedCharge, shift: float, variance: float) -> bool:
    """Whether a shift by the harmonics does not contradict the noise of neighbours."""
    variance += noise.variance + (_LAW_ERROR * shift) ** 2
    return (shift - noise.size) ** 2 < _DISAGREE**2 * variance
