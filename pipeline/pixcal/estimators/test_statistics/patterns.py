"""Statistics of patterns in single frames: tones of the noise, and smooth light or offsets.

A tone whose phase differs in every frame is absent from maps, and hardly correlates neighbours. A
frame's fit absorbs its level and its fringes, but no other smooth pattern.
"""

import numpy as np
from scipy.fft import rfft2

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.test_statistics import Curve, family, statistic
from pixcal.estimators.test_statistics.frame_differences import differences, repeated
from pixcal.estimators.test_statistics.fringe_set_data import FringeSetData, pattern_sizes
from pixcal.estimators.test_statistics.time import DISTINCT
from pixcal.kernels.significance import sigmas_of_largest
from pixcal.model.arrays import F32, F64, Mask

KINDS = (("bias",), ("dark",))
AT_ONCE = 8  # frames whose transforms stay in the caches
FLOOR = 0.7  # standard deviation of a significance, by chance, at least


def highest_ordinate(noise: F32, good: Mask) -> Curve:
    """Highest ordinate of the mean periodogram of frames (t, y, x), beside rows and columns.

    Noise is over its standard deviation, zero in bad pixels: mean 1 if white; a tone of amplitude A
    adds N A² / 4, of N good pixels.
    """
    power = np.zeros((noise.shape[1], noise.shape[2] // 2 + 1))
    for frames in np.array_split(noise, -(-len(noise) // AT_ONCE)):
        tones = rfft2(frames)
        power += (tones.real**2 + tones.imag**2).sum(axis=0, dtype=float)
    power /= len(noise) * np.count_nonzero(good)
    # Noise of whole rows or columns has its own statistics.
    power[0] = power[:, 0] = 0
    y, x = np.unravel_index(int(np.argmax(power)), power.shape)
    frequency = float(np.hypot(np.fft.fftfreq(noise.shape[1])[y], x / noise.shape[2]))
    return Curve(np.array([frequency]), np.array([float(power[y, x])]))


def tone_sigmas(noise: F32, good: Mask) -> Curve:
    """Significance of the highest ordinate, a standard normal for white noise."""
    # An ordinate has Wilson and Hilferty's distribution (1931), with two degrees of freedom per
    # frame.
    highest = highest_ordinate(noise, good)
    ninth = 1 / (9 * len(noise))
    normal = (float(np.cbrt(highest.value[0])) - (1 - ninth)) / np.sqrt(ninth)
    count = (noise.shape[1] - 1) * (noise.shape[2] // 2)
    return Curve(highest.x, np.array([sigmas_of_largest(normal, count)]))


def strongest(sizes: F64) -> float:
    """Largest singular value of sizes (n, pattern): an amplitude, of nearly normal scatter."""
    return float(np.linalg.svd(sizes, compute_uv=False)[0])


@statistic(
    "noise",
    "strongest tone in fringe frames",
    "significance",
    unit="σ",
    x="cycles a pixel",
    floor=FLOOR,
)
def tone(data: FringeSetData) -> Curve:
    """Of the residuals."""
    return tone_sigmas(data.residual[:: data.thinned], data.good)


@family(
    "{0}_tone",
    KINDS,
    "noise",
    "strongest tone in {0} frames",
    "significance",
    unit="σ",
    x="cycles a pixel",
    floor=FLOOR,
)
def tones(kind: str, evidence: Evidence) -> Curve | None:
    """Of the differences of two frames."""
    noise = _all_differences(kind, evidence)
    return None if noise is None else tone_sigmas(noise, evidence.good)


@statistic("time", "smooth patterns that vary over the frames", "strongest / noise of one frame")
def smooth_patterns(data: FringeSetData) -> Curve:
    """Root mean square of the strongest pattern in the residuals."""
    sizes = data.pattern_sizes
    return Curve.numbered([strongest(sizes) / np.sqrt(len(sizes))])


@family(
    "{0}_smooth_patterns",
    KINDS,
    "time",
    "smooth patterns that vary over {0} frames",
    "strongest / noise of one frame",
)
def smooth_patterns_of(kind: str, evidence: Evidence) -> Curve | None:
    """The same of the differences of two frames."""
    noise = _all_differences(kind, evidence)
    if noise is None:
        return None
    sizes = pattern_sizes(noise, evidence.good)
    return Curve.numbered([strongest(sizes) / np.sqrt(len(sizes))])


@statistic("time", "smooth patterns that follow the phase", "strongest", unit="σ")
def smooth_patterns_by_phase(data: FringeSetData) -> Curve | None:
    """Size of the strongest pattern that follows two and three times the frame's phase."""
    phi = data.fringes.phi
    # The pixels' fit absorbs patterns that follow the phase itself.
    taken = np.linalg.qr(np.stack([np.ones_like(phi), np.cos(phi), np.sin(phi)], axis=1))[0]
    turns = np.stack([f(n * phi) for n in (2, 3) for f in (np.cos, np.sin)], axis=1)
    shapes, size, _ = np.linalg.svd(turns - taken @ (taken.T @ turns), full_matrices=False)
    shapes = shapes[:, size > DISTINCT * np.sqrt(len(phi))]
    if not shapes.size:
        return None
    sizes = shapes.T @ data.pattern_sizes
    return Curve.numbered([strongest(sizes)])


def _all_differences(kind: str, evidence: Evidence) -> F32 | None:
    stacks = repeated(evidence, kind)
    return np.concatenate([differences(evidence, s) for s in stacks]) if stacks else None
