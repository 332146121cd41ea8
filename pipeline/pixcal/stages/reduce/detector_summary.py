"""The detector as a whole: read noise, gain and linearity, from the statistics of all columns."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixcal.estimators.detector.calibration import Linearity, linearity
from pixcal.estimators.detector.emva import Measure, full_level, saturation, transfer_points
from pixcal.kernels.photon_transfer import BLOCK, LADDER, LAGS, GainFit, add_neighbours, fit_gain
from pixcal.kernels.robust import median_and_sigma
from pixcal.kernels.rounding import SHEPPARD, UNTOLD, noise_before_rounding
from pixcal.model.acquisition import Detector
from pixcal.model.arrays import F64, Mask
from pixcal.model.errors import InputError
from pixcal.stages.reduce.calibration import Usual, on_grid, usual
from pixcal.stages.reduce.columns import grid
from pixcal.stages.reduce.frame_statistics import Measuring
from pixcal.storage.cube import ArrayReader
from pixcal.storage.place import Place

ROUNDING_ADU = math.sqrt(SHEPPARD)
"""Noise of a converter that rounds to whole ADU."""

_LINEAR_SHARE = 0.7
_SATURATED_RUNG = 1e-2
_GAIN_ERROR = 0.2
_GUESS_ERROR = 0.1
_SMOOTH = 0.25 + SHEPPARD
"""Variance of a sample, in square codes, from which rounding adds the same at every level."""
_NO_LINE = 10.0
"""Reduced chi-square of a photon-transfer curve that is no line."""
_LINEARITY = 0.02
_LAMP = 0.3
"""Relative change of light a second between flats that are not of one lamp."""
_SHARED = 5.0
"""Errors of the noise that a row shares from which it is there."""
_LIT = 5.0
"""Least response of the usual pixel over its error: below it the flat would be noise."""


@dataclass(frozen=True)
class Summary:
    """What the calibration frames say of the detector as a whole; None where they do not."""

    declared: Detector  # what its owner says
    step: float  # of the converter (ADU)
    usual: Usual  # medians of the maps
    light: F64  # of each tile in the flats, over that of the detector
    # of a sample, rounding included, from differences of successive frames; its error (ADU)
    read_noise: tuple[float, float] | None
    before_rounding: tuple[float, float] | None  # the same without the rounding of the converter
    gain: GainFit | None  # by photon transfer
    levels: F64  # (rung,) of the ladder of flats (ADU above bias and dark)
    # usable, full: (rung,) rungs without saturation; those with full pixels though the
    # converter does not saturate
    usable: Mask
    full: Mask
    linearity: Linearity | None  # of the usable rungs

    def gain_to_use(self, choice: str) -> float:
        """Gain (e-/ADU), ``declared`` or ``measured``.

        Raises
        ------
        InputError
            If it is to be the measured one and there is none.
        """
        if choice == "declared":
            return self.declared.gain_e_per_adu
        if self.gain is None:
            raise InputError(
                "gain: 'measured', but the flats show no photon noise above the read noise, or "
                "there are neither bias nor dark frames; use gain: declared"
            )
        return self.gain.gain

    def read_noise_e(self, gain: float) -> float:
        """Read noise (e-): measured, else declared; never below the converter's rounding."""
        noise = self.declared.read_noise_e
        if self.read_noise is not None:
            noise = gain * self.read_noise[0]
        return max(noise, gain * ROUNDING_ADU * self.step)

    def noise_before_rounding_e(self, gain: float) -> float:
        """Read noise (e-) of the amplifier: measured, else declared.

        Where samples of one code alone say that it is far below a step, no more than that.
        """
        if self.before_rounding is not None:
            return gain * self.before_rounding[0]
        if self.read_noise is None:
            return self.declared.read_noise_e
        return min(self.declared.read_noise_e, gain * UNTOLD * self.step)

    def warnings(self, gain: float, saturation: float | None) -> list[str]:
        """Sentences on what is not as it should be, or was declared otherwise than measured.

        Parameters
        ----------
        gain : float
            That is used (e-/ADU).
        saturation : float or None
            Where flats were found to saturate (ADU), if it was not declared.
        """
        found = []
        if saturation is not None:
            found.append(
                f"flats saturate at {saturation:.0f} ADU, where their samples pile up: "
                f"{(~self.usable).sum()} of {len(self.usable)} levels are left out of gain and "
                "linearity; declare detector.saturation_adu if it is another level"
            )
        if self.gain is not None and self.gain.chi2_reduced > _NO_LINE:
            found.append(
                "the photon-transfer curve is no straight line (reduced chi-square "
                f"{self.gain.chi2_reduced:.3g}): do not rely on the gain measured; causes are a "
                "nonlinear response, amplifiers of different gain, a lamp that flickers, or charge "
                "shared by neighbours"
            )
        if self.gain is not None and self.gain.neighbours:
            lags = ", ".join(f"({y}, {x})" for y, x in self.gain.neighbours)
            found.append(
                "neighbours share charge: their noise is correlated in the flats at (rows, "
                f"columns) {lags}; the gain counts what they share"
            )
        if self.gain is not None and self.gain.curved:
            found.append(
                "the photon-transfer curve bends: variance over level changes by "
                f"{100 * self.gain.curved:+.2g} % up to {self.gain.levels[1]:.0f} ADU; the gain is "
                "that at level zero; causes are a nonlinear response, or charge that neighbours "
                "share the more the brighter they are"
            )
        if self.linearity is not None and self.linearity.max_deviation > _LINEARITY:
            found.append(
                f"the levels of the flats are up to {100 * self.linearity.max_deviation:.2g} % off "
                "a straight line over exposure time: the response of all pixels, or the lamp, is "
                "not linear; no pixel is flagged for it"
            )
        declared = self.declared.gain_e_per_adu
        if self.gain is not None:
            value, error = self.gain.gain, self.gain.error
            if abs(value - declared) > max(3 * error, 0.02 * declared):
                found.append(
                    f"photon transfer gives a gain of {value:.4g} ± {error:.2g} e-/ADU, not the "
                    f"{declared:g} of detector.gain_e_per_adu: "
                    + (
                        "correct it, or use '--gain measured'; all electrons are counted with it"
                        if gain == declared
                        else "electrons are counted with the measured one"
                    )
                )
        noise = self.declared.read_noise_e
        if self.before_rounding is not None:
            value, error = (gain * v for v in self.before_rounding)
            if abs(value - noise) > max(3 * error, 0.1 * noise):
                found.append(
                    f"the read noise is {value:.4g} ± {error:.2g} e-, not the {noise:g} of "
                    "detector.read_noise_e: the measured one is used"
                )
        return found


