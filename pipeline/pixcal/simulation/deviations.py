"""Deviations of frames from the nominal bench, and how they change with the samples.

Residuals, parameters of the frames, maps of the pixels, and second moments of the first two. The
parameter of a frame without light is its level, as free as the light of fringes. All are zero on
the nominal bench, except for known noise and the scatter of pixels. A change of the samples changes
the first three linearly, less the part that the fit absorbs.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct

from pixcal.estimators.diagnosis.distortions import Freedom
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack
from pixcal.estimators.maps.structure import without_outliers
from pixcal.estimators.test_statistics.fringe_set_data import FringeSetData
from pixcal.kernels.medians import SIGMA_OF_MAD
from pixcal.model.arrays import F32, F64, Mask
from pixcal.simulation.map_deviation import MAPS, Deviation, change_of_maps, weighed
from pixcal.simulation.pairs import pair_sums, pair_variance, taken_by_fit

OUTLIER_SIGMA = 8.0  # standard deviations above which a residual is an outlier
HARMONICS = 2  # harmonics of the phase on which fitted frame parameters may depend
TINY = 1e-30  # weight that counts as none
KNOWN = 0.02  # relative error of the modelled variance of a frame's parameters

LINEAR = ("residual", "frames", "maps")
Change = dict[str, NDArray[Any]]


class _Deviations:
    """Common part of fringes and calibration frames."""

    good: Mask

    def measured(self, name: str) -> Deviation:
        """A deviation of the data."""
        deviation: Deviation = getattr(self, name)
        return deviation

    residual: Any
    _parameters: Any  # (s, t) of the frames
    _frame_noise: Any  # (s, t) theirs, from the noise of the samples
    _lost = 0.0  # share of their modes that a fit removed

    @cached_property
    def _root(self) -> F32:
        return np.asarray(np.sqrt(self.residual.weight))

    def over_noise(self, rest: F32) -> F32:
        """Residuals (t, n) of the first frames over their noise, as (t, y, x); 0 without weight."""
        values = np.zeros((len(rest), *self.good.shape), np.float32)
        values[:, self.good] = rest * self._root[: len(rest)]
        return values

    def _pairs(self, place: F32, covariance: F64, of_time: F32) -> Deviation:
        values = self.over_noise(self.residual.value)
        taken = taken_by_fit(place, covariance, of_time, self.good)
        variance = pair_variance(len(values), self.good)
        return Deviation(pair_sums(values, self.good) - taken, _inverse(variance))

    def pairs_between(self, noise: F32, other: F32, per_adu: F32) -> F64:
        """Change of ``pairs`` if noise (t, y, x) of the first frames, ADU, becomes ``other``."""
        # An ADU is ``per_adu`` (y, x) reduced electrons.
        before, after = (
            pair_sums(self.over_noise((values * per_adu)[:, self.good]), self.good)
            for values in (noise, other)
        )
        return np.asarray((after - before) * len(self._root) / len(noise))

    @cached_property
    def frames(self) -> Deviation:
        """Parameters (s, t) of the frames; noise from samples or, if larger, from steps."""
        steps = np.diff(self._parameters, axis=1)
        spread = (SIGMA_OF_MAD * np.median(np.abs(steps), axis=1, keepdims=True)) ** 2 / 2
        return Deviation(self._parameters, _inverse(np.maximum(spread, self._frame_noise**2)))

    @cached_property
    def power(self) -> Deviation:
        """Power (s, band) of the frames' parameters, divided by the power of their noise."""
        power = band_power(self._parameters / self._frame_noise)
        modes = band_power(np.ones(self._parameters.shape), squares=False) * (1 - self._lost)
        return Deviation(power - modes, _inverse(2 * modes + (KNOWN * modes) ** 2))

    def second_moments(self, name: str, change: NDArray[Any]) -> F64:
        """Contribution of a random change: of residuals to ``pairs``, of frames to ``power``."""
        if name == "power":
            return band_power(change / self._frame_noise)
        return pair_sums(self.over_noise(change), self.good)


