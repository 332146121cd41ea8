"""The converter: steps coarser than those of the file, and codes of unequal width."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from pixcal.estimators.detector.bit_weights import Law, code_cells
from pixcal.estimators.detector.code_density import MIN_NOISE, CodeWidths, code_widths
from pixcal.estimators.detector.code_histogram import converter_counts, histogram, step_of
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.variance_components import sigmas
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_best, sigmas_of_chi2
from pixcal.kernels.synthesis import Stream, generator
from pixcal.model.arrays import F32, F64, Indices
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

# largest displacement of a threshold, so that only neighbouring codes need checks
FARTHEST = 0.98
FEW_MISSING = 1.1  # largest step for which wrong bits may explain the missing codes
_KEY = 997
_CELLS = 16  # cells of the lookup table per step; a power of two, to be exact
_LAW = "wrong weights of bits, scatter and a ripple of the widths"
_OTHER_GAIN = (
    "only codes of bright samples are uneven, as in a camera that reads bright pixels at another "
    "gain (dual gain, HDR)"
)


@dataclass(frozen=True)
class Quantisation(Effect):
    """A converter with coarse steps, or with codes of uneven width."""

    name = "quantisation"
    title = "coarse or uneven ADC steps"
    acts_at = Stage.CONVERTER
    order = 2
    domains = ("noise", "intensity")
    strengths = ("coarse_adu", "dnl_rms", "ripple", "bits", "widths")
    left_because = "rounding adds noise of a few hundredths of the Cramér-Rao bound"
    frames_needed = ("ladder",)
    remedy = (
        "no action if the noise exceeds one code step, as it averages uneven codes; otherwise "
        "raise the analogue gain"
    )
    sources = (
        "IEEE Std 1241-2010: code widths from histograms; round-off of step/sqrt(12) rms",
        "Widrow and Kollar 2008, Quantization Noise, Cambridge University Press: when round-off is "
        "noise that does not depend on the signal",
        "cameras of 14 bits that write 16 shift their codes by 2: steps of 4 ADU; differential "
        "nonlinearity of 0.3 to 0.5 codes is typical of data sheets",
    )

    coarse_adu: float = quantity(3.0, unit="ADU", low=0, high=4095)
    """step of the converter minus 1 ADU"""
    dnl_rms: float = quantity(0.3, unit="codes", low=0, high=1)
    """scatter of the code widths (differential nonlinearity)"""
    ripple: float = quantity(0.1, unit="codes", low=0, high=0.9)
    """amplitude of a periodic variation of the code widths"""
    ripple_codes: float = quantity(2.0, unit="codes", low=2, high=16)
    """period of that variation; 2: even and odd codes"""
    ripple_phase_rad: float = quantity(0.0, unit="rad", low=-7, high=7)
    """phase of that variation at code zero"""
    bits: tuple[float, ...] = quantity((), unit="codes", low=-1000, high=1000)
    """error of the weight of each bit, lowest bit first"""
    below: float = quantity(0.0, low=0, high=1)
    """how a bit is decided; 0: it is kept if its level does not exceed the signal; 0.5: the nearest
    level is chosen"""
    any_code: bool = quantity(False)
    """whether any code may be chosen where wrong bits make levels overlap; otherwise only a
    neighbouring code"""
    widths: tuple[float, ...] = quantity((), unit="codes", low=-1, high=100)
    """width of each code minus 1 code, from code 0 on, beside wrong bits; the scatter and ripple
    then only describe them"""

    def __hash__(self) -> int:
        """Fast hash without the individual widths, as it is needed in each frame."""
        return hash((self.coarse_adu, self.dnl_rms, self.ripple, self.bits, len(self.widths)))

    @property
    def step_adu(self) -> float:
        """Mean width of a code."""
        return 1 + self.coarse_adu

    @property
    def law(self) -> Law:
        """Law of the thresholds of codes, given the levels of their bits."""
        return Law(self.below, self.any_code)

    def thresholds(self, specimen: int, codes: int) -> F64:
        """Thresholds of codes, in steps, in the order of `code_cells`; code n near ``n - 1/2``."""
        number = np.arange(codes)
        shift = np.zeros(codes)
        measured = np.array(self.widths)
        if self.dnl_rms and not len(measured):
            rng = generator(specimen, Stream.EFFECT, _KEY)
            shift += self.dnl_rms / np.sqrt(2) * rng.standard_normal(codes)
        if self.ripple and not len(measured):
            turn = 2 * np.pi / self.ripple_codes
            # Sum of the ripple over all codes below.
            phase = turn * (number - 0.5) + self.ripple_phase_rad
            shift += self.ripple * np.sin(phase) / (2 * np.sin(turn / 2))
        begins, order = code_cells(np.array(self.bits), self.law, codes)
        begins += np.clip(shift, -FARTHEST, FARTHEST)[order]
        wider = np.zeros(codes)
        wider[: len(measured)] = measured[:codes]
        # A code that is wider moves those above it.
        begins[1:] += np.cumsum(wider[order])[:-1]
        return np.asarray(begins)

    def converted(self, adu: F32, specimen: int, top_adu: float, normals: F32 | None = None) -> F32:
        """Codes in ADU: the number of thresholds that each sample reaches.

        Swapped thresholds leave a code out, as in a flash converter that counts. ``specimen``: seed
        of the detector. ``normals``: scatter the samples within the float32 grid, which for large
        samples is as coarse as threshold displacements.
        """
        codes = int(top_adu / self.step_adu) + 3
        if any(self.bits) or any(self.widths):
            edges, order, lowest = _reached(self, specimen, codes)
            reached = adu / np.float32(self.step_adu)
            code = lowest[np.clip(reached * _CELLS, 0, len(lowest) - 1).astype(np.int32)]
            while (passed := reached >= edges[code + 1]).any():
                code += passed
            return np.asarray(order[code] * self.step_adu, np.float32)
        begins = _thresholds(self, specimen, codes)
        level = np.clip(adu / np.float32(self.step_adu), 0, np.float32(codes - 2))
        nearest = (level + np.float32(0.5)).astype(np.int32)
        # A small number, for which the float32 grid is negligible.
        over = level - nearest.astype(np.float32)
        if normals is not None:
            over += np.spacing(level) * np.float32(0.5) * normals
        passed = nearest - 1 + (over >= begins[nearest])
        passed += over >= begins[nearest + 1] + np.float32(1)
        return np.asarray(np.maximum(passed, 0) * np.float32(self.step_adu), np.float32)

    def readout(self, adu: F32, shot: Shot) -> F32:
        detector = shot.bench.detector
        uneven = self.dnl_rms > 0 or self.ripple > 0
        normals = shot.normals(self.name) if uneven else None
        return self.converted(adu, detector.seed, detector.top_adu, normals)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Step from the codes that never occur, widths from the counts of the others.

        None where samples are no whole numbers, or too few.
        """
        fit = _by_law(evidence, far=True)
        if fit is None:
            return None
        by_law, significance = cls(**fit.values), sigmas_of_best(*fit.sigmas)
        effect, widths = by_law, fit.widths
        if widths is not None and significance > SIGNIFICANT:
            rest = widths.without(np.array(by_law.bits), by_law.law) if by_law.bits else widths
            effect = replace(by_law, widths=tuple(map(float, rest.measured)))
        errors = fit.errors
        return Estimate(
            effect,
            errors,
            significance,
            "missing codes, and code counts compared with neighbouring codes",
            (*fit.together, *({n: e} for n, e in errors.items() if n[:4] != "bits")),
            law="" if effect == by_law else _LAW,
            by_law=None if effect == by_law else by_law,
            refused=_OTHER_GAIN if widths is not None and widths.uneven_above else "",
        )

    @classmethod
    def detect(cls, evidence: Evidence) -> float | None:
        fit = _by_law(evidence)
        return None if fit is None else sigmas_of_best(*fit.sigmas)


