"""Noise of the electronics that all pixels of a row, or of a column, have in common in a frame."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.frame_series.line_noise import (
    FEWEST_FRAMES,
    LineSpectrum,
    fit_lines,
    line_spectrum,
)
from pixcal.kernels.processes import flicker, flicker_power
from pixcal.kernels.significance import sigmas_of_best
from pixcal.model.arrays import F32, F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

FREEDOM = 3  # parameters of a pixel in the fit of the fringes
TURNS = 2.0  # fringes along a row from which its mean tells nothing of them
# lowest mode across the rows that counts in frames with light, whose pattern is smooth
FIRST_MODE = 3
_rms = partial(quantity, unit="e-", low=0, high=1e5)


@dataclass(frozen=True)
class RowNoise(Effect):
    """Noise of the reference or of the readout that all pixels of a row or a column share.

    White and flicker noise from row to row; rows that two amplifiers read in turn, whose levels
    part and meet from frame to frame, or each of which keeps half of the noise of the row that it
    read before; and columns, white from column to column and frame to frame.
    What the whole frame has in common is `bias_drift`: flicker noise is given without its mean.
    Nothing of it is constant in time, so maps do not tell of it; and frames of fringes do not hold
    the rows' offsets well enough to take them off (shot noise is larger), only bars of dark pixels
    would.
    """

    name = "row_noise"
    title = "noise common to the pixels of a row or a column"
    acts_at = Stage.READOUT
    order = 2
    domains = ("noise", "time")
    strengths = ("row_rms", "flicker_rms", "interlace_rms", "column_rms", "alternate_rms")
    left_because = "noise that is independent in each frame averages out"
    frames_needed = ("dark",)
    remedy = "subtract the level of each line in each frame, from dark or overscan pixels"
    sources = (
        "Rauscher 2015, PASP 127, 1144: infrared arrays of 5 e- read noise have 3 e- of correlated "
        "flicker noise, and 0.5 e- of noise of alternate columns",
        "EMVA 1288 release 4.0 (2021): row and column parts are measured apart from the pixels'; "
        "taken here as a tenth of a read noise of 16 e-",
    )

    row_rms: float = _rms(1.6, doc="white noise from row to row, rms")
    flicker_rms: float = _rms(0.5, doc="1/f noise from row to row, rms per octave of frequency")
    interlace_rms: float = _rms(
        0.5, doc="rms difference of even rows from the mean; odd rows have the opposite sign"
    )
    column_rms: float = _rms(0.8, doc="white noise from column to column, new in each frame, rms")
    alternate_rms: float = _rms(
        0.0,
        doc="noise from row to row, rms; half of its variance is shared with the second next row",
    )

    def readout(self, adu: F32, shot: Shot) -> F32:
        rng = shot.recording.pixel_rng(self.name, shot.frame)
        rows, columns = self.offsets(shot.bench.detector.shape, rng)
        gain = shot.bench.detector.gain_e_per_adu
        own = rows[slice(*shot.rows), None] / gain
        return adu + own.astype(np.float32) + (columns / gain).astype(np.float32)

    def offsets(self, shape: tuple[int, int], rng: np.random.Generator) -> tuple[F64, F64]:
        """Offsets of one frame's rows (y,) and columns (x,), e-."""
        ny, nx = shape
        rows = self.row_rms * rng.standard_normal(ny)
        columns = self.column_rms * rng.standard_normal(nx)
        rows += self.interlace_rms * rng.standard_normal() * (1 - 2 * (np.arange(ny) % 2))
        # Last, so that without it the others are what they are with it.
        if self.flicker_rms:
            rows += self.flicker_rms * flicker(rng, ny)
        if self.alternate_rms:
            white = rng.standard_normal(ny + 2)
            rows += self.alternate_rms * np.sqrt(0.5) * (white[2:] + white[:-2])
        return rows, columns

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Covariance of distant pixels of a row, by frequency across the rows; columns likewise.

        From frames without light where there are any. Else from the residuals of those fringes
        that run across the rows (columns), which is much worse.
        """
        dark = [
            ((s.adu - s.adu.mean(axis=0)) * np.float32(evidence.gain), evidence.good, 1)
            for s in evidence.stacks
            if s.kind in ("bias", "dark") and len(s.adu) >= FEWEST_FRAMES
        ]
        fringes = [] if dark else list(evidence.fringes.values())
        rows = [line_spectrum(*frames) for frames in dark]
        columns = [line_spectrum(_turned(r), good.T, n) for r, good, n in dark]
        rows += [_of_fringes(f, across=False) for f in fringes]
        columns += [_of_fringes(f, across=True) for f in fringes]
        found, size, error, sigmas = [], np.zeros(5), np.full(5, np.nan), []
        for part, spectra, own in (([0, 1, 2, 4], rows, _row_shapes), ([3], columns, _flat)):
            there = [s for s in spectra if s is not None]
            if there:
                noise = fit_lines(there, [own(s) for s in there])
                size[part], error[part] = noise.roots
                sigmas += [float(z) for z in noise.sigmas]
                found.append(noise)
        if not found:
            return None
        return Estimate(
            cls(*map(float, size)),
            {n: float(e) for n, e in zip(cls.strengths, error, strict=True) if np.isfinite(e)},
            sigmas_of_best(*sigmas),
            f"covariance of distant pixels of a row or column in "
            f"{'frames without light' if dark else 'the residuals of the fringes'}",
            {"variances_e2": [float(v) for noise in found for v in noise.size], "sigmas": sigmas},
        )


def _turned(residual: F32) -> F32:
    return residual.transpose(0, 2, 1)


def _row_shapes(spectrum: LineSpectrum) -> F64:
    """White noise, flicker, alternate rows, and what every second row shares (m, n)."""
    alternate = np.where(spectrum.modes == spectrum.lines // 2, spectrum.lines, 0.0)
    power = flicker_power(spectrum.lines)[spectrum.modes]
    turn = np.cos(4 * np.pi * spectrum.modes / spectrum.lines)
    shared = 1 + (1 - 2 / spectrum.lines) * turn
    return np.stack([np.ones(len(power)), power, alternate, shared])


def _flat(spectrum: LineSpectrum) -> F64:
    return np.ones((1, len(spectrum.power)))


def _of_fringes(found: FringeEvidence, across: bool) -> LineSpectrum | None:
    """Spectrum of a set's residuals; None where its fringes run along the lines."""
    ny, nx = found.good.shape
    turns = (found.k[1] * ny if across else found.k[0] * nx) / (2 * np.pi)
    if abs(turns) < TURNS:
        return None
    if across:
        spectrum = line_spectrum(_turned(found.residual), found.good.T, FREEDOM)
    else:
        spectrum = line_spectrum(found.residual, found.good, FREEDOM)
    if spectrum is None:
        return None
    # Infinite noise: no weight.
    dof = np.where(spectrum.modes < FIRST_MODE, 1e-9, spectrum.dof)
    return LineSpectrum(spectrum.lines, spectrum.power, dof, spectrum.noise, spectrum.pair_noise)