class SetDeviations(_Deviations):
    """Deviations of a fringe set from the nominal bench."""

    def __init__(self, evidence: Evidence, fringes: FringeEvidence) -> None:
        self.fringes, self._evidence, self.good = fringes, evidence, fringes.good
        turns = np.arange(1, HARMONICS + 1)[:, None] * fringes.phi
        terms = np.concatenate([np.ones((1, len(fringes.phi))), np.cos(turns), np.sin(turns)])
        self._of_phase = np.linalg.svd(terms, full_matrices=False)[2]
        self._lost = len(self._of_phase) / len(fringes.phi)

    @cached_property
    def freedom(self) -> Freedom:
        """Degrees of freedom of the fit."""
        return Freedom(self.fringes)

    @cached_property
    def residual(self) -> Deviation:
        """Residuals (t, n) of the fit in good pixels, e-."""
        freedom = self.freedom
        rest = freedom.left_over(freedom.of_good(self.fringes.residual))
        calm = rest**2 * freedom.weight < OUTLIER_SIGMA**2
        weight = np.where(calm, freedom.weight, np.float32(0))
        return Deviation(rest, weight)

    @cached_property
    def maps(self) -> Deviation:
        """Maps (3, y, x) of the pixels, of `MAPS`."""
        maps = FringeSetData(self.fringes, self._evidence).maps
        return weighed(np.stack([maps[name] for name in MAPS]))

    @cached_property
    def pairs(self) -> Deviation:
        """Products of residuals (`pair_sums`)."""
        freedom = self.freedom
        place = freedom.of_place * self._root.mean(axis=0)
        return self._pairs(place, freedom.frame_covariance.mean(axis=0), freedom.of_time)

    @cached_property
    def _parameters(self) -> F64:
        return self._series(self.fringes.free)

    @cached_property
    def _frame_noise(self) -> F64:
        """Noise of the series (4, t), from the noise of the samples."""
        fringes, nothing = self.fringes, np.zeros(len(self.fringes.g))
        b, a_cos, a_sin = fringes.g.T
        size = a_cos**2 + a_sin**2
        kx, ky = (np.full(len(b), k) for k in fringes.k)
        slopes = np.stack(
            [
                [1 / b, nothing, nothing, nothing, nothing],
                [-1 / b, a_cos / size, a_sin / size, nothing, nothing],
                [nothing, nothing, nothing, kx, ky],
                [nothing, nothing, nothing, -ky, kx],
            ]
        )
        variance = np.einsum("sit,tij,sjt->st", slopes, fringes.free_covariance, slopes)
        return np.asarray(np.sqrt(np.maximum(variance, 1e-30)))

    def _series(self, free: F64) -> F64:
        """Intensity and contrast (relative), fringe vector along and across it, (4, t)."""
        b, a_cos, a_sin, dkx, dky = free.T
        contrast = np.hypot(a_cos, a_sin) / b
        kx, ky = self.fringes.k
        series = np.stack(
            [b / b.mean(), contrast / contrast.mean(), kx * dkx + ky * dky, kx * dky - ky * dkx]
        )
        return np.asarray(series - (series @ self._of_phase.T) @ self._of_phase)

    def change(
        self, samples: F32, constant: F64, relative: F64, names: Sequence[str] = LINEAR
    ) -> Change:
        """Change of the linear deviations by a change of the samples.

        ``samples``: (t, y, x) reduced, e-. ``constant, relative``: (y, x) simultaneous change of
        bias and darks, subtracted from every frame, e-; and relative change of the flats.
        """
        fringes, good = self.fringes, self.good
        changed = np.take(samples.reshape(len(samples), -1), np.flatnonzero(good), axis=1)
        share = np.linalg.pinv(fringes.g).astype(np.float32) @ changed
        change: Change = {}
        if "residual" in names:
            change["residual"] = self.freedom.left_over(changed)
        if "frames" in names:
            # Residual change after the fit of the pixels.
            beside = fringes.model.copy()
            beside[:, good] += changed - fringes.g.astype(np.float32) @ share
            (free, _), *_ = fringes.free_of(beside)
            before = np.hstack([fringes.g, fringes.dk])
            change["frames"] = self._series(free) - self._series(before)
        if "maps" in names:
            theta = share.astype(float) - fringes.theta[:, good] * relative[good]
            theta[0] -= constant[good] / fringes.g[:, 0].mean()
            change["maps"] = self._map_change(theta)
        return change

    def _map_change(self, change: F64) -> F64:
        good = self.good
        (iota, s, c), (d_iota, d_s, d_c) = self.fringes.theta[:, good], change
        alpha2 = np.maximum(s**2 + c**2, 1e-30)
        light, amplitude = d_iota / iota, (s * d_s + c * d_c) / alpha2
        turn = (c * d_s - s * d_c) / alpha2 / float(np.hypot(*self.fringes.k))
        of_map = {"offset": turn, "contrast": amplitude - light, "light": light}
        out = np.full((len(MAPS), *good.shape), np.nan)
        out[:, good] = [of_map[name] for name in MAPS]
        return change_of_maps(out, self.maps)


