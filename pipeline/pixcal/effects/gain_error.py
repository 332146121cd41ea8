"""Gain differs from the declared value."""

import math
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.detector.flat_noise import shot_share_of_flats
from pixcal.estimators.detector.multiplication import EXCESS_ERROR
from pixcal.estimators.detector.transfer_curve import CLIP, MIN_PIXELS, STEPS, shot_share
from pixcal.estimators.diagnosis.distortions import Freedom
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.kernels.residual_sums import residual_sums
from pixcal.kernels.scene import DetectorMaps, Rows
from pixcal.model.arrays import F32, F64
from pixcal.model.bench import Bench
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

_DISAGREE = 2.5
_MIN_FRAMES = 8


@dataclass(frozen=True)
class GainError(Effect):
    """The true gain (e-/ADU) differs from the one used; the samples in ADU do not change."""

    name = "gain_error"
    title = "gain that differs from the declared value"
    acts_at = Stage.CONVERTER
    order = 1
    domains = ("noise", "intensity")
    is_gain = True
    strengths = ("relative",)
    left_because = (
        "only SIGMA is wrong: correct gain_e_per_adu in acquisition.yaml, or use 'pixcal "
        "reduce --gain measured', and fit again"
    )
    frames_needed = ("flat",)
    remedy = "set gain_e_per_adu to the measured gain, or run 'pixcal reduce RUN --gain measured'"
    sources = (
        "Janesick 2007, Photon Transfer (SPIE PM170): gain by photon transfer, to about 1 % with "
        "some ten thousand pixels",
        "Moore, Ninkov & Forrest 2006, Opt. Eng. 45, 076402: crosstalk between pixels biases "
        "the gain by several per cent",
        "EMVA Standard 1288, release 4.0 (2021): system gain from variance against mean, "
        "of the camera's operating point and temperature",
    )

    relative: float = quantity(0.03, low=-0.9999, high=9999.0)
    """true gain over the gain used, minus 1; the variance of shot noise in ADU is smaller by as
    much"""

    def detector(self, maps: DetectorMaps, bench: Bench, rows: Rows) -> DetectorMaps:
        return replace(maps, dark_rate=maps.dark_rate * np.float32(1 + self.relative))

    def photons(self, mean: F32, shot: Shot) -> F32:
        return mean * np.float32(1 + self.relative)

    def signal(self, signal: F32, shot: Shot) -> F32:
        return signal / np.float32(1 + self.relative)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Ratio of signal-dependent noise to its expected value, in fringes and in flats."""
        ways = {
            "fringes": shot_share(
                s for f in evidence.fringes.values() if (s := _of_fringes(f)) is not None
            ),
            "flats": shot_share_of_flats(evidence),
        }
        by_method = {
            name: _of_light(*way, evidence.excess_noise_factor)
            for name, way in ways.items()
            if way is not None
        }
        if not by_method:
            return None
        share, error = _joined(by_method)
        relative, error = 1 / share - 1, error / share**2
        return Estimate(
            cls(float(np.clip(relative, -0.9999, 9999.0))),
            {"relative": float(error)},
            float(abs(relative) / error),
            f"noise that grows with the level in the {' and the '.join(by_method)} is "
            f"{share:.3f} times that expected with the gain used",
        )


def _of_light(share: float, error: float, excess: float) -> tuple[float, float]:
    """Share and error of the noise of the light, without that of multiplied electrons."""
    if excess == 1:
        return share, error
    return share / excess, math.hypot(error, EXCESS_ERROR * share) / excess


def _joined(by_method: dict[str, tuple[float, float]]) -> tuple[float, float]:
    """Share and error from all methods; from the flats only if the fringes disagree."""
    shares, errors = np.array(list(by_method.values())).T
    if len(by_method) == 2 and abs(shares[0] - shares[1]) > _DISAGREE * np.hypot(*errors):
        by_method = {"flats": by_method["flats"]}
        shares, errors = np.array(list(by_method.values())).T
    weight = 1 / errors**2
    return float((weight * shares).sum() / weight.sum()), float(weight.sum() ** -0.5)


def _of_fringes(fringes: FringeEvidence) -> F64 | None:
    """`residual_sums` of a fringe set; None with too few frames or good pixels."""
    pixels = np.count_nonzero(fringes.good)
    if len(fringes.g) < _MIN_FRAMES or pixels < MIN_PIXELS:
        return None
    freedom = Freedom(fringes)
    i, j = np.triu_indices(len(freedom.of_time))
    of_time = (freedom.of_time[i] * freedom.of_time[j]).T * np.where(i == j, 1, 2)
    of_pixels = np.zeros((len(i), *fringes.good.shape))
    of_pixels[:, fringes.good] = freedom.pixel_inverse[:, i, j].T
    # (B, A cos phi, A sin phi) of every frame, and free fringe vectors, absorb residuals in
    # proportion to the correlation of their patterns in neighbours.
    alike = np.cos(STEPS @ np.array([fringes.k[1], fringes.k[0]]))
    taken = (1 + (4 if np.any(fringes.dk) else 2) * alike) / pixels
    return residual_sums(
        fringes.residual,
        fringes.model,
        fringes.shot_factor,
        fringes.read_variance,
        fringes.good,
        of_time,
        of_pixels,
        taken,
        STEPS,
        CLIP,
    )
