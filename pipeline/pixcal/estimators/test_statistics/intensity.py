"""Statistics in intensity: harmonics of the phase, residuals by level, photon transfer, codes."""

from functools import partial

import numpy as np

from pixcal.estimators.detector.flat_ladder import MIN_STEPS, ladder, straight_line
from pixcal.estimators.diagnosis.evidence import Evidence, cached_on_evidence
from pixcal.estimators.test_statistics import Curve, statistic
from pixcal.estimators.test_statistics.fringe_set_data import CODES, FringeSetData
from pixcal.model.arrays import F64

of_intensity = partial(statistic, "intensity")
of_intensity_power = partial(statistic, "intensity", power=True)

CLASSES = (4, 16, 64)


@of_intensity("harmonics of the fringes", "amplitude / α", x="harmonic (cosine, sine)")
def harmonics(data: FringeSetData) -> Curve | None:
    """Those that all pixels share."""
    orders, of_pixels = data.harmonics
    if not len(orders):
        return None
    sizes = of_pixels.mean(axis=1)
    places = np.add.outer(orders, (0, 0.25))
    return Curve(places.ravel(), np.stack([sizes.real, sizes.imag], axis=1).ravel())


@of_intensity_power(
    "harmonics of the fringes that differ from pixel to pixel", "amplitude / α", x="harmonic"
)
def pixel_harmonics(data: FringeSetData) -> Curve | None:
    """Median square: a few odd pixels do not count."""
    orders, sizes = data.harmonics
    if not len(orders):
        return None
    apart = np.abs(sizes - sizes.mean(axis=1, keepdims=True)) ** 2
    return Curve(orders.astype(float), np.median(apart, axis=1))


@of_intensity("mean residual against signal", "mean residual", unit="e-", x="bin of level")
def residual_by_level(data: FringeSetData) -> Curve:
    """Mean residual in bins of the level."""
    return Curve.numbered(data.by_level[0])


@of_intensity_power(
    "photon transfer: variance of flats against signal", "noise / expected noise", x="flat"
)
def photon_transfer(evidence: Evidence) -> Curve:
    """Variance of differences of flats over that of shot and read noise, for each level."""
    return Curve.numbered(_noise_of_flats(evidence))


@cached_on_evidence
def _noise_of_flats(evidence: Evidence) -> F64:
    values = []
    for stack in evidence.ladder if evidence.has_level else ():
        if len(stack.adu) < 2:
            continue
        light = (stack.adu - evidence.bias.astype(np.float32))[:, evidence.good] * np.float32(
            evidence.gain
        )
        light /= light.mean(axis=1, keepdims=True) / light.mean()
        steps = np.diff(light, axis=0)
        expected = np.maximum(light.mean(axis=0), 0) + evidence.read_noise**2
        values.append(float(np.mean(np.minimum(steps**2 / 2 / expected, 50))))
    return np.array(values)


@of_intensity_power(
    "photon transfer: shape of variance against signal",
    "noise / expected noise, over its mean",
    x="flat",
)
def photon_transfer_shape(evidence: Evidence) -> Curve | None:
    """The same over its mean: the curvature of the noise is known better than the gain."""
    values = _noise_of_flats(evidence)
    if len(values) < MIN_STEPS:
        return None
    return Curve.numbered(values / values.mean())


@of_intensity(
    "linearity: deviation of the flats from a line over exposure time",
    "relative deviation",
    x="exposure time of flats",
)
def flat_ladder(evidence: Evidence) -> Curve | None:
    """Departure of each level of one lamp from the line over exposure time."""
    flats = ladder(evidence)
    if flats is None:
        return None
    line = straight_line(flats.times, flats.levels, flats.times)
    return Curve(flats.times, flats.levels / line - 1)


@of_intensity("frequency of each bit in the samples", "frequency − ½", x="bit")
def bits(data: FringeSetData) -> Curve | None:
    """Excess over one half of the frequency with which each of the lowest bits is set."""
    count = data.remainders
    if count is None:
        return None
    bit = np.arange(CODES.bit_length() - 1)
    is_set = (np.arange(CODES) >> bit[:, None]) & 1
    return Curve(bit.astype(float), is_set @ count / count.sum() - 0.5)


@of_intensity_power("uniformity of ADC codes", "relative scatter", x="codes a class")
def code_classes(data: FringeSetData) -> Curve | None:
    """Scatter of the counts of codes, by their remainders on division by powers of two."""
    count = data.remainders
    if count is None:
        return None
    value = [float(np.var(count.reshape(-1, n).sum(axis=0) * n / count.sum())) for n in CLASSES]
    return Curve(np.array(CLASSES, float), np.array(value))