@dataclass(frozen=True)
class _ByLaw:
    """A converter by its step, wrong bits, scatter and ripple."""

    values: dict[str, Any]
    errors: dict[str, float]
    sigmas: list[float]  # significance of each
    together: tuple[dict[str, float], ...]  # steps of the bits, of one sigma each
    widths: CodeWidths | None


def _by_law(evidence: Evidence, far: bool = False) -> _ByLaw | None:
    """Converter from the counts of its codes; None if samples are not codes, or too few."""
    lit = [f.adu for f in evidence.fringes.values()]
    counts = histogram([*(s.adu for s in evidence.stacks), *lit], evidence.good)
    if counts is None or not counts.any():
        return None
    step, step_error = step_of(counts)
    step = max(step, float(evidence.step_adu))
    noise, first = evidence.read_noise / evidence.gain / step, 0.0
    if evidence.lowest_adu is not None:
        first = evidence.lowest_adu / step + 1
    lit = lit or [s.adu for s in evidence.of_kind("flat")]
    if noise < MIN_NOISE and lit:
        counts = histogram(lit, evidence.good)
        shot = MIN_NOISE**2 - noise**2
        first = float(np.median(evidence.bias)) / step + shot * step * evidence.gain
        noise = MIN_NOISE
    widths = None
    if counts is not None:
        top = evidence.saturation_adu
        if 1 < step < FEW_MISSING:
            measured = code_widths(counts, noise, first, top)
            # Wrong bits leave codes out too.
            if measured is not None and "bits" in _uneven(measured)[0]:
                step = 1.0
        widths = code_widths(converter_counts(counts, step), noise, first, top / step)
    if widths is None and step == evidence.step_adu:
        return None
    # A camera that shifts its codes by whole bits is not an anomaly.
    sigmas = [-1.0 if step == evidence.step_adu else min((step - 1) / step_error, 1e6)]
    values: dict[str, Any] = {"coarse_adu": step - 1, "dnl_rms": 0.0, "ripple": 0.0}
    errors = {"coarse_adu": step_error}
    if widths is None:
        return _ByLaw(values, errors, sigmas, (), None)
    known, its_errors, chances, together = _uneven(widths, far)
    return _ByLaw(values | known, errors | its_errors, sigmas + chances, together, widths)


