"""Noise that a register adds to the light where it multiplies electrons (EMCCD)."""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv, ndtr

from pixcal.estimators.detector.flat_noise import shot_share_of_flats
from pixcal.estimators.detector.multiplication import EXCESS, EXCESS_ERROR
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.arrays import F32
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

_MANY = 30.0  # electrons over the excess from which the cube root of a gamma variate is normal
_POSSIBLE = (1.3, 2.2)  # measured F² of a register; others are those of a wrong gain


@dataclass(frozen=True)
class ExcessNoise(Effect):
    """Each electron is multiplied by a random number, so noise is F times that of the light."""

    name = "excess_noise"
    title = "excess noise of an electron-multiplying register"
    acts_at = Stage.SIGNAL
    order = 0
    domains = ("noise",)
    strengths = ("excess",)
    left_because = "noise that is independent in each pixel averages out"
    frames_needed = ("flat",)
    remedy = "none: the measured gain allows for it; the signal-to-noise ratio is lower by F"
    sources = (
        "Robbins & Hadwen 2003, IEEE Trans. Electron Devices 50, 1227: F² is 2 - 1/G for a "
        "multiplication G in many stages",
    )

    excess: float = quantity(1.0, low=0, high=10)
    """F² - 1: variance added to a signal, over its shot noise"""

    def signal(self, signal: F32, shot: Shot) -> F32:
        if not (self.excess and shot.bench.shot_noise):
            return signal
        # A gamma variate has the mean and variance, and nearly the skewness, of the sum.
        normals, scale = shot.normals(self.name), np.float32(self.excess)
        shape = np.maximum(signal, 0) / scale
        some = np.maximum(shape, np.float32(_MANY))
        drawn = shape * (1 - 1 / (9 * some) + normals / (3 * np.sqrt(some))) ** 3
        few = (shape > 0) & (shape < _MANY)
        drawn[few] = gammaincinv(shape[few].astype(float), ndtr(normals[few].astype(float)))
        return np.asarray(np.where(signal > 0, scale * drawn, signal), np.float32)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """From photon transfer of flats, if the third moment of their noise shows a register."""
        measured = shot_share_of_flats(evidence)
        if measured is None:
            return None
        share, error = measured
        if evidence.excess_noise_factor <= 1:
            why = "the third moment of the noise of flats shows no multiplied electrons"
            return Estimate(cls(0.0), {"excess": error}, 0.0, why)
        if not _POSSIBLE[0] < share < _POSSIBLE[1]:
            share, error = EXCESS, EXCESS * EXCESS_ERROR
        return Estimate(
            cls(share - 1),
            {"excess": error},
            (share - 1) / error,
            f"noise that grows with the level has {share:.3g} times the variance of the light, and "
            "the third moment of multiplied electrons",
            size={
                "value": share,
                "error": error,
                "unit": "",
                "of": "= F², variance over shot-noise variance",
            },
        )
