"""The gain that the nominal bench has: as flats and its declaration tell together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.kernels.gain_fit import LADDER
from pixcal.kernels.photon_transfer import neighbour_noise
from pixcal.model.arrays import F32, F64, Mask
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Effect, Stage
from pixcal.simulation.exposure import Camera
from pixcal.simulation.recording import Recording

DECLARED_ERROR = 0.01  # least relative error of a declared gain
FRAMES = 8  # flats that are simulated with and without effects, from the same random numbers
# shot noise over read noise, as variances, of a flat that tells what effects do to the former
LIT = 4.0
# steps whose effects change the noise of flats otherwise than a gain does
OF_NOISE = (Stage.CHARGE, Stage.SIGNAL)


@dataclass(frozen=True)
class MeasuredGain:
    """Gain of the amplifiers over the one that electrons were counted with."""

    amplifiers: F64  # (y, x) of each pixel's amplifier over the detector's mean
    # gain by photon transfer, and its 1-sigma error, of each part of the flats
    transfer: tuple[tuple[float, float], ...] = ()
    # lags (rows, columns) whose covariances the photon transfer counts
    neighbours: tuple[tuple[int, int], ...] = ()

    def drawn(self, rng: np.random.Generator, change: float = 1.0) -> F32:
        """Gain (y, x) over the one used, as it may be within its error.

        ``change``: what effects do to the variance of flats over their mean: by as much the photon
        transfer is wrong.
        """
        measured = np.array([value * change for value, _ in self.transfer])
        errors = np.array([error for _, error in self.transfer])
        # The declared gain is as wrong as the flats show it to be.
        apart = abs(np.average(measured, weights=errors**-2.0) - 1) if self.transfer else 0.0
        values = np.array([1.0, *measured])
        weights = np.array([max(DECLARED_ERROR, apart), *errors]) ** -2.0
        common = np.average(values, weights=weights) + weights.sum() ** -0.5 * rng.standard_normal()
        return np.asarray(max(common, 0.1) * self.amplifiers, np.float32)


def photon_transfer_change(
    bench: Bench,
    measured: Effect,
    effects: Sequence[Effect],
    recordings: Sequence[Recording],
    neighbours: Sequence[tuple[int, int]] = (),
) -> float:
    """What effects do to the variance of flats over their mean, neighbours at lags counted.

    One without flats below saturation. The gain that is measured by photon transfer is too large by
    the inverse of it, and a bench that is simulated with the effects must not have them twice.
    """
    flats = [r for r in recordings if r.kind == "flat" and r.electrons > 0 and r.count > 1]
    detector = bench.detector
    room = (detector.top_adu - detector.bias_adu) * detector.gain_e_per_adu
    flats = [r for r in flats if r.electrons < 0.8 * room]
    if not flats or not any(effect.acts_at in OF_NOISE for effect in effects):
        return 1.0
    if len(flats) < LADDER:
        flat = max(flats, key=lambda r: r.electrons)
    else:
        # Of a ladder the gain is that at level zero: the dimmest flat with little read noise.
        lit = [r for r in flats if r.electrons > LIT * detector.read_noise_e**2] or flats
        flat = min(lit, key=lambda r: r.electrons)
    dark = [r for r in recordings if r.kind == "bias"][:1]
    rows = (0, detector.shape[0])
    ratios = []
    for acting in ([measured], [measured, *effects]):
        camera = Camera(bench, rows, acting)
        good = camera.maps.mask == 0
        moments = [
            _moments(camera, replace(r, bench=bench), good, neighbours) for r in (flat, *dark)
        ]
        (mean, variance), *none = moments
        for offset, noise in none:
            mean, variance = mean - offset, variance - noise
        ratios.append(variance / mean)
    return float(np.clip(ratios[1] / ratios[0], 0.1, 10)) if min(ratios) > 0 else 1.0


def _moments(
    camera: Camera,
    recording: Recording,
    good: Mask,
    neighbours: Sequence[tuple[int, int]],
) -> tuple[float, float]:
    """Mean and variance in time of good pixels, ADU; common changes of frames taken off."""
    frames = range(min(FRAMES, recording.count))
    samples = np.stack([s.astype(np.float32) for _, s in camera.expose(recording, frames)])
    samples[:, ~good] = np.nan
    of_frames = np.nanmean(samples, axis=(1, 2))
    samples -= of_frames[:, None, None]
    return float(of_frames.mean()), neighbour_noise(samples, neighbours)
