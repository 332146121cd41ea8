"""The detector as a whole: read noise, gain and linearity, from the statistics of all columns."""

import math
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.detector.bad_pixels import noisy_beyond
from pixcal.estimators.detector.emva import Measure, full_level, saturation, transfer_points
from pixcal.estimators.detector.missing_codes import missing_codes, step_noise
from pixcal.estimators.detector.pair_noise import without_bands
from pixcal.estimators.detector.straightness import Straightness, straightness
from pixcal.kernels.gain_fit import LADDER, GainFit, fit_gain
from pixcal.kernels.photon_transfer import add_neighbours
from pixcal.kernels.rounding import SHEPPARD, UNDETERMINED_BELOW
from pixcal.model.acquisition import Detector
from pixcal.model.arrays import F64, Mask
from pixcal.model.errors import InputError
from pixcal.stages.reduce import read_noise
from pixcal.stages.reduce.calibration import Usual, usual
from pixcal.stages.reduce.flat_steps import exposure_steps, levels_with_light, light_of_tiles, wells
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.reduce.measuring import Measuring
from pixcal.stages.tiles import grid
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.place import Place

ROUNDING_ADU = math.sqrt(SHEPPARD)  # noise of a converter that rounds to whole ADU

_LINEAR_SHARE = 0.7
_KNOWN = 0.2  # largest relative error of a variance that replaces that of frames without light
# least relative error of the noise of frames without light that is not on the curve of the flats,
# if these do not tell it
_OFF_CURVE = 0.15
_GAIN_ERROR = 0.2
_GUESS_ERROR = 0.1  # relative error of gain and read noise in `Measuring`
# variance of a sample, in square codes, above which rounding adds the same at every level
_SMOOTH = 0.25 + SHEPPARD
_LIT = 5.0  # least response of the median pixel over its error: below it the flat would be noise


@dataclass(frozen=True)
class Summary:
    """Results of the calibration frames for the whole detector; None if not measurable."""

    declared: Detector  # as in ``acquisition.yaml``
    step: float  # of the converter (ADU)
    usual: Usual  # medians of the maps
    light: F64  # light of each tile in the flats, over that of the detector
    # of a sample, rounding included, from differences of successive frames; and its error (ADU)
    read_noise: tuple[float, float] | None
    before_rounding: tuple[float, float] | None  # same, without the rounding of the converter
    gain: GainFit | None  # by photon transfer
    levels: F64  # (step,) levels of the exposure-time steps of flats (ADU above bias and dark)
    # usable, full: (step,) steps without saturation; steps with full pixels although the
    # converter does not saturate
    usable: Mask
    full: Mask
    transfer: F64  # (point, 3) photon-transfer curve: see `emva.transfer_points`
    well: Measure | None  # level of its maximum (ADU above bias), if the flats go beyond
    linearity: Straightness | None  # of the usable steps

    @property
    def above_step(self) -> Mask:
        """Steps of the flats that are read at another gain, as in a dual-gain camera."""
        top = self.gain.levels[1] if self.gain and self.gain.step else np.inf
        return np.asarray(self.levels > top)

    def gain_to_use(self, choice: str, dark: bool) -> float:
        """Gain (e-/ADU), ``declared`` or ``measured``; InputError if there is no measured one.

        ``dark``: whether there are frames without light.
        """
        declared = self.declared.gain_e_per_adu
        if choice == "declared" and declared is not None:
            return declared
        if self.gain is None:
            asked, remedy = "gain: 'measured'", "use gain: declared"
            if declared is None:
                asked, remedy = "detector.gain_e_per_adu: missing", "give it in e-/ADU"
            why = "the flats show no photon noise above the read noise"
            if not dark:
                why = "without bias or dark frames the flats cannot measure it"
                remedy = f"list bias frames, or {remedy}"
            raise InputError(f"{asked}, but {why}; {remedy}")
        return self.gain.of_electrons[0]

    def read_noise_e(self, gain: float) -> float:
        """Read noise (e-): measured, else declared; never below the converter's rounding."""
        noise = self.declared.read_noise_e
        if self.read_noise is not None:
            noise = gain * self.read_noise[0]
        return max(noise, gain * ROUNDING_ADU * self.step)

    def noise_measured_e(self, noise: Measure | None, gain: float) -> Measure | None:
        """A noise (ADU) and its error in e-, by the measured gain, else by the used gain."""
        if noise is None:
            return None
        factor, error = (gain, 0.0) if self.gain is None else self.gain.of_electrons
        return factor * noise[0], math.hypot(factor * noise[1], error * noise[0])

    def noise_before_rounding_e(self, gain: float) -> float:
        """Read noise (e-) of the amplifier: measured, else declared."""
        # If samples of a single code only bound it far below a step, use that bound.
        if self.before_rounding is not None:
            return gain * self.before_rounding[0]
        if self.read_noise is None:
            return self.declared.read_noise_e
        return min(self.declared.read_noise_e, gain * UNDETERMINED_BELOW * self.step)


