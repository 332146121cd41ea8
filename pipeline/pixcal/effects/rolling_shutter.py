"""Rows that are exposed one after the other while the phase modulator steps."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.row_sums import (
    RowRamp,
    RowSums,
    enough_frames,
    find_settling,
    profile,
    settling_sigmas,
    steps_of,
)
from pixcal.estimators.maps.corrected import absorbed_map_change, unabsorbed_power
from pixcal.kernels.synthesis import illuminate
from pixcal.model.arrays import F32, F64
from pixcal.model.bench import Bench
from pixcal.model.config import quantity
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Again, Effect, Estimate, FringeMaps, Stage
from pixcal.simulation.fringe_maps import FittedFrames
from pixcal.simulation.shot import Shot

FEWEST = 4  # least number of rows of a settling profile
# relative error of the slope, from the correction for what the frames' parameters absorb
_MODEL = 0.01


@dataclass(frozen=True)
class RollingShutter(Effect):
    """Each row is exposed later than the one before."""

    name = "rolling_shutter"
    title = "rolling shutter"
    acts_at = Stage.LIGHT
    order = 9
    domains = ("time", "space")
    strengths = ("line_time_us", "settling")
    frames_needed = ("random",)
    sources = (
        "Pyxalis GIGAPYX-4600 as in Rousset et al.: 5456 rows at 152 frames/s are 1.2 us a row; at "
        "the 7 frames/s of the paper's bench 26 us",
        "El Gamal & Eltoukhy 2005, IEEE Circuits and Devices Magazine 21(3), 6: rows of a CMOS "
        "sensor are reset and read one after the other",
    )

    line_time_us: float = quantity(1.2, unit="us", low=0, high=1e5)
    """delay from one row to the next"""
    delay_us: float = quantity(0.0, unit="us", low=0, high=1e10)
    """time from the end of the exposure of the first row to the phase step"""

    settling: tuple[float, ...] = quantity((), low=-1, high=1)
    """phase error as a share of the phase step, at equally spaced rows from the first to the last
    of the window (none, or at least four)"""
    of_step: str = quantity("last", choices=("last", "next"))
    """phase step that settling refers to: from the previous frame (last), or to the next one
    (next)"""
    origin_rad: float | None = quantity(None, unit="rad", low=-10, high=10)
    """start of the modulator's range of 2 pi; default: the modulator moves by the shorter path"""

    def check(self, bench: Bench) -> None:
        if 0 < len(self.settling) < FEWEST:
            raise InputError(
                f"settling: {len(self.settling)} values; give none, or at least {FEWEST}"
            )
        frames = bench.frames
        last = self.line_time_us * (bench.detector.shape[0] - 1) * 1e-6
        if last > frames.period_s:
            raise InputError(
                f"line_time_us: the last row starts {last:g} s after the "
                f"first, later than the next frame (frames.period_s: {frames.period_s:g} s)"
            )
        if self.delay_us * 1e-6 > frames.period_s:
            raise InputError(
                f"delay_us: must be at most frames.period_s ({frames.period_s:g} s), not "
                f"{self.delay_us * 1e-6:g} s"
            )

    def shares(self, rows: F64, exptime_s: float, period_s: float) -> tuple[F64, F64]:
        """Shares of the next and of the previous phase in the exposure of rows of the window."""
        start = self.line_time_us * 1e-6 * rows
        step = exptime_s + self.delay_us * 1e-6
        # An unknown exposure time counts as zero.
        lit = max(exptime_s, 1e-12)
        after = np.clip((start + exptime_s - step) / lit, 0, 1)
        before = np.clip((step - period_s - start) / lit, 0, 1)
        return after, before

    def photons(self, mean: F32, shot: Shot) -> F32:
        recording = shot.recording
        if recording.kind != "fringes":
            return mean
        shares = self.shares(
            np.arange(*shot.rows, dtype=float), recording.exptime_s, recording.period_s
        )
        mixed = mean
        for share, frame in zip(shares, (shot.frame + 1, shot.frame - 1), strict=True):
            other = shot.mean(frame) if share.any() else None
            # Before the first frame and after the last one, the modulator is at rest.
            if other is not None:
                mixed = mixed + share.astype(np.float32)[:, None] * (other - mean)
        return mixed + self._settled(shot) if any(self.settling) else mixed

    def _settled(self, shot: Shot) -> F32:
        """Change of a frame's mean signal by phase errors of the rows, e-."""
        states, light, shape = shot.states, shot.light, shot.bench.detector.shape
        step = steps_of(states.phi, -1 if self.of_step == "last" else 1, self.origin_rad)
        rows = np.arange(*shot.rows) / max(shape[0] - 1, 1)
        turn = step[shot.frame] * profile(self.settling, rows)
        columns, lines = states.turns(shot.frame, shape, shot.rows)
        cos, sin = np.cos(turn).astype(np.float32), np.sin(turn).astype(np.float32)
        later = np.stack([lines[0] * cos - lines[1] * sin, lines[1] * cos + lines[0] * sin])
        signals = []
        for of_rows in (lines, later):
            signals.append(np.empty_like(light.iota))
            illuminate(
                light.iota,
                light.alpha_sin,
                light.alpha_cos,
                states.level[shot.frame],
                states.amplitude[shot.frame],
                columns,
                of_rows,
                signals[-1],
            )
        return signals[1] - signals[0]

    def undo(self, maps: FringeMaps) -> FringeMaps | None:
        """Maps corrected for the phase errors of the rows; None if frames are unknown."""
        if maps.frames is None:
            return None
        flat = 1.0 if maps.flat is None else maps.flat
        theta = maps.theta * flat
        first, count = maps.frames.rows
        # Pixels outside the window take the values at its edge.
        rows = np.clip(maps.origin[0] - first + np.arange(theta.shape[1]), 0, count - 1)
        g, noise = maps.frames.g, maps.frames.read_noise_e
        for share, change in self._changes(maps.frames):
            theta = theta - share[rows, None] * absorbed_map_change(theta, g, change, noise)
        return replace(maps, theta=theta / flat)

    def noise_factor(self, charge: float, read_noise: float, maps: FringeMaps) -> F64:
        """As in `Effect.noise_factor`: errors were scaled by the usual residuals of pixels."""
        left = np.zeros(1)
        if maps.frames is not None:
            g, noise = maps.frames.g, maps.frames.read_noise_e
            for share, change in self._changes(maps.frames):
                left = left + share**2 * unabsorbed_power(maps.theta, g, change, noise)
        return np.full(maps.theta.shape[1:], (1 + np.median(left)) ** -0.5)

    def _changes(self, frames: FittedFrames) -> Iterator[tuple[F64, F64]]:
        """Shares of the window's rows (y,), and changes of the frames (t, 3) for a share of one."""
        # Minus the part that the frames' parameters absorb: the mean of all rows and, if vectors
        # are free, slopes.
        g, rows = frames.g, np.arange(frames.rows[1], dtype=float)
        turned = np.stack([np.zeros(len(g)), -g[:, 2], g[:, 1]], axis=1)
        size = np.maximum(np.sum(turned**2, axis=1), 1e-30)[:, None]
        even = rows - rows.mean()
        for share, change in self._of_rows(frames, rows, turned):
            if not share.any():
                continue
            own = share - share.mean()
            along = np.sum(change * turned, axis=1, keepdims=True) / size * turned
            straight = own - even * (even @ own) / (even @ even) if frames.vectors_free else own
            yield straight, along
            yield own, change - along

    def _of_rows(self, frames: FittedFrames, rows: F64, turned: F64) -> Iterator[tuple[F64, F64]]:
        g = frames.g
        if self.line_time_us > 0 and frames.exptime_s > 0:
            after, before = self.shares(rows, frames.exptime_s, frames.period_s)
            yield after, np.append(g[1:] - g[:-1], np.zeros((1, 3)), axis=0)
            yield before, np.append(np.zeros((1, 3)), g[:-1] - g[1:], axis=0)
        if any(self.settling):
            phi = np.arctan2(g[:, 2], g[:, 1])
            step = steps_of(phi, -1 if self.of_step == "last" else 1, self.origin_rad)
            yield profile(self.settling, rows / max(frames.rows[1] - 1, 1)), step[:, None] * turned

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Share of the next frame's model in the residuals, growing with the row."""
        many = [RowSums.of(f) for f in evidence.fringes.values() if enough_frames(f)]
        if not many:
            return None
        sets = [sums for sums in many if sums.fringes.exptime_s > 0]  # false if unknown (NaN)
        settled = find_settling(many)
        which = "from the previous" if settled.way < 0 else "to the next"
        law = "phase error of the rows in proportion to the phase step, with any profile"
        effect = cls(
            0.0,
            settling=tuple(float(v) for v in np.clip(settled.share, -1, 1)),
            of_step="last" if settled.way < 0 else "next",
            origin_rad=settled.origin_rad,
        )
        settling = Estimate(
            effect,
            {f"settling[{n}]": float(e) for n, e in enumerate(settled.error)},
            settled.significance,
            f"the phase of the rows depends on the step {which} frame",
            law=law,
            again=Again(effect, partial(_settling_again, settled.way, settled.origin_rad)),
        )
        mixed = cls._mixed(sets) if sets else settling
        return max(mixed, settling, key=lambda e: e.significance)

    @classmethod
    def _mixed(cls, sets: list[RowSums]) -> Estimate:
        """From light of two frames in the exposure of a row."""
        sums = [RowRamp.of(sets, way) for way in (1, -1)]
        following, last = (s.slope / s.error for s in sums)
        ramp, fringes = sums[int(last > max(following, 4.0))], sets[0].fringes
        per_row = fringes.exptime_s * 1e6
        period = float(np.median(np.diff(fringes.time_s)))
        late = max(period - fringes.exptime_s, 0.0) * 1e6 if ramp.way < 0 else 0.0
        line = max(ramp.slope, 0.0) * per_row
        error = float(np.hypot(ramp.error * per_row, _MODEL * line))
        return Estimate(
            cls(min(line, 1e5), line * ramp.knee + late),
            {
                "line_time_us": error,
                "delay_us": max(line, error) * ramp.knee_error + error * ramp.knee,
            },
            float(ramp.slope / ramp.error),
            f"light of the {'next' if ramp.way > 0 else 'previous'} frame in the residuals, by row",
            law="rows exposed one after the other",
        )


def _settling_again(way: int, origin: float | None, evidence: Evidence) -> float | None:
    """Significance of a settling profile with the same steps in other frames."""
    many = [RowSums.of(f) for f in evidence.fringes.values() if enough_frames(f)]
    return settling_sigmas(many, way, origin) if many else None
