"""How wide the codes of a converter are, by how often each comes up.

Noise of a code or more makes the light that falls on a code a smooth function of the code. So what
changes quickly from code to code is the converter: the counts against a local fit of themselves.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d, uniform_filter1d
from scipy.optimize import minimize_scalar
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.special import log_ndtr

from pixcal.model.arrays import F64, I64, Mask

MAX_CODES = 1 << 17
FEWEST_COUNTS = 5.0  # expected counts of a code that counts
FEWEST_CODES = 24
CARRY = 32  # codes whose multiples turn over so many bits that their sum may be off by several
POPULATED = 20.0  # counts of codes around from which an empty one is a gap
NEAR = 0.1  # how far the share of codes that come up may be from one over the step
MIN_AGREEMENT = 0.5
TIE = 0.01  # of a code: multiples of the step this near half-way may be rounded up or down
_ORDER = 3
_MIN_HALF, _MAX_HALF = 4, 12
_CALM = 101
_NO_CHANGE = 1e-6
_MISSED = 3.0
# scatter of counts that light brings about: levels of pixels do not lie evenly on codes
_UNEVEN = 2e-3
# fits of the weights of bits, until the misfit falls by less than
_BIT_FITS, _SETTLED = 12, 0.1
# how far apart levels may be where a bit turns over, of its weight; codes up to which this is
# tried, in steps of so many
_WRONG, _TRIED = 0.05, ((40.0, 0.25), (0.5, 0.05))
_SMALL = 0.25  # changes (codes) for derivatives, where levels change places
_CLEARLY = 25.0  # chi-square by which levels in an order of their own must fit better
# codes of noise below which the peak of dark frames is too narrow for a local fit
MIN_NOISE = 1.4
# shares of the codes below which they may be even and above which they may not; how much larger
# than chance the squares of the widths are then, and how many codes below may be as uneven
_SPLITS, _CLEAR, _EVEN = (0.03, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75), 25.0, 0.05
_WIDTH_FITS = 12  # of widths whose variances are found by the fit before
_FEW = 0.15  # median over mean square of the widths (0.45 if normal) below which few are uneven
_FLOOR = 0.01  # least variance of a width, of that of chance, for how likely it is
_TOLD = 4.0  # median square of the widths over that of chance, above which most are uneven
LOWEST_RIPPLE = 1 / 16  # turns a code


def histogram(frames: Iterable[NDArray[np.generic]], good: Mask) -> F64 | None:
    """Counts of the codes 0, 1, ... of frames (t, y, x); None where samples are no codes.

    Samples at either end may have been clipped, so they do not count.
    """
    counts = np.zeros(MAX_CODES)
    for stack in frames:
        samples = stack[:, good]
        if samples.dtype.kind == "f":
            whole = np.rint(samples)
            if not np.array_equal(whole, samples):
                return None
            samples = whole
        if not samples.size or samples.min() < 0 or samples.max() >= MAX_CODES:
            return None
        found = np.bincount(samples.ravel().astype(np.int64), minlength=MAX_CODES)
        highest = int(np.flatnonzero(found)[-1])
        found[[0, highest]] = 0
        counts += found
    return counts


def step_of(counts: F64) -> tuple[float, float]:
    """Step of the converter in codes of the file, by the codes that never come; and its error."""
    there = np.flatnonzero(counts)
    if len(there) < FEWEST_CODES:
        return 1.0, 1.0
    half = max(16, int(4 * np.ptp(there) / len(there)))
    around = uniform_filter1d(counts, 2 * half + 1, mode="constant")
    # Within the runs of populated codes, not at their ends.
    codes = np.flatnonzero(minimum_filter1d(around, 2 * half + 1, mode="constant") > POPULATED)
    if len(codes) < FEWEST_CODES:
        return 1.0, 1.0
    taken = counts[codes] > 0
    none = 1.0, 0.5 / float(codes[-1])
    if taken.all():
        return none
    found = _period(codes, taken)
    # A whole number of steps often makes a whole number of codes: of that the spectrum is not sure.
    simple = [float(Fraction(found).limit_denominator(n)) for n in (1, 2, 4, 16, 128, 1024)]
    trials = [t for t in (*simple, found) if t >= 1]
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
    """Step of a comb, by its spectrum about the frequency that the share of its teeth tells."""
    share = float(there.mean())
    value = there - share

    def power(frequency: float) -> float:
        return float(np.abs(value @ np.exp(-2j * np.pi * frequency * codes)))

    spread = np.zeros(codes[-1] + 1)
    spread[codes] = value
    spectrum = np.abs(np.fft.fft(spread, 4 * 2 ** int(np.ceil(np.log2(len(spread))))))
    # Of steps below two the frequency is above half a turn a code: the other side of the spectrum.
    frequency = np.arange(len(spectrum)) / len(spectrum)
    near = np.abs(frequency - share) < min(NEAR * share, (1 - share) / 2)
    best = float(frequency[near][np.argmax(spectrum[near])])
    return 1 / _highest(power, best, 1 / len(spectrum))


def _highest(power: Callable[[float], float], start: float, width: float) -> float:
    found = minimize_scalar(
        lambda f: -power(f),
        bounds=(start - width, start + width),
        method="bounded",
        options={"xatol": 1e-6 * width},
    )
    return float(found.x)


def _agreement(codes: I64, there: Mask, step: float) -> float:
    """Share of the gaps that a step foresees, less that of codes it says cannot come."""
    multiple = np.rint(codes / step)
    distance = np.abs(codes - multiple * step)
    # Half-way the next multiple rounds up or down: of two such codes one comes, and one does not.
    tie = np.abs(distance - 0.5) <= TIE
    two = tie[1:] & tie[:-1] & (multiple[1:] == multiple[:-1])
    neither = np.count_nonzero(two & ~there[1:] & ~there[:-1])
    both = np.count_nonzero(two & there[1:] & there[:-1])
    gaps, foreseen = ~there, distance > 0.5 - TIE
    wrong = np.count_nonzero((distance > 0.5 + TIE) & there) + both
    found = np.count_nonzero(foreseen & gaps) - neither
    return float(found / max(gaps.sum(), 1) - wrong / max(there.sum(), 1))


@dataclass(frozen=True)
class Ripple:
    """The strongest line in the widths."""

    period: float  # codes
    amplitude: float
    amplitude_error: float
    phase: float  # at code zero, rad
    log_chance: float  # logarithm of the chance of one as strong anywhere


class Law(NamedTuple):
    """Where a code begins, by the levels that the weights of its bits make."""

    below: float  # share of a threshold that the level of the code below sets
    any_code: bool = False  # whether that is the code of the next lower level, whatever its number


# By successive approximation a bit is taken if it fits; or the nearest of the levels is taken, that
# of the code itself or of the next, or of all levels.
FITS, NEAREST, NEAREST_OF_ALL = Law(0.0), Law(0.5), Law(0.5, any_code=True)


@dataclass(frozen=True)
class WrongBits:
    """Weights of bits that are off, and how sure that is."""

    bits: F64  # (n,) by how much, codes, the least bit first
    law: Law
    covariance: F64  # (n, n)
    chi2: float  # of the bits
    misfit: float  # chi-square of the widths, once they are taken out


def level_errors(bits: F64, codes: int) -> F64:
    """By how much (codes) wrong weights of bits move the levels of codes 0 to ``codes - 1``."""
    errors = np.zeros(1)
    for bit in bits:
        errors = np.concatenate([errors, errors + bit])
    return np.resize(errors, codes)


def code_cells(bits: F64, law: Law, codes: int) -> tuple[F64, I64]:
    """Where each code begins, and the codes in this order; those never reached are left out.

    ``bits``: (n,) by how much (codes) the weight of each bit is off, lowest bit first.
    """
    level = np.arange(codes) + level_errors(bits, codes)
    order = np.argsort(level, kind="stable") if law.any_code else np.arange(codes)
    level = level[order]
    lower = np.concatenate([[level[0] - 1], level[:-1]])
    return level - 0.5 + law.below * (lower + 1 - level), order


@dataclass(frozen=True)
class CodeWidths:
    """Relative widths of codes, less one and less what a local fit takes."""

    number: I64  # (n,) of the converter's codes
    width: F64  # (n,)
    variance: F64  # (n,) of the counts by chance, relative
    kernel: F64  # (m,) what multiplies the true widths: one less the local fit
    gap: Mask  # of every code, whether the local fit does without it

    def kept(self, frequency: float) -> float:
        """Share of a line's amplitude that the local fit leaves; frequency in turns a code."""
        at = np.arange(len(self.kernel)) - len(self.kernel) // 2
        return float(self.kernel @ np.cos(2 * np.pi * frequency * at))

    def scatter(self) -> tuple[float, float, float]:
        """Variance of the widths by independent thresholds, its error, and its significance."""
        square = float(self.kernel @ self.kernel)
        more = (square - float(self.kernel[1:] @ self.kernel[:-1])) / square
        there = ~self.gap[self.number]
        variance = self.variance[there]
        excess = self.width[there] ** 2 / square - variance
        size = 0.0
        for _ in range(4):
            weight = 1 / (2 * (variance + max(size, 0.0)) ** 2 + variance**3)
            size = float(weight @ excess / weight.sum())
        # Neighbours' squares are related by up to a quarter.
        error = float(np.sqrt(1.5 / weight.sum()))
        chance = 1 / (2 * variance**2 + variance**3)
        sigmas = float(chance @ excess / np.sqrt(chance.sum()))
        return size / more, error / more, sigmas

    @property
    def measured(self) -> F64:
        """The true width of every code from 0 on, less one.

        What a local fit takes of the widths is given back as far as codes explain it that are wide
        or narrow, each by itself, or thresholds that are displaced, which leave the response where
        it is: such as those beside codes that are left out. Where few codes are uneven, both are
        tried and the likelier is taken: a reference that is off widens one code, and displaces all
        thresholds up to the next one.
        """
        square = self.width**2
        few = float(np.median(square)) < _FEW * float(np.mean(square))
        few |= float(np.median(square / self.variance)) < _TOLD
        found, unlikely = self._measured(displaced=True, few=few)
        if few:
            wide, unlikely_so = self._measured(displaced=False, few=True)
            if unlikely_so < unlikely:
                # A slope is a gain.
                above = np.arange(len(wide)) >= self.number[0]
                for _ in range(_WIDTH_FITS):
                    wide = np.maximum(wide - wide[self.number].mean() * above, -1)
                return wide
        # A code that begins after a higher one is never reached.
        ends = np.arange(1, len(found) + 1) + np.cumsum(found)
        ends = np.maximum(np.minimum.accumulate(ends[::-1])[::-1], 0)
        return np.diff(ends, prepend=0) - 1

    def _measured(self, displaced: bool, few: bool) -> tuple[F64, float]:
        """Widths of all codes, less one, and how unlikely such are (-2 log marginal likelihood).

        By thresholds that are ``displaced``, or by codes that are wide or narrow; ``few`` of these
        have a variance each (Tipping 2001, sparse Bayesian learning, without posterior variances).
        """
        top = int(self.number[-1]) + 1
        half = len(self.kernel) // 2
        bands = [self.kernel[half + k] * np.ones(top) for k in range(-half, half + 1)]
        # The local fit does without codes that are left out.
        there = diags_array(np.where(self.gap[:top], 0.0, 1.0))
        gaps = diags_array(np.where(self.gap[:top], 1.0, 0.0))
        design = diags_array(bands, offsets=range(-half, half + 1), shape=(top, top)) @ there + gaps
        ends = [-np.ones(top), (1.0 if displaced else 0.0) * np.ones(top - 1)]
        widths_of = csr_array(diags_array(ends, offsets=[0, 1], shape=(top, top)))
        design = csr_array(design @ widths_of)[self.number]
        weight = diags_array(1 / self.variance)
        normal, data = design.T @ weight @ design, self.width
        chance = float(np.median(self.variance))
        own = np.full(top, float(np.mean(self.width**2)) * (0.5 if displaced else 1.0))
        evidence = design.T @ weight
        for _ in range(_WIDTH_FITS):
            solved = splu(csc_array(normal + diags_array(1 / own))).solve(evidence @ data)
            found = widths_of @ solved
            if few:
                own = solved**2 + chance
            raised = self._raised(np.where(self.gap[:top], 0.0, found))
            raised = np.where(self.gap[:top], 1.0, raised)[self.number]
            data = self.width * raised
        # Of the counts, which were raised to make the data.
        own = solved**2 + _FLOOR * chance
        weight = diags_array(1 / (self.variance * raised**2))
        evidence = design.T @ weight
        factors = splu(csc_array(evidence @ design + diags_array(1 / own)))
        likeliest = factors.solve(evidence @ data)
        determinant = np.log(own).sum() + np.log(np.abs(factors.U.diagonal())).sum()
        misfit = data @ (weight @ data) - likeliest @ (evidence @ data)
        return found, float(misfit + determinant)

    @property
    def uneven_above(self) -> bool:
        """Whether codes are uneven from some code on, and even below.

        So it is in files of cameras that read bright pixels at another gain, in coarser steps.
        """
        square = self.width**2
        for share in _SPLITS:
            split = int(share * len(square))
            typical = float(np.median(square[split:]))
            told = self.variance[:split] < typical / _CLEAR
            like = square[:split][told] > typical / 4
            clear = typical > _CLEAR * np.median(self.variance[split:])
            if clear and len(like) >= FEWEST_CODES and like.mean() < _EVEN:
                return True
        return False

    def wrong_bits(self, scatter: float) -> WrongBits:
        """Errors of the bits' weights (codes), and which level is taken, of nearby ones."""
        tried = [self._wrong_bits(scatter, law) for law in (FITS, NEAREST)]
        return min(tried, key=lambda one: one.misfit)

    def far_bits(self, near: Law) -> WrongBits | None:
        """The nearest of all levels; None unless it explains clearly more than the law ``near``."""
        start = self._far(NEAREST_OF_ALL)
        scatter = 2 * self.without(start, NEAREST_OF_ALL).scatter()[0]
        far = self._wrong_bits(scatter, NEAREST_OF_ALL, start)
        again = self._wrong_bits(scatter, near)
        return far if far.misfit < again.misfit - _CLEARLY else None

    def _wrong_bits(self, scatter: float, law: Law, start: F64 | None = None) -> WrongBits:
        bits, covariance = self.bits(scatter, law, start)
        inverse = np.linalg.pinv(covariance, rcond=1e-9, hermitian=True)
        weight = 1 / (self.variance + max(scatter, 0.0))
        misfit = float(weight @ self.without(bits, law).width ** 2)
        return WrongBits(bits, law, covariance, float(bits @ inverse @ bits), misfit)

    def bits(self, scatter: float, law: Law = FITS, start: F64 | None = None) -> tuple[F64, F64]:
        """By how much each bit's weight is off, in codes, the least first; and the covariance.

        A bit that does not change within the codes at hand gets nothing. The common factor of all
        weights, a gain, does not change the local widths: the smallest errors are given (`level`
        gives others). A weight that is more than a code too small leaves several codes out, which
        is no linear change, so the fit is repeated about what was found, by changes of a code;
        where levels change places, by small ones.

        scatter : variance of the widths beside
        law : of the converter
        start : (n,) errors of the weights from where the fit begins
        """
        number = self._bits
        change = _SMALL if law.any_code else 1.0
        weight = 1 / (self.variance + max(scatter, 0.0))
        bits = np.zeros(number) if start is None else start
        left = self.width - self._left_out(bits, law)
        misfit = float(weight @ left**2)
        for _ in range(_BIT_FITS):
            slopes = [
                self._left_out(bits + e, law) - self._left_out(bits - e, law)
                for e in change * np.eye(number)
            ]
            design = np.stack(slopes, 1) / (2 * change)
            normal = (design.T * weight) @ design
            scale = 1 / np.sqrt(np.maximum(np.diag(normal), _NO_CHANGE))
            gain = np.where(np.diag(normal) > _NO_CHANGE, 2.0 ** np.arange(number) / scale, 0.0)
            rest = np.eye(number) - np.outer(gain, gain) / max(float(gain @ gain), 1e-300)
            scaled = rest @ (normal * np.outer(scale, scale)) @ rest
            inverse = np.linalg.pinv(scaled, rcond=1e-6, hermitian=True)
            covariance = inverse * np.outer(scale, scale)
            moved = bits + covariance @ (design.T @ (weight * left))
            after = self.width - self._left_out(moved, law)
            better = misfit - float(weight @ after**2)
            if better <= 0:
                break
            bits, left, misfit = moved, after, misfit - better
            if better < _SETTLED:
                break
        return bits, covariance

    def _far(self, law: Law) -> F64:
        """Wrong bits, from the highest down, by how far apart levels are where each turns over."""
        bits, place = np.zeros(self._bits), np.arange(self._bits)
        turning = np.isin(2**place, (self.number & -self.number)[1:])
        for reach, step in _TRIED:
            for bit in np.flatnonzero(turning)[::-1]:
                way = np.where(place > bit, 2.0 ** (place - bit - 1), place == bit)
                most = min(_WRONG * 2.0**bit, reach)
                tried = np.vstack([bits, bits + np.outer(np.arange(-most, most, step), way)])
                left = [self.width - self._left_out(one, law) for one in tried]
                bits = tried[np.argmin([float(np.sum(w**2 / self.variance)) for w in left])]
        return np.asarray(bits)

    @property
    def _bits(self) -> int:
        return (len(self.gap) - 1).bit_length()

    def level(self, bits: F64) -> F64:
        """Bits with a common factor by which the response has no slope over the codes at hand."""
        changing = np.ptp(self.number[:, None] >> np.arange(len(bits)) & 1, axis=0) > 0
        gain = np.where(changing, 2.0 ** np.arange(len(bits)), 0.0)
        of_bits, of_gain = (
            np.polyfit(self.number, level_errors(own, len(self.gap))[self.number], 1)[0]
            for own in (bits, gain)
        )
        return np.asarray(bits - of_bits / of_gain * gain)

    def _left_out(self, bits: F64, law: Law) -> F64:
        """Widths (n,) that wrong weights of bits bring about, less what the local fit takes."""
        begins, order = code_cells(bits, law, len(self.gap))
        # A code that begins after a higher one is never reached.
        begins = np.minimum.accumulate(begins[::-1])[::-1]
        width = np.ones(len(begins))
        width[order[:-1]] = np.diff(begins)
        return self._after_fit(width[:-1] - 1)[self.number]

    def _after_fit(self, width: F64) -> F64:
        """Widths of codes 0, 1, ..., less one, as they come out relative to a local fit."""
        gap = self.gap[: len(width)]
        there = np.where(gap, 0.0, width)
        left = np.convolve(there, self.kernel, "same")
        return np.asarray(np.where(gap, left + width, left / self._raised(there)))

    def _raised(self, width: F64) -> F64:
        """By what factor widths, less one, raise the counts that a local fit expects."""
        taken = width - np.convolve(width, self.kernel, "same")
        return np.asarray(np.maximum(1 + uniform_filter1d(taken, len(self.kernel)), 0.1))

    def without(self, bits: F64, law: Law = FITS) -> "CodeWidths":
        """The rest, once the wrong weights of bits (codes) are taken out."""
        return replace(self, width=self.width - self._left_out(bits, law))

    def ripple(self, scatter: float) -> Ripple:
        """The strongest line, over chance and a scatter of the widths (variance)."""
        weight = ~self.gap[self.number] / (self.variance + max(scatter, 0.0))
        value = weight * self.width
        total, noise = float(weight.sum()), float(weight**2 @ self.variance)
        own = float(weight @ weight) * max(scatter, 0.0)

        def line(frequency: float) -> complex:
            turn = np.exp(-2j * np.pi * frequency * self.number)
            return complex(value @ turn) / self.kept(frequency)

        def power(frequency: float) -> float:
            return float(np.abs(line(frequency)) ** 2 / level(frequency))

        def level(frequency: float) -> float:
            """Mean power without a line: of displaced thresholds it rises with the frequency."""
            return noise + own * 2 * float(np.sin(np.pi * frequency)) ** 2

        count = int(np.ptp(self.number)) + 1
        spread = np.zeros(4 << (count - 1).bit_length())
        spread[self.number - self.number[0]] = value
        spectrum = np.abs(np.fft.rfft(spread)) ** 2
        frequency = np.arange(len(spectrum)) / len(spread)
        # Below, the local fit takes it; close to the end it cannot be told from the end.
        seen = (frequency > LOWEST_RIPPLE) & (frequency < 0.5 - 2 / count)
        levels = noise + own * 2 * np.sin(np.pi * frequency[seen]) ** 2
        best = float(frequency[seen][np.argmax(spectrum[seen] / levels)])
        best = _highest(power, best, 1 / len(spread))
        # Even and odd codes have a cosine alone.
        ends = float(np.real(line(0.5)))
        top = float(np.log(2) + log_ndtr(-abs(ends) * self.kept(0.5) / np.sqrt(level(0.5))))
        free = np.log(2 * count) - power(best) * self.kept(best) ** 2
        if top < free:
            error = np.sqrt(level(0.5)) / total
            phase = 0.0 if ends > 0 else np.pi
            return Ripple(2.0, abs(ends) / total, float(error), phase, min(top + np.log(2), 0.0))
        found = 2 * line(best) / total
        error = np.sqrt(2 * level(best)) / total / self.kept(best)
        chance = float(min(free + np.log(2), 0.0))
        return Ripple(1 / best, abs(found), float(error), float(np.angle(found)), chance)


