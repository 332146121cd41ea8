"""Series of single pixels in which telegraph noise is sought."""

from dataclasses import replace

import numpy as np

from pixcal.estimators.detector.telegraph.dwell import PixelSeries
from pixcal.estimators.detector.telegraph.find import significance
from pixcal.estimators.detector.telegraph.moments import Series
from pixcal.estimators.diagnosis.distortions import Freedom
from pixcal.estimators.diagnosis.evidence import DITHER, Evidence, FringeEvidence, Stack
from pixcal.model.arrays import F64, Indices, Mask

_MIN_FRAMES = 10
_ENOUGH = 20
_HOT = 4.0
_WIDE = 16
HARMONICS = 5  # of the phase, removed from fringe residuals before they count as noise
LIT_HARMONICS = 1  # the same for pixels that are known to jump


def pixel_series_of(evidence: Evidence) -> tuple[Series, ...]:
    """Series of frames without light or, if they show more, of fringe frames."""
    dark = [s for s in evidence.stacks if s.kind != "flat" and len(s.adu) >= _MIN_FRAMES]
    unlit = tuple(s for stack in dark if (s := _of_stack(stack, evidence)) is not None)
    if sum(len(s.adu) for s in dark) >= _ENOUGH or not evidence.fringes:
        return unlit
    # A few frames without light show small jumps, hundreds of fringes large and rare ones.
    fringes = evidence.fringes.values()
    lit = tuple(_of_fringes(f, evidence) for f in fringes if len(f.g) >= _ENOUGH)
    return max(lit, unlit, key=lambda series: significance(series) or -np.inf)


def _of_stack(stack: Stack, evidence: Evidence) -> Series | None:
    """Bias or dark frames without common noise of rows and without hot pixels."""
    seconds = float(np.nan_to_num(stack.exptime_s))
    dark = evidence.dark_charge_rate * seconds
    pixels = (dark < _HOT * evidence.read_noise**2) & (stack.adu < evidence.saturation_adu).all(0)
    # Medians of samples within a few converter steps are steps too, and hide common row noise.
    rest = (stack.adu - stack.adu.mean(axis=0)).astype(float)
    wide = rest.shape[2] >= _WIDE
    rest -= np.median(rest, axis=2 if wide else (1, 2), keepdims=True)
    rest = rest[:, pixels] * evidence.gain
    if rest.shape[1] < _ENOUGH:
        return None
    spread = float(np.sqrt(np.median(rest.var(axis=0, ddof=1))))
    if spread**2 < (DITHER**2 + 1 / 12) * (evidence.gain * evidence.step_adu) ** 2:
        # The distribution of noise far below a converter step depends on the steps.
        return None
    return Series(
        rest / spread,
        stack.frame,
        np.flatnonzero(pixels),
        spread,
        max(_period(stack.time_s), seconds),
    )


def lit_series(evidence: Evidence, pixels: Indices) -> list[PixelSeries]:
    """Residual charge of given pixels in every fringe set."""
    chosen = np.zeros(evidence.good.size, bool)
    chosen[pixels] = True
    series = []
    for fringes in evidence.fringes.values():
        freedom, left = _left_over(fringes, chosen.reshape(evidence.good.shape), LIT_HARMONICS)
        period = _period(fringes.time_s) if len(fringes.time_s) > 1 else 0.0
        used, fitted = np.flatnonzero(freedom.good), freedom.of_time.T.astype(float)
        weight = freedom.weight.astype(float)
        series.append(PixelSeries(np.nan_to_num(left), weight, fringes.frame, period, used, fitted))
    return series


def _of_fringes(fringes: FringeEvidence, evidence: Evidence) -> Series:
    # Include pixels that the fit excluded for their noise, as these may be telegraph noise.
    freedom, left = _left_over(fringes, evidence.good, HARMONICS)
    sigma = float(freedom.weight[freedom.weight > 0].mean() ** -0.5)
    used, noise = np.flatnonzero(freedom.good), left * np.sqrt(freedom.weight)
    return Series(noise, fringes.frame, used, sigma, _period(fringes.time_s))


def _left_over(fringes: FringeEvidence, pixels: Mask, harmonics: int) -> tuple[Freedom, F64]:
    """Residual charge (t, n) of pixels that have maps, e-; NaN where there is none."""
    good = pixels & np.isfinite(fringes.theta).all(axis=0)
    freedom = Freedom(replace(fringes, good=good), harmonics)
    left = freedom.left_over(freedom.of_good(fringes.residual))
    return freedom, np.where(freedom.weight > 0, left, np.nan).astype(float)


def _period(time_s: F64) -> float:
    return float(np.median(np.diff(time_s)))
