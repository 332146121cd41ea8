"""Widths of a converter's codes, from how often each occurs.

Noise of a code or more makes the expected count a smooth function of the code. Rapid changes from
code to code are due to the converter: the counts are compared with a local fit to them.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.special import log_ndtr

from pixcal.estimators.detector.bit_weights import (
    FITS,
    NEAREST,
    NEAREST_OF_ALL,
    Law,
    WrongBits,
    code_cells,
)
from pixcal.estimators.detector.code_histogram import FEWEST_CODES, POPULATED, highest
from pixcal.model.arrays import F64, I64, Mask

FEWEST_COUNTS = 5.0  # least expected counts of a usable code
CARRY = 32  # codes; at its multiples so many bits change that their sum may be off by several
_ORDER = 3
_MIN_HALF, _MAX_HALF = 4, 12
_CALM = 101
_NO_CHANGE = 1e-6
_MISSED = 3.0
# relative scatter of counts from pixel levels that lie unevenly on codes
_UNEVEN = 2e-3
# most fits of the weights of bits; fall of the misfit that ends them
_BIT_FITS, _SETTLED = 12, 0.1
# largest error of the step between levels at a bit's change, over its weight; ranges and steps
# (codes) in which it is searched
_WRONG, _TRIED = 0.05, ((40.0, 0.25), (0.5, 0.05))
_SMALL = 0.25  # changes (codes) for derivatives, where the order of levels may change
_CLEARLY = 25.0  # chi-square by which reordered levels must fit better
# codes of noise below which the peak of dark frames is too narrow for a local fit
MIN_NOISE = 1.4
# shares of the codes at which unevenness may begin; least squared widths above, over chance; and
# largest share of codes below that may be as uneven
_SPLITS, _CLEAR, _EVEN = (0.03, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75), 25.0, 0.05
_WIDTH_FITS = 12  # fits of widths, with variances from the fit before
_FEW = 0.15  # median over mean square of the widths (0.45 if normal) below which few are uneven
_FLOOR = 0.01  # least variance of a width, over that by chance, in the likelihood
_TOLD = 4.0  # median square of the widths over chance, above which most are uneven
LOWEST_RIPPLE = 1 / 16  # cycles per code


@dataclass(frozen=True)
class Ripple:
    """The strongest line in the widths."""

    period: float  # codes
    amplitude: float
    amplitude_error: float
    phase: float  # at code zero, rad
    log_chance: float  # logarithm of the probability of one as strong at any period


@dataclass(frozen=True)
class CodeWidths:
    """Relative widths of codes, less one and less what a local fit absorbs."""

    number: I64  # (n,) of the converter's codes
    width: F64  # (n,)
    variance: F64  # (n,) of the counts by chance, relative
    kernel: F64  # (m,) filter on the true widths: one less the local fit
    gap: Mask  # for every code, whether the local fit excludes it

    def kept(self, frequency: float) -> float:
        """Share of a line's amplitude that the local fit leaves; frequency in cycles per code."""
        at = np.arange(len(self.kernel)) - len(self.kernel) // 2
        return float(self.kernel @ np.cos(2 * np.pi * frequency * at))

    def scatter(self) -> tuple[float, float, float]:
        """Variance of the widths for independent thresholds, its error, and its significance."""
        square = float(self.kernel @ self.kernel)
        more = (square - float(self.kernel[1:] @ self.kernel[:-1])) / square
        there = ~self.gap[self.number]
        variance = self.variance[there]
        excess = self.width[there] ** 2 / square - variance
        size = 0.0
        for _ in range(4):
            weight = 1 / (2 * (variance + max(size, 0.0)) ** 2 + variance**3)
            size = float(weight @ excess / weight.sum())
        # Squares of neighbours are correlated by up to a quarter.
        error = float(np.sqrt(1.5 / weight.sum()))
        chance = 1 / (2 * variance**2 + variance**3)
        sigmas = float(chance @ excess / np.sqrt(chance.sum()))
        return size / more, error / more, sigmas

    @property
    def measured(self) -> F64:
        """The true width of every code from 0 on, less one."""
        # What the local fit absorbed is restored, under one of two models: single codes are wide or
        # narrow, or thresholds are displaced, which leaves the response elsewhere unchanged, as
        # beside missing codes. Where few codes are uneven, the likelier model is taken: a wrong
        # reference widens one code and displaces all thresholds up to the next reference.
        square = self.width**2
        few = float(np.median(square)) < _FEW * float(np.mean(square))
        few |= float(np.median(square / self.variance)) < _TOLD
        widths, unlikely = self._measured(displaced=True, few=few)
        if few:
            wide, unlikely_so = self._measured(displaced=False, few=True)
            if unlikely_so < unlikely:
                # A slope is a gain.
                above = np.arange(len(wide)) >= self.number[0]
                for _ in range(_WIDTH_FITS):
                    wide = np.maximum(wide - wide[self.number].mean() * above, -1)
                return wide
        # A code that begins after a higher one is never reached.
        ends = np.arange(1, len(widths) + 1) + np.cumsum(widths)
        ends = np.maximum(np.minimum.accumulate(ends[::-1])[::-1], 0)
        return np.diff(ends, prepend=0) - 1

    def _measured(self, displaced: bool, few: bool) -> tuple[F64, float]:
        """Widths of all codes, less one, and -2 log marginal likelihood of their model."""
        # The model has ``displaced`` thresholds, or wide and narrow codes; if ``few``, each has its
        # own variance (Tipping 2001, sparse Bayesian learning, without posterior variances).
        top = int(self.number[-1]) + 1
        half = len(self.kernel) // 2
        bands = [self.kernel[half + k] * np.ones(top) for k in range(-half, half + 1)]
        # The local fit excludes gaps.
        there = diags_array(np.where(self.gap[:top], 0.0, 1.0))
        gaps = diags_array(np.where(self.gap[:top], 1.0, 0.0))
        design = diags_array(bands, offsets=range(-half, half + 1), shape=(top, top)) @ there + gaps
        ends = [-np.ones(top), (1.0 if displaced else 0.0) * np.ones(top - 1)]
        widths_of = csr_array(diags_array(ends, offsets=[0, 1], shape=(top, top)))
        design = csr_array(design @ widths_of)[self.number]
        weight = diags_array(1 / self.variance)
        normal, data = design.T @ weight @ design, self.width
        chance = float(np.median(self.variance))
        prior = np.full(top, float(np.mean(self.width**2)) * (0.5 if displaced else 1.0))
        evidence = design.T @ weight
        for _ in range(_WIDTH_FITS):
            solved = splu(csc_array(normal + diags_array(1 / prior))).solve(evidence @ data)
            widths = widths_of @ solved
            if few:
                prior = solved**2 + chance
            raised = self._raised(np.where(self.gap[:top], 0.0, widths))
            raised = np.where(self.gap[:top], 1.0, raised)[self.number]
            data = self.width * raised
        # Likelihood of the counts: the data were scaled by ``raised``.
        prior = solved**2 + _FLOOR * chance
        weight = diags_array(1 / (self.variance * raised**2))
        evidence = design.T @ weight
        factors = splu(csc_array(evidence @ design + diags_array(1 / prior)))
        likeliest = factors.solve(evidence @ data)
        determinant = np.log(prior).sum() + np.log(np.abs(factors.U.diagonal())).sum()
        misfit = data @ (weight @ data) - likeliest @ (evidence @ data)
        return widths, float(misfit + determinant)

    @property
    def uneven_above(self) -> bool:
        """Whether codes are uneven above some code, and even below."""
        # This occurs in cameras that read bright pixels at another gain, in coarser steps.
        square = self.width**2
        for share in _SPLITS:
            split = int(share * len(square))
            typical = float(np.median(square[split:]))
            constrained = self.variance[:split] < typical / _CLEAR
            like = square[:split][constrained] > typical / 4
            clear = typical > _CLEAR * np.median(self.variance[split:])
            if clear and len(like) >= FEWEST_CODES and like.mean() < _EVEN:
                return True
        return False

    def wrong_bits(self, scatter: float) -> WrongBits:
        """Errors of the bits' weights (codes) under the better of `FITS` and `NEAREST`."""
        return min((self.bits(scatter, law) for law in (FITS, NEAREST)), key=lambda one: one.misfit)

    def far_bits(self, near: Law) -> WrongBits | None:
        """Errors under `NEAREST_OF_ALL`; None unless it fits clearly better than ``near``."""
        start = self._far(NEAREST_OF_ALL)
        scatter = 2 * self.without(start, NEAREST_OF_ALL).scatter()[0]
        far = self.bits(scatter, NEAREST_OF_ALL, start)
        return far if far.misfit < self.bits(scatter, near).misfit - _CLEARLY else None

    def bits(self, scatter: float, law: Law = FITS, start: F64 | None = None) -> WrongBits:
        """Errors of the bits' weights, in codes, lowest bit first.

        A bit that does not change within the measured codes has zero error. A factor common to all
        weights, a gain, does not change local widths: the smallest errors are given (`level` gives
        others). A weight more than a code too small skips several codes. As this is nonlinear, the
        fit is iterated, with derivatives from changes of one code, or of less where the order of
        levels may change.

        scatter : variance of the widths by other causes
        law : of the converter
        start : (n,) errors of the weights at which the fit begins
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
        explained = float(weight @ self.width**2) - misfit
        return WrongBits(bits, law, covariance, explained, misfit)

    def _far(self, law: Law) -> F64:
        """Errors of bits, highest first, from the step between levels where each bit changes."""
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
        """Bits (n, ...) plus a gain, so that the response error has no slope over the codes."""
        has = (self.number[:, None] >> np.arange(len(bits)) & 1).astype(float)
        gain = np.where(np.ptp(has, axis=0) > 0, 2.0 ** np.arange(len(bits)), 0.0)
        slope = np.polyfit(self.number, has, 1)[0]
        return np.asarray(bits - np.multiply.outer(gain, slope @ bits) / (slope @ gain))

    def _left_out(self, bits: F64, law: Law) -> F64:
        """Widths (n,) caused by errors of bit weights, less what the local fit absorbs."""
        begins, order = code_cells(bits, law, len(self.gap))
        # A code that begins after a higher one is never reached.
        begins = np.minimum.accumulate(begins[::-1])[::-1]
        width = np.ones(len(begins))
        width[order[:-1]] = np.diff(begins)
        return self._after_fit(width[:-1] - 1)[self.number]

    def _after_fit(self, width: F64) -> F64:
        """Widths of codes 0, 1, ..., less one, relative to a local fit."""
        gap = self.gap[: len(width)]
        there = np.where(gap, 0.0, width)
        left = np.convolve(there, self.kernel, "same")
        return np.asarray(np.where(gap, left + width, left / self._raised(there)))

    def _raised(self, width: F64) -> F64:
        """Factor by which widths, less one, raise the expected counts of a local fit."""
        taken = width - np.convolve(width, self.kernel, "same")
        return np.asarray(np.maximum(1 + uniform_filter1d(taken, len(self.kernel)), 0.1))

    def without(self, bits: F64, law: Law = FITS) -> "CodeWidths":
        """Widths corrected for errors of bit weights (codes)."""
        return replace(self, width=self.width - self._left_out(bits, law))

    def ripple(self, scatter: float) -> Ripple:
        """The strongest line above noise and a scatter of the widths (variance)."""
        weight = ~self.gap[self.number] / (self.variance + max(scatter, 0.0))
        value = weight * self.width
        total, noise = float(weight.sum()), float(weight**2 @ self.variance)
        scattered = float(weight @ weight) * max(scatter, 0.0)

        def line(frequency: float) -> complex:
            turn = np.exp(-2j * np.pi * frequency * self.number)
            return complex(value @ turn) / self.kept(frequency)

        def power(frequency: float) -> float:
            return float(np.abs(line(frequency)) ** 2 / level(frequency))

        def level(frequency: float) -> float:
            """Mean power without a line: for displaced thresholds it rises with frequency."""
            return noise + scattered * 2 * float(np.sin(np.pi * frequency)) ** 2

        count = int(np.ptp(self.number)) + 1
        spread = np.zeros(4 << (count - 1).bit_length())
        spread[self.number - self.number[0]] = value
        spectrum = np.abs(np.fft.rfft(spread)) ** 2
        frequency = np.arange(len(spectrum)) / len(spread)
        # The local fit absorbs lower lines; those close to 0.5 cannot be separated from 0.5.
        seen = (frequency > LOWEST_RIPPLE) & (frequency < 0.5 - 2 / count)
        levels = noise + scattered * 2 * np.sin(np.pi * frequency[seen]) ** 2
        best = float(frequency[seen][np.argmax(spectrum[seen] / levels)])
        best = highest(power, best, 1 / len(spread))
        # At 0.5 (even and odd codes) there is only a cosine.
        ends = float(np.real(line(0.5)))
        top = float(np.log(2) + log_ndtr(-abs(ends) * self.kept(0.5) / np.sqrt(level(0.5))))
        free = np.log(2 * count) - power(best) * self.kept(best) ** 2
        if top < free:
            error = np.sqrt(level(0.5)) / total
            phase = 0.0 if ends > 0 else np.pi
            return Ripple(2.0, abs(ends) / total, float(error), phase, min(top + np.log(2), 0.0))
        amplitude = 2 * line(best) / total
        error = np.sqrt(2 * level(best)) / total / self.kept(best)
        chance = float(min(free + np.log(2), 0.0))
        return Ripple(1 / best, abs(amplitude), float(error), float(np.angle(amplitude)), chance)


def code_widths(
    counts: F64, noise: float, first: float = 0.0, last: float = np.inf
) -> CodeWidths | None:
    """Widths from the counts (n,) of a converter's codes; None if too few codes occur.

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
    # What a second fit still changes, beyond the effect of uneven codes, the first one missed.
    again = np.convolve(kernel, savgol_coeffs(length, _ORDER))
    share = 2 * float(again @ again) / float(kernel @ kernel)
    change = uniform_filter1d((expected - savgol_filter(expected, length, _ORDER)) ** 2, length)
    missed = np.maximum(change - share * uniform_filter1d((filled - expected) ** 2, length), 0)
    variance = expected + _MISSED**2 * missed + (_UNEVEN * expected) ** 2
    number = np.flatnonzero(used)
    gap = np.concatenate([gap, np.zeros(length, bool)])[: number[-1] + length]
    return CodeWidths(number, width, variance[used] / calm[used] ** 2, kernel, gap)


def _carried_over(counts: F64) -> Mask:
    """Empty codes just below a multiple of `CARRY`, where others occur, and the code before."""
    gap = np.zeros(len(counts), bool)
    around = uniform_filter1d(counts, 2 * _MAX_HALF + 1)
    for first in range(CARRY, len(counts), CARRY):
        below = counts[first - CARRY // 2 : first][::-1]
        empty = int(np.argmax(below > 0)) if below.any() else 0
        if empty and counts[first] > 0 and around[first] > POPULATED:
            gap[first - empty - 1 : first] = True
    return gap