def summarise(job: Measuring, folder: Place, declared: Detector) -> Summary:
    """Put the statistics of all columns together.

    Parameters
    ----------
    job : Measuring
        What they were measured with.
    folder : Place
        Where they are.
    declared : Detector
        What its owner says.

    Raises
    ------
    InputError
        If the flats hold no light.
    """
    tables = ArrayReader(folder / "levels").read()
    levels, usable = _rungs(tables, job)
    sums = pair_sums(folder, job)
    # Pixels that are full saturate the flats though no sample of the converter does.
    points = transfer_points(sums[1])
    well = saturation(points)
    full = usable & (levels > (well[0] if well else math.inf))
    usable &= ~full
    light = _light(tables, levels, usable, job)
    medians = usual(folder, job.shape, job.gain, light)
    if job.flat and not medians.response > _LIT * medians.response_error:
        if not math.isfinite(medians.response):
            raise InputError(
                f"frames.flat: all flats are saturated (at {job.saturation:.0f} ADU); take them "
                "again with less light, or list none"
            )
        raise InputError(
            f"frames.flat: the flats hold no light ({levels.max():.2g} ADU above the bias); take "
            "them again, or list none"
        )
    ends = full_level(points), math.inf if well is None else well[0]
    top = float(np.fmin(job.saturation - medians.bias, ends[0] if ends[0] < math.inf else ends[1]))
    straight = None
    times = np.array([group.exptime for group in job.flat])
    if job.flats_timed and job.flat and _one_lamp(times[usable], levels[usable]):
        straight = linearity(times, levels, usable)
    charge = _dark_charge(folder, job)
    gain = None
    # The shot noise of the dark signal is no read noise; how large it is the gain tells.
    for _ in range(2 if charge else 1):
        shot = charge / (job.gain if gain is None else gain.gain)
        read_noise, own = _read_noise(sums[0], shot, folder, job)
        gain = _gain(sums, own, top, job)
    return Summary(
        declared, job.quantum or 1.0, medians, light, read_noise, own, gain, levels, usable, full,
        straight,
    )  # fmt: skip