@lru_cache(maxsize=4)
def _thresholds(effect: Quantisation, specimen: int, codes: int) -> F32:
    """Threshold of each code minus its number."""
    return (effect.thresholds(specimen, codes) - np.arange(codes)).astype(np.float32)


@lru_cache(maxsize=4)
def _reached(effect: Quantisation, specimen: int, codes: int) -> tuple[F64, Indices, Indices]:
    """Lowest sample of each occurring code, these codes in order, and the first per cell."""
    begins = effect.thresholds(specimen, codes)
    order = code_cells(np.array(effect.bits), effect.law, codes)[1]
    begins = np.minimum.accumulate(begins[::-1])[::-1]
    lowest = np.searchsorted(begins, np.arange(codes * _CELLS) / _CELLS, "right") - 1
    return np.append(begins, np.inf), order, np.maximum(lowest, 0)


def _uneven(
    widths: CodeWidths, far: bool = False
) -> tuple[dict[str, Any], dict[str, float], list[float], tuple[dict[str, float], ...]]:
    """Wrong bits, scatter and ripple, their errors, significance; ``far``: levels may overlap."""
    variance, error, scatter_sigmas = widths.scatter()
    line = widths.ripple(variance)
    sure = sigmas(line.log_chance)
    values: dict[str, Any] = {"ripple": 0.0}
    errors = {"ripple": line.amplitude_error}
    # With displaced thresholds, neighbouring widths may have twice the variance.
    bit_fit = widths.wrong_bits(2 * variance)
    wrong = sigmas_of_chi2(bit_fit.chi2, max(int((np.diag(bit_fit.covariance) > 0).sum()), 1))
    share = 1.0 if line.period == 2 else 0.5
    rest = widths.without(bit_fit.bits, bit_fit.law).scatter()[0]
    # Bits are periodic too: the lowest ones resemble a ripple of two or four codes.
    clearer = 2 * rest < variance - share * line.amplitude**2
    bits: F64 | None = None
    if wrong > SIGNIFICANT and (wrong > sure or clearer):
        start = None
        if far and (other := widths.far_bits(bit_fit.law)):
            bit_fit, start = other, other.bits
            rest = widths.without(bit_fit.bits, bit_fit.law).scatter()[0]
        bit_fit = widths.bits(2 * rest, bit_fit.law, start)
        bits, covariance = bit_fit.bits, bit_fit.covariance
        levelled = widths.level(np.eye(len(bits)))
    # No bit deviates by more than its own weight, although a fit to few codes may say so.
    if bits is not None and (np.abs(levelled @ bits) <= 2.0 ** np.arange(len(bits))).all():
        values, errors, others, _ = _uneven(widths.without(bits, bit_fit.law))
        covariance = levelled @ covariance @ levelled.T
        values |= {"bits": tuple(map(float, levelled @ bits)), **bit_fit.law._asdict()}
        spread = np.sqrt(np.diag(covariance))
        errors |= {f"bits[{n}]": float(e) for n, e in enumerate(spread) if e}
        size, ways = np.linalg.eigh(covariance)
        steps = (ways * np.sqrt(np.maximum(size, 0))).T
        together = tuple({f"bits[{n}]": float(s) for n, s in enumerate(one) if s} for one in steps)
        return values, errors, [wrong, *others], together
    if sure > SIGNIFICANT:
        for _ in range(2):
            rest = variance - share * line.amplitude**2
            line = widths.ripple(rest)
        variance = variance - share * line.amplitude**2
        error = float(np.hypot(error, 2 * share * line.amplitude * line.amplitude_error))
        values = {
            "ripple": min(line.amplitude, 0.9),
            "ripple_codes": min(line.period, 16.0),
            "ripple_phase_rad": line.phase,
        }
        errors = {"ripple": line.amplitude_error}
    top = max(variance, 0.0)
    values["dnl_rms"] = min(float(np.sqrt(top)), 1.0)
    errors["dnl_rms"] = float(np.sqrt(top + error) - np.sqrt(top))
    return values, errors, [scatter_sigmas, sure], ()