def code_widths(
    counts: F64, noise: float, first: float = 0.0, last: float = np.inf
) -> CodeWidths | None:
    """Widths from the counts (n,) of a converter's codes; None where too few came up.

    ``noise``: least noise of a sample, codes, from code ``first`` on; at ``last`` samples saturate.
    """
    half = int(np.clip(noise / 2, _MIN_HALF, _MAX_HALF))
    if noise < MIN_NOISE or len(counts) < 2 * _CALM:
        return None
    # Here: scipy.signal takes most of a second to import, and few runs need it.
    from scipy.signal import savgol_coeffs, savgol_filter

    length = 2 * half + 1
    gap = _carried_over(counts)
    code = np.arange(len(counts))
    filled = np.interp(code, code[~gap], counts[~gap])
    expected = savgol_filter(filled, length, _ORDER)
    # Weights that hardly depend on the code's own count.
    calm = uniform_filter1d(expected, length)
    used = (uniform_filter1d(filled, length) > FEWEST_COUNTS) & (calm > FEWEST_COUNTS)
    used &= (expected > 0) & (code >= first + half) & (code < last - length)
    if np.count_nonzero(used) < FEWEST_CODES:
        return None
    kernel = -savgol_coeffs(length, _ORDER)
    kernel[half] += 1
    width = (counts - expected)[used] / calm[used]
    # What another fit still changes, beyond what uneven codes do to it, the first one missed.
    again = np.convolve(kernel, savgol_coeffs(length, _ORDER))
    share = 2 * float(again @ again) / float(kernel @ kernel)
    change = uniform_filter1d((expected - savgol_filter(expected, length, _ORDER)) ** 2, length)
    missed = np.maximum(change - share * uniform_filter1d((filled - expected) ** 2, length), 0)
    variance = expected + _MISSED**2 * missed + (_UNEVEN * expected) ** 2
    number = np.flatnonzero(used)
    gap = np.concatenate([gap, np.zeros(length, bool)])[: number[-1] + length]
    return CodeWidths(number, width, variance[used] / calm[used] ** 2, kernel, gap)


def _carried_over(counts: F64) -> Mask:
    """Codes below a multiple of `CARRY` that never come among some that do, and the one before."""
    gap = np.zeros(len(counts), bool)
    around = uniform_filter1d(counts, 2 * _MAX_HALF + 1)
    for first in range(CARRY, len(counts), CARRY):
        below = counts[first - CARRY // 2 : first][::-1]
        empty = int(np.argmax(below > 0)) if below.any() else 0
        if empty and counts[first] > 0 and around[first] > POPULATED:
            gap[first - empty - 1 : first] = True
    return gap