def pair_sums(folder: Place, job: Measuring) -> F64:
    """Sums (2, N_BINS, COLUMNS) over the pairs of frames without and with light."""
    tables = ArrayReader(folder / "pairs")
    sums = np.zeros(tables.shape[2:])
    # Added up in the order of the columns: the same sums whoever measured them.
    for i, j in np.ndindex(grid(job.shape)):
        sums += tables.read((i, i + 1), (j, j + 1))[0, 0]
    return sums


def _before_rounding(
    variance: tuple[float, float], folder: Place, job: Measuring
) -> tuple[float, float] | None:
    """Noise of the amplifier and its error (ADU), by where the levels lie between codes."""
    assert job.read_series is not None
    bias, rate = on_grid(folder, job.shape, ("bias", "dark_rate"))
    means = bias + rate * job.read_series.exptime
    frames, step = len(job.read_series.frames), job.quantum
    in_steps = variance[0] / step**2, variance[1] / step**2
    found = noise_before_rounding(*in_steps, means[np.isfinite(means)] / step, frames)
    return found and (step * found[0], step * found[1])


def shared_by_lines(dark: F64) -> dict[str, Measure]:
    """Variance in time that all pixels of a row, or of a column, share, with its error (ADU²).

    Zero where it is not significant.

    Parameters
    ----------
    dark : (N_BINS, COLUMNS) float64
        Sums over pairs of frames without light, as `bin_pairs` gives them.
    """
    total = dark.sum(axis=0)
    if not total[0]:
        return {}
    error = total[2] / total[0] / math.sqrt(total[0])
    found = {}
    for name, lags in (("row", ((0, 1), (0, 2))), ("column", ((1, 0), (2, 0)))):
        at = [3 + LAGS.tolist().index(list(lag)) for lag in lags]
        # A coupling reaches the next pixel, and a row that repeats the row after it; not both.
        # The mean of its block was taken off.
        shared = float(total[at].min() / total[0]) * (BLOCK + 1) / BLOCK
        found[name] = (shared if shared > _SHARED * error else 0.0, error)
    return found


def _read_variance(dark: F64) -> tuple[float, float] | None:
    """Variance of a sample without light and its error (ADU²)."""
    dof, _, square = dark[:, :3].sum(axis=0)
    if not dof > 0:
        return None
    # What lines share was lost in part with the means of blocks.
    lost = sum(shared for shared, _ in shared_by_lines(dark).values()) / (BLOCK + 1)
    return square / dof + lost, square / dof * math.sqrt(2 / dof)


def _dark_charge(folder: Place, job: Measuring) -> float:
    """Mean dark signal (ADU) of usual pixels in the frames that tell the read noise."""
    series = job.read_series
    if series is None or not series.exptime > 0:
        return 0.0
    rate = on_grid(folder, job.shape, ("dark_rate",))[0]
    median, sigma = median_and_sigma(rate)
    usual = np.abs(rate - median) <= job.limits.hot * sigma
    return max(float(rate[usual].mean()), 0.0) * series.exptime if usual.any() else 0.0


def _read_noise(
    dark: F64, shot: float, folder: Place, job: Measuring
) -> tuple[Measure | None, Measure | None]:
    """Noise without light (ADU), less shot noise of a variance (ADU²), with and without rounding.

    Both with their errors.
    """
    whole = _read_variance(dark)
    if whole is None:
        return None, None
    variance = max(whole[0] - shot, SHEPPARD * job.quantum**2), whole[1]
    noise = math.sqrt(variance[0])
    measured = noise, variance[1] / (2 * noise) if noise else 0.0
    return measured, _before_rounding(variance, folder, job) if job.quantum else measured


