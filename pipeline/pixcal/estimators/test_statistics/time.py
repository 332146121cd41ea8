"""Statistics in time: changes from frame to frame, slow or dependent on the frame before."""

from functools import partial
from itertools import pairwise

import numpy as np
from scipy.fft import dct

from pixcal.estimators.detector.flat_ladder import level_before, light_of
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.test_statistics import Curve, family, statistic
from pixcal.estimators.test_statistics.fringe_set_data import FringeSetData
from pixcal.kernels.frame_order import follows
from pixcal.kernels.sample_sums import frame_means
from pixcal.kernels.significance import sigmas_of_t
from pixcal.model.arrays import F64

of_time = partial(statistic, "time")
of_time_power = partial(statistic, "time", power=True)

SERIES = (
    ("intensity", "intensity", "relative intensity, rms", ""),
    ("contrast", "contrast", "relative contrast, rms", ""),
    ("turn_along", "fringe vector, along", "change of phase, rms", "rad"),
    ("turn_across", "fringe vector, across", "change of phase, rms", "rad"),
)
STACKS = (
    ("bias", "level, rms", "e-"),
    ("dark", "level, rms", "e-"),
    ("flat", "relative intensity, rms", ""),
)
MIN_FRAMES = 8
_LEVELS = 6  # fewest levels of flats whose first frames are compared with the others
_FOR_TREND = 3  # fewest frames whose level has a trend
LAGS = (1, 2, 3, -1, -2)
BATCHES = 8
# smallest singular value, over the largest, of shapes that a sequence of phases separates; a ramp
# of equal steps, or four of them, does not separate all
DISTINCT = 0.05


def power_of(series: F64) -> Curve:
    """Mean squares of a series of frames in bins of frequency, of three modes and more."""
    power = dct(series, norm="ortho")[1:] ** 2
    edges = [0]
    while edges[-1] < len(power):
        edges.append(min(2 * edges[-1] + 3, len(power)))
    if len(edges) > 2 and edges[-1] - edges[-2] < 3:
        edges.pop(-2)
    middle = [(a + b + 1) / 4 / len(series) for a, b in pairwise(edges)]
    value = [float(power[a:b].mean()) for a, b in pairwise(edges)]
    return Curve(np.array(middle), np.array(value))


@of_time("signal carried over from other frames", "share of the signal", x="frames before")
def frames_before(data: FringeSetData) -> Curve:
    """Share of another frame's fringes in the residuals, after what the pixels' own fits absorb."""
    g, theta = data.fringes.g, data.theta
    noise = np.sqrt(data.variance)[:, None]
    basis = np.linalg.qr(g)[0]
    along = noise * (data.residual.reshape(len(g), -1) @ theta.T)
    square = (theta @ theta.T).astype(float)
    values = []
    for lag in LAGS:
        other = np.roll(g, lag, axis=0)
        other -= basis @ (basis.T @ other)
        other[~follows(data.fringes.frame, lag)] = 0
        size = np.einsum("ti,ij,tj->", other, square, other)
        values.append(float(np.vdot(other, along) / size))
    return Curve(np.array(LAGS, float), np.array(values))


@of_time(
    "contrast against the phase step from earlier frames",
    "slope of the contrast",
    x="frames before",
)
def contrast_by_step(data: FringeSetData) -> Curve:
    """Slope of the contrast against the cosine of the step."""
    contrast, phi = data.frames["contrast"], data.fringes.phi
    slow = np.stack([np.ones(len(phi)), np.linspace(-1, 1, len(phi))], axis=1)
    values = []
    for lag in LAGS[:3]:
        later = np.flatnonzero(follows(data.fringes.frame, lag))
        terms = np.column_stack([slow[later], np.cos(phi[later] - phi[later - lag])])
        values.append(float(np.linalg.lstsq(terms, contrast[later], rcond=DISTINCT)[0][-1]))
    return Curve(np.array(LAGS[:3], float), np.array(values))


@of_time("contrast and intensity against phase", "relative amplitude", x="term")
def frames_by_phase(data: FringeSetData) -> Curve:
    """Amplitudes of contrast and intensity at one, two and three times the frame's phase."""
    phi = data.fringes.phi
    turns = [f(n * phi) for n in (1, 2, 3) for f in (np.cos, np.sin)]
    terms = np.stack([np.ones(len(phi)), *turns], axis=1)
    values = [
        np.linalg.lstsq(terms, data.frames[name], rcond=DISTINCT)[0][1:]
        for name in ("contrast", "intensity")
    ]
    value = np.concatenate(values)
    return Curve.numbered(value)


