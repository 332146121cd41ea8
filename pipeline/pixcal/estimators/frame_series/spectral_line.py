"""A vibration in series of frames: the strongest line of their spectrum."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.frame_series.series import FrameSeries
from pixcal.estimators.frame_series.variance_components import log_chance, sigmas
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F64

OVERSAMPLING = 8  # frequencies examined per independent frequency of a series
SLOWEST = 4.0  # fewest periods of a line within a run; slower changes are drift
# effective trials per independent frequency, as the maximum may lie between two
TRIALS = 4.0


@dataclass(frozen=True)
class Line:
    """A line of one frequency in the series of all sets."""

    hz: float  # hz, hz_error: as sampled: aliased if above half the frame rate
    hz_error: float
    # amplitude, amplitude_error: (2,) of each channel; mean square over the sets, less that of
    # the noise
    amplitude: F64
    amplitude_error: F64
    # logarithm of the probability of such a line by noise anywhere in the spectrum
    log_chance: float

    @property
    def significant(self) -> bool:
        """Whether it is significant."""
        return sigmas(self.log_chance) > SIGNIFICANT


def find_line(
    every: Sequence[FrameSeries],
    level: Callable[[FrameSeries], F64],
    channels: Sequence[int] = (0, 1),
) -> Line | None:
    """The strongest line of some ``channels``; None where the runs are too short for one.

    ``level``: of a series, the variance (t - 1, 2) of its modes without a line.
    """
    lengths = [(np.ptp(s.frame) + 1) * s.step_s for s in every]
    top = min(0.5 / s.step_s for s in every)
    low = SLOWEST / min(lengths)
    grid = np.arange(low, top, 1 / (OVERSAMPLING * max(lengths)))
    if len(grid) < OVERSAMPLING:
        return None
    powers = [_spectrum(s, level(s), channels, grid) for s in every]
    power = np.sum([p.sum(axis=1) for p, _ in powers], axis=0)
    at = int(np.argmax(power))
    trials = TRIALS * len(grid) / OVERSAMPLING
    chance = log_chance(float(power[at]), len(every) * len(channels)) + np.log(trials)
    hz, sharpness = _peak(grid, power, at)
    amplitude, error = np.zeros(2), np.zeros(2)
    for n, channel in enumerate(channels):
        # Power in units of the noise's mean 1; the amplitude's square is 4 / t of it.
        unit = [4 * v[at, n] / len(s) for s, (_, v) in zip(every, powers, strict=True)]
        square = np.mean([(p[at, n] - 1) * u for (p, _), u in zip(powers, unit, strict=True)])
        amplitude[channel] = np.sqrt(max(square, 0.0))
        error[channel] = np.sqrt(np.mean(unit) / 2 / len(every))
    return Line(hz, sharpness, amplitude, error, min(float(chance), 0.0))


def without_line(
    every: Sequence[FrameSeries],
    level: Callable[[FrameSeries], F64],
    channels: Sequence[int] = (0, 1),
) -> tuple[Line | None, tuple[FrameSeries, ...]]:
    """The strongest line, as `find_line`, and the series without it if it is significant."""
    line = find_line(every, level, channels)
    if line is None or not line.significant:
        return line, tuple(every)
    # Repeated with a level that the line itself does not raise.
    levels = {s.name: level(s) for s in _without_line(every, line)}
    line = find_line(every, lambda s: levels[s.name], channels) or line
    return line, _without_line(every, line)


def _without_line(every: Sequence[FrameSeries], line: Line) -> tuple[FrameSeries, ...]:
    cleared = []
    for s in every:
        turn = 2 * np.pi * line.hz * s.time_s
        # Equal weights: the power around a line is its own.
        swing = np.stack([np.ones_like(turn), np.cos(turn), np.sin(turn)], axis=1)
        sizes = np.linalg.lstsq(swing, s.values)[0]
        cleared.append(replace(s, values=s.values - swing @ sizes))
    return tuple(cleared)


def _spectrum(s: FrameSeries, level: F64, channels: Sequence[int], grid: F64) -> tuple[F64, F64]:
    """Power (f, channel) in units of the level, and the level, both at frequencies ``grid``."""
    # Whitened by its modes first: a walk or a ramp would leak over the whole spectrum.
    n, basis = len(s), s.walk_modes
    level = level[:, list(channels)]
    place = s.frame - s.frame[0]
    white = np.zeros((place[-1] + 1, len(channels)))
    white[place] = basis.series(basis.of(s.values[:, list(channels)]) / np.sqrt(level))
    size = 1 << int(np.ceil(np.log2(2 * OVERSAMPLING * len(white))))
    power = np.abs(np.fft.rfft(white, size, axis=0)) ** 2 / n
    frequency = np.arange(len(power)) / (size * s.step_s)
    at = np.arange(1, n) / (2 * n * s.step_s)
    levels = [np.interp(grid, at, column) for column in level.T]
    powers = [np.interp(grid, frequency, column) for column in power.T]
    return np.stack(powers, axis=1), np.stack(levels, axis=1)


def _peak(grid: F64, power: F64, at: int) -> tuple[float, float]:
    """Frequency of a peak and its error, from a parabola through its three highest values."""
    step = grid[1] - grid[0]
    inside = min(max(at, 1), len(grid) - 2)
    before, here, after = power[inside - 1 : inside + 2]
    curvature = before - 2 * here + after
    if curvature >= 0:
        return float(grid[at]), float(step)
    shift = float(np.clip((before - after) / (2 * curvature), -1, 1))
    # The power is the growth of the log-likelihood: its curvature is the information.
    return float(grid[inside] + shift * step), float(step / np.sqrt(-curvature))
