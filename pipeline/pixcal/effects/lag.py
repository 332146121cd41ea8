"""Charge that stays behind in the pixel and comes out with later frames."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from pixcal.estimators.detector.first_flats import lag_of_flats
from pixcal.estimators.detector.frame_lag import MAX_DECAY, LagNonuniformity, common_lag, seen_share
from pixcal.estimators.detector.lag_by_level import loss_by_level
from pixcal.estimators.detector.noiseless_charge import missing_noise
from pixcal.estimators.detector.persistence import LONGEST, persistence
from pixcal.estimators.diagnosis.central_crop import central_crop
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.kernels import charge_release
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
_LARGEST = 100.0  # factor of the share in a band
_DECAY_OF_TRAPS = 0.15, MAX_DECAY  # that frames can measure
_TELL_LAMP = 3  # fewest flats per level to distinguish a warming lamp from lag


Measured = dict[str, tuple[float, float]]  # parameters with their errors


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

    share: float = quantity(0.002, low=0, high=0.5)
    """share of the charge of a frame that appears in later frames"""
    decay_frames: float = quantity(0.0, unit="frames", low=0, high=LONGEST)
    """frames in which the release falls by a factor e; 0: all in the next frame"""
    spread: float = quantity(0.1, low=0, high=1)
    """relative rms of the share from pixel to pixel"""

    bands: tuple[float, ...] = quantity((), low=0, high=100)
    """factors of the share at signals from 0, 1/8, 1/4 and 1/2 of level_e on; empty: the same share
    at all signals"""
    level_e: float = quantity(50_000.0, unit="e-", above=0, high=1e7)
    """signal that bands refers to"""
    later: tuple[float, ...] = quantity((), low=0, high=1)
    """parts of the lagging charge that appear 1, 2, ... frames later; empty: an exponential decay
    over decay_frames"""
    quiet: float = quantity(0.0, low=0, high=1)
    """part of the released charge without shot noise of its own"""
    capacity_e: float = quantity(0.0, unit="e-", low=0, high=1e7)
    """largest charge that a pixel holds back, released over decay_frames; 0: no limit"""

    carried: float = quantity(0.0, low=0, high=1)
    """part of the charge left by the last frame before a recording that is still there when it
    begins; 0: the detector is cleared"""
    decay_s: float = quantity(0.0, unit="s", low=0, high=1e6)
    """time in which the release falls by a factor e, in place of decay_frames and later; 0: the
    release follows the number of frames"""
    slow_part: float = quantity(0.0, low=0, high=1)
    """part of the share that is released over slow_s, not decay_s"""
    slow_s: float = quantity(0.0, unit="s", low=0, high=1e6)
    """time in which the release of slow_part falls by a factor e"""

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
        kept = self._kept(shot.end_of(shot.frame) - shot.time_s)
        releases = self.releases if self._by_frame else 1 - kept
        held = np.zeros((len(releases), *charge.shape), np.float32) if state is None else state
        if state is not None and shot.frame == 0:
            since = self._kept(max(shot.time_s - shot.end_of(-1), 0.0)) if self.decay_s else [1.0]
            held = (self.carried * np.array(since, np.float32))[:, None, None] * held
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

    def _kept(self, seconds: float) -> F64:
        """Share (n,) of the charge held by each kind of traps that a time, or a frame, leaves."""
        if not self.decay_s:
            return np.array([self._keep])
        decays = [self.decay_s, self.slow_s][: 1 + bool(self.slow_part)]
        return np.asarray(np.exp(-seconds / np.array(decays)))

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
        taken = self._left(charge, np.float32(self.share))
        if self._by_frame:
            return charge_release.released_by_frame(taken, self.releases)
        return charge_release.fill_traps(taken, self._keep, self.capacity_e or np.inf)

    def _left_behind(self, charge: F32, shot: Shot, noisy: float = 1.0) -> F32:
        """Electrons of a frame that stay, each independently, so that noise stays white."""
        share = _shares(self, shot.bench.detector, shot.rows)
        noise = np.zeros_like(charge)
        if shot.bench.shot_noise and noisy > 0:
            noise = shot.normals(self.name) * np.float32(np.sqrt(noisy))
        return charge_release.left_behind(charge, self._left(charge, share), share, noise)

    def _left(self, charge: F32, share: F32 | np.float32) -> F32:
        """Mean charge left behind, e-; ``share``: of the pixels, or of all."""
        if not self.bands:
            return np.asarray(share * charge)
        parts = charge_release.in_bands(charge, self.level_e, len(self.bands))
        every = (np.float32(w) * part for w, part in zip(self.bands, parts, strict=True))
        return np.asarray(share * sum(every))

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
        sure, unalike = common.sigmas > SIGNIFICANT, uneven.sigmas > SIGNIFICANT
        rms = uneven.rms(common.keep, common.share) if unalike else 0.0
        missed = float(np.mean([common.share - seen_share(f, common.share, rms) for f in fringes]))
        # The common share is at least as large as the scatter of the pixels' shares.
        share = float(np.clip(common.share + missed, rms, 0.5))
        of_share = float(
            np.hypot(common.share_error, rms / min(f.good.sum() for f in fringes) ** 0.5)
        )
        decay, of_decay = common.decay
        measured = {"share": (share, of_share), "decay_frames": (min(decay, MAX_DECAY), of_decay)}
        spread, of_spread = uneven.spread(common.keep, share, of_share)
        measured["spread"] = min(spread, 1.0), min(of_spread, 1.0)
        level_e = max(float(np.nanquantile(f.electrons[::7], 0.99)) for f in fringes)
        whole = cls(share, decay, 0.0, (), level_e, common.later)
        if sure:
            whole, of_level = whole._by_level(part)
            measured |= of_level
        # Full traps take back what they released, with its noise: the noise tells nothing.
        told = sure and not whole.capacity_e
        measured["quiet"] = _quiet(part, whole) if told else (0.0, 1.0)
        why = "the contrast falls with the phase step from the previous frame"
        why += ", unevenly from pixel to pixel" if unalike else ""
        return _estimate(whole, measured, sigmas_of_best(common.sigmas, uneven.sigmas), why)

    def _by_level(self, evidence: Evidence) -> tuple["Lag", Measured]:
        """With a share that depends on the level, or that traps limit; the parameters of either."""

        def lag(values: F64) -> Lag:
            alone = len(values) == len(charge_release.BANDS)
            *shares, decay, capacity = (*values, 0.0, 0.0) if alone else values
            share = self.share if alone else min(float(shares[0]), 0.5)
            bands = np.clip(np.array(shares) / share, 0, _LARGEST) if len(shares) > 1 else ()
            whole = replace(self, share=share, bands=tuple(map(float, bands)))
            if alone:
                return whole
            decay = float(np.clip(decay, *_DECAY_OF_TRAPS))
            return replace(whole, decay_frames=decay, capacity_e=float(capacity), later=())

        lost, scale = (lambda v, q: lag(v).lost(q)[0]), (self.share, self.level_e)
        found = loss_by_level(evidence, lost, *scale, self.releases.tolist())
        if found is None:
            return self, {}
        whole, errors = lag(found.value), found.errors.tolist()
        pairs = zip(whole.bands, (found.errors / whole.share).tolist(), strict=False)
        measured = {f"bands[{n}]": pair for n, pair in enumerate(pairs)}
        if whole.capacity_e:
            for name, error in zip(
                ("share", "decay_frames", "capacity_e"), (errors[0], *errors[-2:]), strict=True
            ):
                measured[name] = getattr(whole, name), error
        return whole, measured

    @classmethod
    def _without_fringes(cls, evidence: Evidence) -> Estimate | None:
        """From the level of darks after light, or else from the first flat of each level."""
        if (slow := persistence(evidence)) is not None:
            measured = {
                "share": (float(np.clip(slow.share, 0, 0.5)), slow.share_error),
                "decay_s" if slow.in_seconds else "decay_frames": (slow.decay, slow.decay_error),
            }
            if slow.slow_part:
                measured["slow_part"] = slow.slow_part, slow.slow_part_error
                measured["slow_s"] = slow.slow, slow.slow_error
            why = "the dark level decays after exposure to light"
            traps = cls(spread=0.0, carried=1.0)
            return _estimate(traps, measured, slow.share / slow.share_error, why)
        of_flats = lag_of_flats(evidence)
        if of_flats is None:
            return None
        share, error, carried = of_flats
        why = "the first flat of each level is fainter, as after charge of the frame before"
        measured = {"share": (float(np.clip(share, 0, 0.5)), error)}
        found = _estimate(cls(spread=0.0, carried=carried), measured, share / error, why)
        if carried or found.significance < SIGNIFICANT:
            return found
        pairs = all(len(s.adu) < _TELL_LAMP for s in evidence.ladder)
        # Charge that no frame gets back is not known to stay behind.
        refused = "the first flat of each level is fainter, whatever the frame before, as with a "
        refused += "slow shutter or a warming lamp; take darks at once after flats"
        return replace(found, refused=refused + (", and three flats per level" if pairs else ""))


def _estimate(lag: Lag, measured: Measured, sigmas: float, why: str) -> Estimate:
    """An estimate whose size states the share and, where known, the decay."""
    errors = {name: error for name, (_, error) in measured.items()}
    own: dict[str, Any] = {name: v for name, (v, _) in measured.items() if hasattr(lag, name)}
    lag = replace(lag, **own)
    of, decays = "of the signal", {"decay_s": "s", "decay_frames": "frames"}
    for name, unit in decays.items():
        decay = 0.0 if name == "decay_frames" and lag.later else getattr(lag, name)
        if decay > NONZERO * errors.get(name, np.inf):
            of += f", decays over {float(f'{decay:.2g}'):g} {unit}"
    if lag.slow_part:
        of += f" and, {100 * lag.slow_part:.2g} % of it, {float(f'{lag.slow_s:.2g}'):g} s"
    size = {"value": lag.share, "error": errors["share"], "unit": "", "of": of}
    return Estimate(lag, errors, sigmas, why, size=size if lag.share else {})


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
    return float(np.clip(part, 0, 1)) if part > SIGNIFICANT * error else 0.0, min(error, 1.0)