@of_time_power(
    "Allan deviation of the offsets over batches",
    "Allan deviation",
    unit="px",
    x="batches averaged",
)
def allan_of_batches(data: FringeSetData) -> Curve | None:
    """Allan variance of the pixels' offsets, over lengths of one, two and four batches."""
    fringes = data.fringes
    size = len(fringes.g) // BATCHES
    if size < 8:
        return None
    k = float(np.hypot(*fringes.k))
    good = data.good.ravel()
    _, of_sine, of_cosine = data.theta[:, good].astype(float)
    shifts = []
    for n in range(BATCHES):
        batch = slice(n * size, (n + 1) * size)
        inverse = np.linalg.pinv(fringes.g[batch])[1:].astype(np.float32)
        c, s = (inverse @ data.electrons[batch])[:, good]
        # theta = (iota, alpha sin psi, alpha cos psi): a turn of psi moves along (cos, -sin).
        shifts.append((c * of_cosine - s * of_sine) / (of_sine**2 + of_cosine**2) / k)
    values = np.stack(shifts)
    out = []
    for length in (1, 2, 4):
        means = values.reshape(BATCHES // length, length, -1).mean(axis=1)
        out.append(float((np.diff(means, axis=0) ** 2).mean() / 2))
    return Curve(np.array([1.0, 2.0, 4.0]), np.array(out))


@of_time(
    "first flat of each exposure time relative to the following ones", "significance", unit="σ"
)
def first_flats(evidence: Evidence) -> Curve | None:
    """Mean relative change over the levels, and slope against the rise from the frame before."""
    # Lamp flicker changes each level independently. Lag changes the first frame by a share of the
    # rise, which is large only where the series of exposure times begins. Both are over their
    # errors from the scatter of the levels: the flicker of few frames is hardly known.
    stacks = [s for s in evidence.ladder if len(s.adu) > 1]
    every = [light_of(evidence, s) for s in stacks]
    if len(every) < _LEVELS or min(light.mean() for light in every) <= 0:
        return None
    steps = np.array([float(light[0] / light[1:].mean()) - 1 for light in every])
    before = np.array([level_before(evidence, s) for s in stacks])
    lacking = 1 - before / [light.mean() for light in every]
    return Curve.numbered([_sigmas(steps, shape) for shape in (np.ones_like(steps), lacking)])


def _sigmas(values: F64, shape: F64) -> float:
    """Significance of a shape in values whose scatter is unknown."""
    freedom, square = len(values) - 1, float(shape @ shape)
    size = float(values @ shape) / square
    rest = values - size * shape
    t = size * np.sqrt(square * freedom / max(float(rest @ rest), 1e-30))
    return sigmas_of_t(float(t), freedom)


@family(
    "{0}_of_frames",
    SERIES,
    "time",
    "{1}: spectrum over the frames",
    "{2}",
    unit="{3}",
    x="cycles a frame",
    power=True,
)
def series_of_frames(name: str, data: FringeSetData) -> Curve:
    """Mean squares of a parameter of the frames."""
    return power_of(data.frames[name])


@family(
    "{0}_of_frames",
    STACKS,
    "time",
    "mean of {0} frames: spectrum",
    "{1}",
    unit="{2}",
    x="bin of frequency",
    power=True,
)
def means_of_frames(kind: str, evidence: Evidence) -> Curve | None:
    """Mean squares of the means of calibration frames; of flats, over their light."""
    every = evidence.ladder if kind == "flat" else evidence.of_kind(kind)
    values = []
    for stack in (s for s in every if len(s.adu) >= MIN_FRAMES):
        means = frame_means(stack.adu, evidence.good) * evidence.gain
        light = float(means.mean() - evidence.gain * evidence.bias[evidence.good].mean())
        scale = light if kind == "flat" and light > 0 else 1.0
        values.append(power_of(means / scale).value[:3])
    if not values:
        return None
    shortest = min(map(len, values))
    value = np.mean([v[:shortest] for v in values], axis=0)
    return Curve.numbered(value)


@of_time(
    "trend of the level without light",
    "change of level",
    unit="e-",
    x="exposure time without light",
)
def bias_trend(evidence: Evidence) -> Curve:
    """Slope of the mean of bias and dark frames over their run, last less first."""
    times, values = [], []
    for stack in (*evidence.of_kind("bias"), *evidence.of_kind("dark")):
        if len(stack.adu) >= _FOR_TREND and np.ptp(stack.time_s) > 0:
            means = frame_means(stack.adu, evidence.good) * evidence.gain
            time = stack.time_s - stack.time_s.mean()
            times.append(float(np.nan_to_num(stack.exptime_s)))
            values.append(float(np.polyfit(time / np.ptp(time), means, 1)[0]))
    return Curve(np.array(times), np.array(values))