def summarise(job: Measuring, folder: Place, source: Ingested) -> Summary:
    """Combine the statistics of all columns; InputError if the flats hold no light."""
    tables = ArrayReader(folder / "levels").read()
    levels, usable, nearly = exposure_steps(tables, job)
    sums = dark, lit, _ = pair_sums(folder, job)
    # Full pixels saturate the flats even if the converter does not saturate.
    points = transfer_points(add_neighbours(lit, dark)[0])
    rate = read_noise.dark_rate(folder, job)
    times = np.array([group.exptime for group in job.flat])
    charged = levels + rate * times if job.flats_timed and job.flat else levels
    well, full = wells(saturation(points), levels, charged, usable, nearly)
    usable &= ~full
    light = light_of_tiles(tables, levels, usable, job)
    medians = usual(job, folder, light)
    if job.flat and not medians.response > _LIT * medians.response_error:
        if not math.isfinite(medians.response):
            raise InputError(
                f"frames.flat: all flats are saturated (at {job.saturation:.0f} ADU); record "
                "them again with less light, or list none"
            )
        raise InputError(
            f"frames.flat: the flats hold no light ({levels.max():.2g} ADU above the bias); take "
            "them again, or list none"
        )
    ends = full_level(points), math.inf if well is None else well[0] - well[1]
    top = float(np.fmin(job.saturation - medians.bias, ends[0] if ends[0] < math.inf else ends[1]))
    charge = 0.0 if job.read_series is None else rate * job.read_series.exptime
    gain, wander, lost = None, read_noise.bias_wander(job), read_noise.lost_in_blocks(job)
    # Shot noise of the dark signal is not read noise; its size depends on the gain.
    for _ in range(2 if charge else 1):
        shot = charge / (job.gain if gain is None else gain.gain)
        error = _GUESS_ERROR if gain is None else gain.error / gain.gain
        noise, unrounded, spread = read_noise.read_noise(dark, lost, (shot, error * shot), job)
        gain = _gain(sums, unrounded, lost[0], wander, top, job)
    if spread is not None:
        medians = replace(medians, noisy=noisy_beyond(medians.noisy, spread))
    if gain is not None and (read_noise.is_cut_off(job) or _tells_noise(gain)):
        noise, unrounded = read_noise.of_variance(gain.read_variance, job.quantum)
    elif gain is not None and gain.without_dark:
        noise, unrounded = (n and (n[0], max(n[1], _OFF_CURVE * n[0])) for n in (noise, unrounded))
    noise, unrounded = (
        n and read_noise.of_few_lines(n, dark, job.shape) for n in (noise, unrounded)
    )
    known = math.nan if gain is None else gain.read_variance[0]
    straight = straightness(levels_with_light(source, levels, usable, rate), points, known)
    return Summary(
        source.detector,
        job.quantum or 1.0,
        medians,
        light,
        noise,
        unrounded,
        gain,
        levels,
        usable,
        full,
        points,
        well,
        straight,
    )


def _tells_noise(gain: GainFit) -> bool:
    """Whether the noise at level zero comes from flats alone."""
    variance, error = gain.read_variance
    return gain.without_dark and error < _KNOWN * variance


def pair_sums(folder: Place, job: Measuring) -> tuple[F64, F64, bool]:
    """Sums (N_BINS, COLUMNS) over pairs of frames without and with light; whether bands are out."""
    tables = ArrayReader(folder / "pairs")
    sums = np.zeros(tables.shape[2:])
    # Added in the order of the columns, so that the sums do not depend on the workers.
    for i, j in np.ndindex(grid(job.shape)):
        sums += tables.read((i, i + 1), (j, j + 1))[0, 0]
    dark, lit, rest = sums
    steady = without_bands(lit, rest)
    return dark, steady, steady is rest


def _gain(
    sums: tuple[F64, F64, bool],
    known: Measure | None,
    lost: float,
    wander: float,
    top: float,
    job: Measuring,
) -> GainFit | None:
    """Photon transfer below the level ``top`` (ADU above bias) of saturation, neighbours added."""
    # ``lost``: variance without light that blocks remove (ADU²). ``wander``: of the bias (ADU).
    # None if the level above bias is unknown, or the error is too large.
    if not (job.dark and job.flat):
        return None
    noise, error = known or (job.read_noise, _GUESS_ERROR * job.read_noise)
    # With light, noise is high enough for rounding to add exactly this.
    dark, lit, bands = sums
    steps, uneven = _steps(job)
    variance = noise**2 + steps - lost
    highest = _LINEAR_SHARE * top
    lit = np.where(lit[:, 1:2] <= highest * lit[:, :1], lit, 0.0)
    # Noise below half a code is rounded up or down depending on its level.
    smooth = lit[:, 2:3] > _SMOOTH * job.quantum**2 * lit[:, :1]
    lit = np.where(smooth, lit, 0.0) if smooth.any() else lit
    shared, lags, common = add_neighbours(lit, dark)
    fitted = fit_gain(
        shared,
        (variance, 2 * noise * error),
        highest,
        level_error=wander,
        uneven=uneven,
        common=common,
        straight=len(job.flat) < LADDER,
        without_dark=job.without_dark,
    )
    if fitted is None or not fitted.error < _GAIN_ERROR * fitted.gain:
        return None
    everywhere = (0, 0) in lags
    at_zero, of_zero = fitted.read_variance
    return replace(
        fitted,
        read_variance=(at_zero + lost, of_zero),
        neighbours={} if everywhere else lags,
        uneven=everywhere or bands,
    )


def _steps(job: Measuring) -> tuple[float, float]:
    """Variance that the converter's steps add (ADU²), and ``uneven`` of `fit_gain` (ADU³)."""
    rounding = SHEPPARD * job.quantum**2
    if not job.quantum:
        return rounding, 0.0
    # Within one level, because codes between two levels need not occur.
    if not any(len(missing_codes(read_noise.code_counts([group], job))) for group in job.flat):
        return rounding, 0.0
    variance, density = step_noise(read_noise.code_counts(job.flat, job))
    return rounding + variance * job.quantum**2, density * job.quantum**3