class StackDeviations(_Deviations):
    """Deviations of calibration frames of one kind and exposure time."""

    def __init__(self, evidence: Evidence, stack: Stack) -> None:
        self._evidence, self._stack, self.good = evidence, stack, evidence.good

    @cached_property
    def residual(self) -> Deviation:
        """Samples (t, n) of good pixels less their mean over time and the frame's level, ADU."""
        return self._split[0]

    @cached_property
    def _parameters(self) -> F64:
        return self._split[1]

    @cached_property
    def _split(self) -> tuple[Deviation, F64]:
        """Residuals, and levels (1, t) of the frames."""
        e, adu = self._evidence, self._stack.adu[:, self.good]
        dark = e.dark_charge_rate[self.good] * np.nan_to_num(self._stack.exptime_s)
        variance = (e.read_noise**2 + dark) / e.gain**2 * self._left
        rest = adu - adu.mean(axis=0)
        calm = (rest - np.median(rest, axis=1, keepdims=True)) ** 2 < OUTLIER_SIGMA**2 * variance
        weight = np.where(calm, 1 / variance, 0).astype(np.float32)
        level = np.einsum("tn,tn->t", weight, rest) / np.maximum(weight.sum(axis=1), TINY)
        return Deviation(rest - level[:, None], weight), level[None].astype(float)

    @property
    def _left(self) -> float:
        """Share of the variance that the means over time leave."""
        return max(1 - 1 / len(self._stack.adu), 0.5)

    @cached_property
    def _frame_noise(self) -> F64:
        weight = self.residual.weight.sum(axis=1, dtype=float)[None]
        return np.asarray(np.maximum(weight * self._left, TINY) ** -0.5)

    @cached_property
    def maps(self) -> Deviation:
        """Mean (1, y, x) of the frames, less the bias, ADU."""
        mean = self._stack.adu.mean(axis=0)
        if self._stack.kind != "bias":
            mean = mean - self._evidence.bias
        return weighed(without_outliers(np.where(self.good, mean, np.nan))[None])

    @cached_property
    def pairs(self) -> Deviation:
        """Products of residuals (`pair_sums`)."""
        count = len(self._stack.adu)
        same = np.full((1, count), count**-0.5, np.float32)
        of_level = (self._frame_noise**2).mean()[None, None] * self._left
        return self._pairs(self._root.mean(axis=0)[None], of_level, same)

    def pairs_between(self, noise: F32, other: F32, per_adu: F32) -> F64:
        """As in `SetDeviations`, in ADU."""
        return super().pairs_between(noise, other, np.ones_like(per_adu))

    def change(self, samples: F32, bias: F64, names: Sequence[str] = LINEAR) -> Change:
        """As in `SetDeviations`, in ADU; ``bias``: its simultaneous change."""
        changed = samples[:, self.good]
        change: Change = {}
        rest = changed - changed.mean(axis=0)
        level = rest.mean(axis=1, keepdims=True)
        if "residual" in names:
            change["residual"] = rest - level
        if "frames" in names:
            change["frames"] = level.T.astype(float)
        if "maps" in names:
            mean = np.full((1, *self.good.shape), np.nan)
            mean[0, self.good] = changed.mean(axis=0) - bias[self.good]
            change["maps"] = change_of_maps(mean, self.maps)
        return change


def band_power(series: F64, *, squares: bool = True) -> F64:
    """Sums of squares (s, band) of cosine modes of series (s, t) per octave, or mode counts."""
    power = dct(series, norm="ortho", axis=1)[:, 1:] ** 2 if squares else series[:, 1:]
    modes = power.shape[1]
    starts = 2 ** np.arange(2, max(int(np.log2(max(modes, 8))), 3)) - 4
    return np.asarray(np.add.reduceat(power, starts[starts < modes], axis=1))


def _inverse(variance: F64) -> F64:
    return np.where(variance > 0, 1 / np.where(variance > 0, variance, 1), 0)
