"""Readout noise common to all pixels of a row or a column.

Products of blocks of a row that are no neighbours, mode by mode of the Fourier transform across
the rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.kernels.processes import flicker, flicker_power
from pixcal.kernels.significance import root_with_error, sigmas_of_best
from pixcal.model.arrays import F32, F64, I64, Mask
from pixcal.model.bench import SimulatedDetector
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

FREEDOM = 3  # parameters of a pixel in the fit of the fringes
TURNS = 2.0  # least number of fringes along a row, so that they cancel in its mean
# lowest mode across the rows that is used in frames with light, whose pattern is smooth
FIRST_MODE = 3
_rms = partial(quantity, unit="e-", low=0, high=1e5)
BLOCKS, MIN_BLOCK = 16, 4  # most blocks per row, and least pixels per block
FEWEST_BLOCKS = 4
_LEAST_OWN = 1e-6  # least noise of a block's own, of its variance
FEWEST_LINES = 8
_ROUNDS = 4
GROUPS = range(2, 9)  # rows that may be read together
_NEEDED = 12.0  # fall in -2 log likelihood required of groups: once in 300 of these sizes by chance


@dataclass(frozen=True)
class RowNoise(Effect):
    """Noise of the reference or of the readout that all pixels of a row or a column share."""

    name = "row_noise"
    title = "row and column noise"
    acts_at = Stage.READOUT
    order = 2
    domains = ("noise", "time")
    strengths = tuple(
        f"{kind}_rms"
        for kind in ("row", "flicker", "interlace", "column", "alternate", "group", "odd_column")
    )
    left_because = "noise that is independent in each frame averages out"
    frames_needed = ("dark",)
    remedy = "in each frame, subtract the level of each line measured on dark or overscan pixels"
    sources = (
        "Rauscher 2015, PASP 127, 1144: infrared arrays of 5 e- read noise have 3 e- of correlated "
        "flicker noise, and 0.5 e- of noise of alternate columns",
        "EMVA 1288 release 4.0 (2021): row and column parts are measured separately from that of "
        "the pixels; assumed here: a tenth of a read noise of 16 e-",
    )

    row_rms: float = _rms(1.6, doc="white noise from row to row, rms")
    flicker_rms: float = _rms(0.5, doc="1/f noise from row to row, rms per octave of frequency")
    interlace_rms: float = _rms(
        0.5, doc="rms difference of even rows from the mean; odd rows have the opposite sign"
    )
    column_rms: float = _rms(0.8, doc="white noise from column to column, new in each frame, rms")
    alternate_rms: float = _rms(
        0.0,
        doc="noise from row to row, rms; half of its variance is shared with the row after next",
    )
    group_rms: float = _rms(0.0, doc="white noise that rows read together share, rms")
    group_rows: int = quantity(2, low=2, high=64)
    """rows read together, counted from the first of the window"""
    odd_column_rms: float = _rms(0.0, doc="as `interlace_rms`, of even and odd columns")

    def read_variance(self, detector: SimulatedDetector) -> float:
        white = [getattr(self, n) for n in self.strengths if n != "flicker_rms"]
        rows = detector.shape[0]
        power = flicker_power(rows)
        # All modes but the first and, of an even number, the last stand for two.
        of_flicker = (2 * power.sum() - (0 if rows % 2 else power[-1])) / rows
        return float(np.square(white).sum() + of_flicker * self.flicker_rms**2)

    def readout(self, adu: F32, shot: Shot) -> F32:
        rng = shot.recording.pixel_rng(self.name, shot.frame)
        rows, columns = self.offsets(shot.bench.detector.shape, rng)
        gain = shot.bench.detector.gain_e_per_adu
        of_rows = rows[slice(*shot.rows), None] / gain
        return adu + of_rows.astype(np.float32) + (columns / gain).astype(np.float32)

    def offsets(self, shape: tuple[int, int], rng: np.random.Generator) -> tuple[F64, F64]:
        """Offsets of one frame's rows (y,) and columns (x,), e-."""
        ny, nx = shape
        rows = self.row_rms * rng.standard_normal(ny)
        columns = self.column_rms * rng.standard_normal(nx)
        rows += self.interlace_rms * rng.standard_normal() * (1 - 2 * (np.arange(ny) % 2))
        # Last, so that the random numbers above do not depend on it.
        if self.flicker_rms:
            rows += self.flicker_rms * flicker(rng, ny)
        if self.alternate_rms:
            white = rng.standard_normal(ny + 2)
            rows += self.alternate_rms * np.sqrt(0.5) * (white[2:] + white[:-2])
        if self.group_rms:
            groups = rng.standard_normal(-(-ny // self.group_rows))
            rows += self.group_rms * np.repeat(groups, self.group_rows)[:ny]
        if self.odd_column_rms:
            columns += self.odd_column_rms * rng.standard_normal() * (1 - 2 * (np.arange(nx) % 2))
        return rows, columns

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Covariance of distant pixels of a row, by frequency across the rows; columns likewise."""
        dark = [
            ((s.adu - s.adu.mean(axis=0)) * np.float32(evidence.gain), evidence.good, 1)
            for s in evidence.stacks
            if s.kind in ("bias", "dark")
        ]
        fringes = [] if dark else list(evidence.fringes.values())
        rows = [line_spectrum(*frames) for frames in dark]
        columns = [line_spectrum(r.swapaxes(1, 2), good.T, n) for r, good, n in dark]
        rows += [_of_fringes(f, across=False) for f in fringes]
        columns += [_of_fringes(f, across=True) for f in fringes]
        size, error, sigmas = np.zeros(7), np.full(7, np.nan), []
        grouped: dict[str, Any] = {}
        if of_rows := [s for s in rows if s is not None]:
            noise, together = _fit_rows(of_rows)
            grouped = {"group_rows": together} if together else {}
            part = [0, 1, 2, 4, 5][: len(noise.size)]
            size[part], error[part] = noise.roots
            sigmas += [float(z) for z in noise.sigmas]
        if of_columns := [s for s in columns if s is not None]:
            noise = fit_lines(of_columns, [_row_shapes(s)[::2] for s in of_columns])
            size[[3, 6]], error[[3, 6]] = noise.roots
            sigmas += [float(z) for z in noise.sigmas]
        if not sigmas:
            return None
        return Estimate(
            replace(cls(), **dict(zip(cls.strengths, map(float, size), strict=True)) | grouped),
            {n: float(e) for n, e in zip(cls.strengths, error, strict=True) if np.isfinite(e)},
            sigmas_of_best(*sigmas),
            f"covariance of distant pixels of a row or column in "
            f"{'frames without light' if dark else 'the residuals of the fringes'}",
        )


def _row_shapes(spectrum: "LineSpectrum") -> F64:
    """Powers (m, n) of white noise, flicker, alternate rows, noise of every second row."""
    alternate = np.where(spectrum.modes == spectrum.lines // 2, spectrum.lines, 0.0)
    power = flicker_power(spectrum.lines)[spectrum.modes]
    turn = np.cos(4 * np.pi * spectrum.modes / spectrum.lines)
    shared = 1 + (1 - 2 / spectrum.lines) * turn
    return np.stack([np.ones(len(power)), power, alternate, shared])


def _fit_rows(spectra: Sequence["LineSpectrum"]) -> "tuple[LineVariances, int]":
    """Kinds of noise of rows, and how many are read together; 0, and no such kind, if none."""
    shapes = [_row_shapes(s) for s in spectra]
    fits = {0: fit_lines(spectra, shapes)}
    for rows in GROUPS:
        powers = [group_power(s, rows) for s in spectra]
        fit = fit_lines(spectra, list(map(np.vstack, zip(shapes, powers, strict=True))))
        if fit.size[-1] > 0 and fit.misfit < fits[0].misfit - _NEEDED:
            fits[rows] = fit
    best = min(fits, key=lambda rows: fits[rows].misfit)
    return fits[best], best


def group_power(spectrum: "LineSpectrum", rows: int) -> F64:
    """Power (n,) of white noise that groups of rows share."""
    turns = 2j * np.pi * spectrum.modes / spectrum.lines
    return np.asarray(np.abs(np.exp(turns * np.arange(rows)[:, None]).sum(axis=0)) ** 2 / rows)


def _of_fringes(fringes: FringeEvidence, across: bool) -> "LineSpectrum | None":
    """Spectrum of a set's residuals; None if its fringes run along the lines."""
    ny, nx = fringes.good.shape
    turns = (fringes.k[1] * ny if across else fringes.k[0] * nx) / (2 * np.pi)
    if abs(turns) < TURNS:
        return None
    if across:
        spectrum = line_spectrum(fringes.residual.swapaxes(1, 2), fringes.good.T, FREEDOM)
    else:
        spectrum = line_spectrum(fringes.residual, fringes.good, FREEDOM)
    if spectrum is None:
        return None
    # Infinite noise: no weight.
    dof = np.where(spectrum.modes < FIRST_MODE, 1e-9, spectrum.dof)
    return LineSpectrum(spectrum.lines, spectrum.power, dof, spectrum.noise, spectrum.pair_noise)


@dataclass(frozen=True)
class LineSpectrum:
    """Variance of common noise of rows, by mode across the rows."""

    lines: int  # number of transformed rows, even
    power: F64  # (n,) of modes 1 to `lines / 2`, e-²; without the noise of single pixels
    dof: F64  # (n,) degrees of freedom of each mode
    noise: float  # variance of a row's mean by the noise of its pixels, e-²
    pair_noise: float  # the same in products of distant blocks, e-²

    @property
    def modes(self) -> I64:
        """Numbers of the modes."""
        return np.arange(1, self.lines // 2 + 1)

    def variance(self, common: F64) -> F64:
        """Variance of ``power`` for common noise of power ``common`` (n,)."""
        square = (common + self.noise) ** 2 - self.noise**2 + self.pair_noise**2
        return np.asarray(2 * square / self.dof)


def line_spectrum(residual: F32, good: Mask, fitted: int = 1) -> LineSpectrum | None:
    """Spectrum of common noise of rows; None with too few rows or frames.

    ``residual``: (t, y, x), e-, without the constant part, NaN without a sample. ``fitted``: number
    of parameters per pixel that were fitted to the frames.
    """
    frames, lines, width = residual.shape
    lines -= lines % 2
    size = max(MIN_BLOCK, -(-width // BLOCKS))
    blocks = width // size
    if frames <= fitted or lines < FEWEST_LINES or blocks < FEWEST_BLOCKS:
        return None
    begin = np.arange(blocks) * size
    used = good[:lines] & np.isfinite(residual[:, :lines]).all(axis=0)
    count = np.add.reduceat(used, begin, axis=1, dtype=float)
    total = np.add.reduceat(np.where(used, residual[:, :lines], 0), begin, axis=2, dtype=float)
    modes = np.fft.rfft(total / np.maximum(count, 1), axis=1, norm="ortho")[:, 1:]
    modes = np.ascontiguousarray(modes.transpose(1, 0, 2))
    products = (modes.conj().transpose(0, 2, 1) @ modes).real / (frames - fitted)
    # A block without any good pixel is zero.
    there = np.count_nonzero(count, axis=0) / lines
    at = np.arange(blocks)
    apart = (np.abs(at[:, None] - at) > 1) * np.outer(there, there)
    pairs = float(apart.sum())
    if not pairs:
        return None
    power = np.einsum("nij,ij->n", products, apart > 0) / pairs
    dof = np.full(len(power), 2.0 * (frames - fitted))
    dof[-1] /= 2
    whole = np.einsum("nii->i", products) / len(power)
    if not whole.any():
        return None
    # Beside large common noise, that of the blocks is not known to be zero.
    excess = np.maximum(whole - power.mean(), _LEAST_OWN * whole)
    return LineSpectrum(
        lines=lines,
        power=power,
        dof=dof,
        noise=float(excess.sum()) / blocks**2,
        pair_noise=float(np.sqrt(excess @ (apart > 0) @ excess)) / pairs,
    )


@dataclass(frozen=True)
class LineVariances:
    """Variances of several kinds of noise of rows."""

    size: F64  # (m,) e-²; unbiased, so it may be negative
    covariance: F64  # (m, m)
    sigmas: F64  # (m,) significance of each if it is the only one
    misfit: float  # -2 log likelihood, but for a constant

    @property
    def roots(self) -> tuple[F64, F64]:
        """Standard deviations, and their errors."""
        return root_with_error(self.size, np.sqrt(np.diag(self.covariance)))


def fit_lines(spectra: Sequence[LineSpectrum], shapes: Sequence[F64]) -> LineVariances:
    """Least-squares sizes of kinds of noise; ``shapes`` (m, n): their unit powers by spectrum."""
    power = np.concatenate([s.power for s in spectra])
    shape = np.concatenate(list(shapes), axis=1)
    ends = np.cumsum([len(s.power) for s in spectra])[:-1]

    def variance(size: F64) -> F64:
        common = np.split(np.maximum(size, 0) @ shape, ends)
        return np.concatenate([s.variance(c) for s, c in zip(spectra, common, strict=True)])

    size = np.zeros(len(shape))
    for _ in range(_ROUNDS):
        weighted = shape / variance(size)
        covariance = np.linalg.pinv(weighted @ shape.T, hermitian=True)
        size = covariance @ (weighted @ power)
    chance, dof = variance(np.zeros(len(shape))), np.concatenate([s.dof for s in spectra])
    sigmas = [_alone(power, own, chance, dof) for own in shape]
    spread = variance(size)
    misfit = float(((power - size @ shape) ** 2 / spread + np.log(spread)).sum())
    return LineVariances(size, covariance, np.array(sigmas), misfit)


def _alone(power: F64, shape: F64, variance: F64, dof: F64) -> float:
    """Significance (standard deviations) of one shape, allowing for the skewness of its sum."""
    weight = shape / variance
    z = float(weight @ power / np.sqrt(weight @ shape))
    skew = float(np.sum((weight * np.sqrt(variance)) ** 3 * np.sqrt(8 / dof)))
    total = 8 / (skew / float(weight @ shape) ** 1.5) ** 2
    # A chi-square of equal skewness, by the cube root of Wilson and Hilferty (1931).
    ratio = max(1 + z * np.sqrt(2 / total), 0.0)
    return float((np.cbrt(ratio) - 1 + 2 / (9 * total)) / np.sqrt(2 / (9 * total)))
