"""The telescope that the stars are seen through, and how bright they are."""

import math
from dataclasses import asdict, dataclass

import numpy as np

from pixcal.estimators.star_centroids.centroids import Star
from pixcal.kernels.psf import Psf, diffraction_psf
from pixcal.model.acquisition import Detector as Declared
from pixcal.model.errors import InputError

FULL_WELL_E = 50_000.0  # where the acquisition declares none (paper, table 1)
WINDOW = 4.0  # half of the default window, in lambda / D: three dark rings
SAMPLINGS = (0.4, 40.0)  # pixels in lambda / D that the table of the pattern is made for
MICROARCSECONDS = 180 / np.pi * 3600e6


@dataclass(frozen=True)
class Telescope:
    """A telescope and its detector's pixels."""

    diameter_m: float
    focal_length_m: float
    wavelength_nm: float
    obscuration: float
    pitch_um: float

    def __post_init__(self) -> None:
        low, high = SAMPLINGS
        if not low <= self.sampling <= high:
            raise InputError(
                f"--focal-length, --wavelength, --diameter: {self.sampling:.3g} px in lambda/D, "
                f"from {low:g} to {high:g} can be done; change one of them"
            )

    @property
    def sampling(self) -> float:
        """Pixels in lambda / D; Nyquist's limit is 2."""
        image = self.wavelength_nm * 1e-3 * self.focal_length_m / self.diameter_m
        return image / self.pitch_um

    @property
    def uas_per_px(self) -> float:
        """Plate scale, µas."""
        return self.pitch_um * 1e-6 / self.focal_length_m * MICROARCSECONDS

    def psf(self, window: int | None) -> tuple[Psf, int]:
        """The pattern in its pixels, and half of the window's side, px."""
        half = max(2, math.ceil(WINDOW * self.sampling)) if window is None else window // 2
        return diffraction_psf(self.sampling, self.obscuration, half), half

    def facts(self) -> dict[str, float]:
        """For the JSON."""
        return asdict(self) | {"uas_per_px": self.uas_per_px, "px_per_lambda_over_d": self.sampling}


def exposures(psf: Psf, electrons: float, detector: Declared) -> int:
    """Number of exposures of a star such that no pixel saturates."""
    return max(1, math.ceil(electrons * psf.peak / (detector.full_well_e or FULL_WELL_E)))


def star(psf: Psf, half: int, electrons: float, background: float, detector: Declared) -> Star:
    """A star with the given electrons over all exposures, each with its read noise."""
    read_variance = exposures(psf, electrons, detector) * detector.read_noise_e**2
    return Star(psf, half, electrons, background, read_variance)
