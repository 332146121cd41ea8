"""Charge that stays behind in the pixel and comes out with later frames."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from pixcal.estimators.detector.frame_lag import (
    CLEAR,
    MAX_DECAY,
    LagNonuniformity,
    common_lag,
    lag_of_flats,
    seen_share,
)
from pixcal.estimators.detector.lag_by_level import BANDS, by_level, in_bands
from pixcal.estimators.detector.noiseless_charge import missing_noise
from pixcal.estimators.detector.persistence import LONGEST, persistence
from pixcal.estimators.diagnosis.central_crop import central_crop
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.kernels.charge_release import fill_traps, left_behind, released_by_frame
from pixcal.kernels.scene import TILE, Rows, chip_map
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_best
from pixcal.model.arrays import F32, F64
from pixcal.model.bench import Bench, SimulatedDetector
from pixcal.model.config import quantity
from pixcal.model.errors import InputError
from pixcal.simulation.effect import NONZERO, Effect, Estimate, Stage
from pixcal.simulation.memory import Memory
from pixcal.simulation.shot import Shot

TAIL = 1e-4  # share of the charge left whose release is neglected
MOST_BACK = 256  # preceding frames that count if the release follows seconds
_TELL_LAMP = 3  # fewest flats per level to distinguish a warming lamp from lag


@dataclass(frozen=True)
class Lag(Effect):
    """Part of the charge of a frame appears in later frames.

    Before the first frame of a recording the pixels were empty, or held what earlier recordings
    left (`carried`). The share may depend on the level (bands), as behind a barrier; traps take
    charge until they are full (`capacity_e`). Maps do not show it, because the previous frame is a
    sum of the same maps. `lost` takes the release by frames (`decay_frames`, `later`), not by
    `decay_s`.
    """

    name = "lag"
    title = "charge released in later frames"
    acts_at = Stage.CHARGE
    order = 3
    domains = ("time", "intensity")
    strengths = ("share",)
    absorbed_because = (
        "the fit absorbs a uniform lag; its variation shifts phases by hundredths of the "
        "Cramér-Rao bound"
    )
    optional_parameters = ("decay_frames", "spread", "quiet", "carried", "decay_s", "slow_part")
    frames_needed = ("random",)
    remedy = (
        "fix on the bench: flush the sensor, or discard the first frame after a change of light"
    )
    quick = False
    sources = (
        "Bonjour, Blanc and Kayal 2012, IEEE Electron Device Letters 33(12), 1735: lag of pinned "
        "photodiodes by barriers, pockets and traps of the transfer gate",
        "Fossum and Hondongwa 2014, IEEE J. Electron Devices Soc. 2(3), 33: review of the pinned "
        "photodiode; lag of a few per mille and below",
    )

    share: float = quantity(
        0.002, low=0, high=0.5, doc="share of the charge of a frame that appears in later frames"
    )
    decay_frames: float = quantity(
        0.0,
        unit="frames",
        low=0,
        high=LONGEST,
        doc="frames in which the release falls by a factor e; 0: all in the next frame",
    )
    spread: float = quantity(
        0.1, low=0, high=1, doc="relative rms of the share from pixel to pixel"
    )

    bands: tuple[float, ...] = quantity(
        (),
        low=0,
        high=100,
        doc="factors of the share at signals from 0, 1/8, 1/4 and 1/2 of "
        "level_e on; empty: the same share at all signals",
    )
    level_e: float = quantity(
        50_000.0, unit="e-", above=0, high=1e7, doc="signal that bands refers to"
    )
    later: tuple[float, ...] = quantity(
        (),
        low=0,
        high=1,
        doc="parts of the lagging charge that appear 1, 2, ... frames later; "
        "empty: an exponential decay over decay_frames",
    )
    quiet: float = quantity(
        0.0, low=0, high=1, doc="part of the released charge without shot noise of its own"
    )
    capacity_e: float = quantity(
        0.0,
        unit="e-",
        low=0,
        high=1e7,
        doc="largest charge that a pixel holds back, released over decay_frames; 0: no limit",
    )

    carried: float = quantity(
        0.0,
        low=0,
        high=1,
        doc="part of the charge left by the last frame before a recording that "
        "is still there when it begins; 0: the detector is cleared",
    )
    decay_s: float = quantity(
        0.0,
        unit="s",
        low=0,
        high=1e6,
        doc="time in which the release falls by a factor e, in place of decay_frames and later; "
        "0: the release follows the number of frames",
    )
    slow_part: float = quantity(
        0.0, low=0, high=1, doc="part of the share that is released over slow_s, not decay_s"
    )
    slow_s: float = quantity(
        0.0,
        unit="s",
        low=0,
        high=1e6,
        doc="time in which the release of slow_part falls by a factor e",
    )

    @property
    def releases(self) -> F64:
        """Shares of the charge left that appear 1, 2, ... frames later; their sum is one."""
        if self._by_frame:
            return np.array(self.later) / sum(self.later)
        count = int(np.ceil(np.log(TAIL) / np.log(self._keep))) if self._keep else 1
        releases = (1 - self._keep) * self._keep ** np.arange(count, dtype=float)
        return np.asarray(releases / releases.sum())

    @property
    def memory(self) -> Memory:
        """As in `ForwardModel.memory`."""
        fades = bool(self.decay_s) or (bool(self._keep) and not self._by_frame)
        frames = MOST_BACK if self.decay_s else len(self.releases)
        return Memory(frames, fades, cleared=not self.carried)

    @property
    def _by_frame(self) -> bool:
        """Whether each of the next frames gets a part of its own."""
        return sum(self.later) > 0 and not (self.capacity_e or self.decay_s)

    @property
    def _keep(self) -> float:
        """Share of the held charge that stays for another frame."""
        return float(np.exp(-1 / self.decay_frames)) if self.decay_frames else 0.0

    def check(self, bench: Bench) -> None:
        """As in `ForwardModel.check`; traps of limited capacity release by frames, slow by time."""
        if self.capacity_e and self.decay_s:
            raise InputError(
                "lag.decay_s: with capacity_e, the release follows frames; give decay_frames "
                "instead, or remove capacity_e"
            )
        if self.slow_part and not (self.decay_s and self.slow_s):
            raise InputError("lag.slow_part: needs decay_s and slow_s; give both, or remove it")

    def carry(self, charge: F32, state: F32 | None, shot: Shot) -> tuple[F32, F32]:
        """As in `ForwardModel.carry`; the state (part, y, x) is the charge held, e-.

        One part for each kind of traps, or what each of the frames before left, from the last on.
        """
        releases = self.releases if self._by_frame else 1 - self._kept(shot)
        held = np.zeros((len(releases), *charge.shape), np.float32) if state is None else state
        if state is not None and shot.frame == 0:
            held = self._since_last(shot)[:, None, None] * held
        left = self._left_behind(charge, shot)
        stays = self._left_behind(charge, shot, 1 - self.quiet) if self.quiet else left
        if self._by_frame:
            released = self._released(held, releases, shot)
            return charge - left + released, np.concatenate([stays[None], held[:-1]])
        each = [self._released(held[n, None], r, shot, n) for n, r in enumerate(releases[:, None])]
        rest = held - np.stack(each)
        if self.capacity_e:
            room = _shares(self, shot.bench.detector, shot.rows) / np.float32(self.share)
            room = np.maximum(room * np.float32(self.capacity_e) - rest[0], 0)
            left, stays = np.minimum(left, room), np.minimum(stays, room)
        parts = np.array([1 - self.slow_part, self.slow_part][: len(each)], np.float32)
        return charge - left + sum(each), rest + parts[:, None, None] * stays

    @property
    def _decays_s(self) -> F64:
        """Time constants (n,) of the kinds of traps, s; empty where these release by frames."""
        every = [self.decay_s, self.slow_s] if self.slow_part else [self.decay_s]
        return np.array(every if self.decay_s else [])

    def _kept(self, shot: Shot) -> F64:
        """Share (n,) of the charge held by each kind of traps that a frame does not release."""
        if not self.decay_s:
            return np.array([self._keep])
        return np.asarray(np.exp((shot.time_s - shot.end_of(shot.frame)) / self._decays_s))

    def _since_last(self, shot: Shot) -> F32:
        """Share (n,) of the held charge that is left when a recording begins."""
        if not self.decay_s:
            return np.array([self.carried], np.float32)
        pause = max(shot.time_s - shot.end_of(-1), 0.0)
        return (self.carried * np.exp(-pause / self._decays_s)).astype(np.float32)

    def _released(self, held: F32, releases: F64, shot: Shot, kind: int = 0) -> F32:
        """Charge (y, x) that a frame gets from traps; each electron is released by chance."""
        released: F32 = np.zeros_like(held[0])
        drawn = np.zeros_like(released)
        for release, part in zip(releases, held, strict=True):
            released += np.float32(release) * part
            drawn += np.float32(release * (1 - release)) * part
        if shot.bench.shot_noise and self.quiet < 1 and drawn.any():
            normals = shot.normals(f"{self.name} {'slow ' * kind}release")
            released += np.sqrt(np.float32(1 - self.quiet) * np.maximum(drawn, 0)) * normals
        return released

    def lost(self, charge: F32) -> tuple[F32, F32]:
        """Mean net loss of frames, and charge released from earlier ones; both (t, ...), e-.

        ``charge``: (t, ...) e-, in the order of time without gaps; the first one after darkness.
        """
        taken = self._left(charge)
        if self._by_frame:
            return released_by_frame(taken, self.releases)
        return fill_traps(taken, self._keep, self.capacity_e or np.inf)

    def _left_behind(self, charge: F32, shot: Shot, noisy: float = 1.0) -> F32:
        """Electrons of a frame that stay, each independently, so that noise stays white."""
        share = _shares(self, shot.bench.detector, shot.rows)
        noise = np.zeros_like(charge)
        if shot.bench.shot_noise and noisy > 0:
            noise = shot.normals(self.name) * np.float32(np.sqrt(noisy))
        return left_behind(charge, share, *_bands(self), noise)

    def _left(self, charge: F32) -> F32:
        """Mean charge left behind, e-."""
        share = np.float32(self.share)
        if not self.bands:
            return share * charge
        parts = in_bands(charge, self.level_e)
        return np.asarray(
            share * sum(np.float32(w) * p for w, p in zip(self.bands, parts, strict=True))
        )

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """From the contrast of frames against the phase step, and from pixels that differ.

        Charge left behind lowers the contrast by ``share (1 - cos step)``. Pixels with a share
        unlike the rest have the previous frame in their residuals; the next frame is the control.
        Without fringes, the level of darks after light or else the first flat of each level is
        used.
        """
        if not evidence.fringes:
            return cls._without_fringes(evidence)
        fringes = tuple(evidence.fringes.values())
        common = common_lag([f.free[:, :3] for f in fringes], [f.frame for f in fringes])
        if common is None:
            return None
        part = central_crop(evidence)
        uneven = LagNonuniformity.of(part.fringes.values())
        sure, unalike = common.sigmas > CLEAR, uneven.sigmas > CLEAR
        rms = uneven.rms(common.keep, common.share) if unalike else 0.0
        missed = float(np.mean([common.share - seen_share(f, common.share, rms) for f in fringes]))
        # The common share is at least as large as the scatter of the pixels' shares.
        share = float(np.clip(common.share + missed, rms, 0.5))
        pixels = min(int(f.good.sum()) for f in fringes)
        common = replace(common, share_error=float(np.hypot(common.share_error, rms / pixels**0.5)))
        spread, spread_error = uneven.spread(common.keep, share, common.share_error)
        level_e = max(float(np.nanquantile(f.electrons[::7], 0.99)) for f in fringes)
        whole = cls(share, common.decay_frames, 0.0, (), level_e, common.later)
        values, of_level = by_level(part, common, share, level_e) if sure else ({}, {})
        whole = replace(whole, **values)
        quiet, quiet_error = _quiet(part, whole) if sure else (0.0, 1.0)
        decay = whole.decay_frames if whole.capacity_e else min(common.decay_frames, MAX_DECAY)
        return _estimate(
            replace(whole, decay_frames=decay, spread=min(spread, 1.0), quiet=quiet),
            {
                "share": common.share_error,
                "decay_frames": common.decay_error,
                "spread": min(spread_error, 1.0),
                "quiet": quiet_error,
            }
            | of_level,
            sigmas_of_best(common.sigmas, uneven.sigmas),
            "the contrast falls with the phase step from the previous frame"
            + (", unevenly from pixel to pixel" if unalike else ""),
        )

    @classmethod
    def _without_fringes(cls, evidence: Evidence) -> Estimate | None:
        """From the level of darks after light, or else from the first flat of each level."""
        if (slow := persistence(evidence)) is not None:
            frames, seconds = (0.0, slow.decay) if slow.in_seconds else (slow.decay, 0.0)
            share = float(np.clip(slow.share, 0, 0.5))
            name = "decay_s" if slow.in_seconds else "decay_frames"
            errors = {"share": slow.share_error, name: slow.decay_error}
            if slow.slow_part:
                errors |= {"slow_part": slow.slow_part_error, "slow_s": slow.slow_error}
            traps = cls(share, frames, 0.0, carried=1.0, decay_s=seconds)
            return _estimate(
                replace(traps, slow_part=slow.slow_part, slow_s=slow.slow),
                errors,
                slow.share / slow.share_error,
                "the dark level decays after exposure to light",
            )
        of_flats = lag_of_flats(evidence)
        if of_flats is None:
            return None
        share, error, carried = of_flats
        found = _estimate(
            cls(float(np.clip(share, 0, 0.5)), spread=0.0, carried=carried),
            {"share": error},
            share / error,
            "the first flat of each level is fainter, as after charge of the frame before",
        )
        if carried or found.significance < SIGNIFICANT:
            return found
        pairs = all(len(s.adu) < _TELL_LAMP for s in evidence.ladder)
        # Charge that no frame gets back is not known to stay behind.
        return replace(
            found,
            refused="the first flat of each level is fainter, whatever the frame before, as with a "
            "slow shutter or a warming lamp; take darks at once after flats"
            + (", and three flats per level" if pairs else ""),
        )


def _estimate(lag: Lag, errors: dict[str, float], sigmas: float, why: str) -> Estimate:
    """An estimate whose size states the share and, where known, the decay."""
    of, decays = "of the signal", {"decay_s": (lag.decay_s, "s")}
    if not lag.later:
        decays["decay_frames"] = lag.decay_frames, "frames"
    for name, (decay, unit) in decays.items():
        if decay > NONZERO * errors.get(name, np.inf):
            of += f", decays over {float(f'{decay:.2g}'):g} {unit}"
    if lag.slow_part:
        of += f" and, {100 * lag.slow_part:.2g} % of it, {float(f'{lag.slow_s:.2g}'):g} s"
    size = {"value": lag.share, "error": errors["share"], "unit": "", "of": of}
    return Estimate(lag, errors, sigmas, why, size=size if lag.share else {})


@lru_cache(maxsize=4)
def _bands(lag: Lag) -> tuple[F32, F32]:
    """Lower ends of bands of the charge, e-, and the share in each over the mean share."""
    weights = lag.bands or (1.0,)
    begins = np.array(BANDS[: len(weights)], np.float32) * np.float32(lag.level_e)
    return begins, np.array(weights, np.float32)


@lru_cache(maxsize=4)
def _pixels(detector: SimulatedDetector, rows: Rows) -> F32:
    """Standard normals of the chip's pixels on given rows."""
    return chip_map(detector, rows, Lag.name, lambda rng: rng.standard_normal(TILE))


@lru_cache(maxsize=4)
def _shares(lag: Lag, detector: SimulatedDetector, rows: Rows) -> F32:
    """Share (y, x) that stays behind in each pixel."""
    ny, nx = rows[1] - rows[0], detector.shape[1]
    share = np.full((ny, nx), lag.share, np.float32)
    if lag.spread:
        share *= np.clip(1 + np.float32(lag.spread) * _pixels(detector, rows), 0, 1 / lag.share)
    return share


def _quiet(evidence: Evidence, lag: Lag) -> tuple[float, float]:
    """Share of the released charge without shot noise, and its error; zero if insignificant."""

    def comes_out(_: FringeEvidence, signal: F32) -> F32:
        return lag.lost(signal)[1]

    part, error = missing_noise(evidence, comes_out)
    return float(np.clip(part, 0, 1)) if part > CLEAR * error else 0.0, min(error, 1.0)