def _gain(
    sums: F64, read_noise: tuple[float, float] | None, top: float, job: Measuring
) -> GainFit | None:
    """Photon transfer below the level ``top`` (ADU above bias) of saturation, neighbours added.

    None where the level above bias is unknown, or the error is too large.
    """
    if not (job.dark and job.flat):
        return None
    noise, error = read_noise or (job.read_noise, _GUESS_ERROR * job.read_noise)
    # With light there is noise enough that rounding adds no more and no less than this.
    variance = noise**2 + SHEPPARD * job.quantum**2
    highest = _LINEAR_SHARE * top
    dark, lit = sums
    lit = np.where(lit[:, 1:2] <= highest * lit[:, :1], lit, 0.0)
    # Noise of less than half a code is rounded up or down by where its level lies.
    smooth = lit[:, 2:3] > _SMOOTH * job.quantum**2 * lit[:, :1]
    lit = np.where(smooth, lit, 0.0) if smooth.any() else lit
    shared, added = add_neighbours(lit, dark)
    fitted = fit_gain(shared, variance, 2 * noise * error, highest, straight=len(job.flat) < LADDER)
    if fitted is None or not fitted.error < _GAIN_ERROR * fitted.gain:
        return None
    return replace(fitted, neighbours=tuple(added))


def _rungs(tables: F64, job: Measuring) -> tuple[F64, Mask]:
    """Level of each rung (ADU) over the columns that have one on all rungs, and which to use."""
    if not job.flat:
        return np.zeros(0), np.zeros(0, np.bool_)
    level, pixels, lost = (tables.reshape(-1, len(job.flat), 3)[..., n] for n in range(3))
    frames = np.array([len(group.frames) for group in job.flat])
    usable = np.less_equal(lost.sum(axis=0), _SATURATED_RUNG * frames * pixels.sum(axis=0))
    common = np.isfinite(level[:, usable]).all(axis=1, keepdims=True)
    weight = np.where(common & np.isfinite(level), pixels, 0.0)
    total = (weight * np.nan_to_num(level)).sum(axis=0)
    seen = weight.sum(axis=0)
    return np.divide(total, seen, out=np.zeros_like(total), where=seen > 0), usable


def _light(tables: F64, levels: F64, usable: Mask, job: Measuring) -> F64:
    """Light of each tile over that of the detector, from the steps that most pixels have."""
    if not job.flat:
        return np.ones(grid(job.shape))
    lost = tables[..., 2].sum(axis=(0, 1))
    taken = usable if usable.any() else lost == lost.min()
    frames = np.array([len(group.frames) for group in job.flat])
    own = tables[..., 0]
    weight = np.where(np.isfinite(own) & taken, frames, 0.0)
    whole = (weight * levels).sum(axis=-1)
    charge = (weight * np.nan_to_num(own)).sum(axis=-1)
    share: F64 = np.divide(charge, whole, out=np.full_like(whole, np.nan), where=whole != 0)
    return share


def _one_lamp(times: F64, levels: F64) -> bool:
    """Whether flats (s, ADU) can be of one lamp: of several at one exposure time they are not."""
    rates = levels / times
    return len(np.unique(times)) == len(times) > 0 and bool(rates.max() < (1 + _LAMP) * rates.min())


def linearity_report(summary: Summary, job: Measuring, gain: float) -> dict[str, Any] | None:
    """What ``reduce.json`` says of the ladder of flats; None when there is none."""
    if summary.linearity is None:
        return None
    rows = zip(job.flat, summary.levels, summary.linearity.deviation, strict=True)
    return {
        "max_deviation_percent": 100 * summary.linearity.max_deviation,
        "intercept_adu": summary.linearity.intercept,
        "levels": [
            {
                "exptime_s": group.exptime,
                "frames": len(group.frames),
                "level_adu": float(level),
                "level_e": float(gain * level),
                "deviation_percent": 100 * float(off) if math.isfinite(off) else None,
            }
            for group, level, off in rows
        ],
    }
