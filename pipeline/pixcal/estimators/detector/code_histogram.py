"""How often each code occurs, and the step of the codes."""

from collections.abc import Callable, Iterable
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d, uniform_filter1d
from scipy.optimize import minimize_scalar

from pixcal.model.arrays import F64, I64, Mask

FEWEST_CODES = 24
POPULATED = 20.0  # mean counts of codes around an empty one above which it is a gap
MAX_CODES = 1 << 17
NEAR = 0.1  # largest relative difference between the share of occupied codes and one over the step
MIN_AGREEMENT = 0.5
TIE = 0.01  # of a code: multiples of the step this near half-way may be rounded up or down


def histogram(frames: Iterable[NDArray[np.generic]], good: Mask) -> F64 | None:
    """Counts of the codes 0, 1, ... of frames (t, y, x); None unless samples are codes."""
    # Samples at either end may have been clipped, so they do not count.
    counts = np.zeros(MAX_CODES)
    for stack in frames:
        samples = stack if good.all() else stack[:, good]
        if samples.dtype.kind == "f":
            whole = np.rint(samples)
            if not np.array_equal(whole, samples):
                return None
            samples = whole
        if not samples.size or samples.min() < 0 or samples.max() >= MAX_CODES:
            return None
        of_stack = np.bincount(samples.ravel().astype(np.int64), minlength=MAX_CODES)
        highest = int(np.flatnonzero(of_stack)[-1])
        of_stack[[0, highest]] = 0
        counts += of_stack
    return counts


def step_of(counts: F64) -> tuple[float, float]:
    """Step of the converter in codes of the file, from the codes that never occur; its error."""
    there = np.flatnonzero(counts)
    if len(there) < FEWEST_CODES:
        return 1.0, 1.0
    half = max(16, int(4 * np.ptp(there) / len(there)))
    around = uniform_filter1d(counts, 2 * half + 1, mode="constant")
    # Only inside runs of populated codes, not at their ends.
    codes = np.flatnonzero(minimum_filter1d(around, 2 * half + 1, mode="constant") > POPULATED)
    if len(codes) < FEWEST_CODES:
        return 1.0, 1.0
    taken = counts[codes] > 0
    none = 1.0, 0.5 / float(codes[-1])
    if taken.all():
        return none
    period = _period(codes, taken)
    # The step is often a simple fraction, which the spectrum does not give exactly.
    simple = [float(Fraction(period).limit_denominator(n)) for n in (1, 2, 4, 16, 128, 1024)]
    trials = [t for t in (*simple, period) if t >= 1]
    agreed = [_agreement(codes, taken, trial) for trial in trials]
    if max(agreed) < MIN_AGREEMENT:
        return none
    step = trials[int(np.argmax(agreed))]
    return step, 0.5 * step / float(codes[-1])


def converter_counts(counts: F64, step: float) -> F64:
    """Counts of the codes of a converter whose step, in codes of the file, is known."""
    number = np.rint(np.arange(len(counts)) / step).astype(np.int64)
    return np.asarray(np.bincount(number, weights=counts))


def _period(codes: I64, there: Mask) -> float:
    """Step of a comb, from its spectrum near a frequency equal to the share of occupied codes."""
    share = float(there.mean())
    value = there - share

    def power(frequency: float) -> float:
        return float(np.abs(value @ np.exp(-2j * np.pi * frequency * codes)))

    spread = np.zeros(codes[-1] + 1)
    spread[codes] = value
    spectrum = np.abs(np.fft.fft(spread, 4 * 2 ** int(np.ceil(np.log2(len(spread))))))
    # For steps below two the frequency exceeds half a cycle per code: the upper half of the FFT.
    frequency = np.arange(len(spectrum)) / len(spectrum)
    near = np.abs(frequency - share) < min(NEAR * share, (1 - share) / 2)
    best = float(frequency[near][np.argmax(spectrum[near])])
    return 1 / highest(power, best, 1 / len(spectrum))


def highest(power: Callable[[float], float], start: float, width: float) -> float:
    """Frequency of the highest power near a start, within a width."""
    maximum = minimize_scalar(
        lambda f: -power(f),
        bounds=(start - width, start + width),
        method="bounded",
        options={"xatol": 1e-6 * width},
    )
    return float(maximum.x)


def _agreement(codes: I64, there: Mask, step: float) -> float:
    """Share of the gaps that a step predicts, less the share of occupied codes that it excludes."""
    multiple = np.rint(codes / step)
    distance = np.abs(codes - multiple * step)
    # A multiple half-way between two codes is rounded up or down: exactly one of the two occurs.
    tie = np.abs(distance - 0.5) <= TIE
    two = tie[1:] & tie[:-1] & (multiple[1:] == multiple[:-1])
    neither = np.count_nonzero(two & ~there[1:] & ~there[:-1])
    both = np.count_nonzero(two & there[1:] & there[:-1])
    gaps, foreseen = ~there, distance > 0.5 - TIE
    wrong = np.count_nonzero((distance > 0.5 + TIE) & there) + both
    predicted = np.count_nonzero(foreseen & gaps) - neither
    return float(predicted / max(gaps.sum(), 1) - wrong / max(there.sum(), 1))
