"""Particles that leave their charge in one frame: muons, and electrons of radioactive decay."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.optimize import brentq
from scipy.special import ndtr

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_count
from pixcal.kernels.tracks import add_tracks, draw_tracks
from pixcal.model.arrays import F32, F64, Indices, Mask
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

MARGIN_PX = 16  # how far beside the window tracks may begin
THRESHOLD = 6.5  # standard deviations of the noise from which a sample is an outlier
JOINED = 3.0  # standard deviations from which samples join outliers that lie near each other
Samples = tuple[Indices, Indices, Indices]

_STRAGGLING = 0.15
_DRAWN = 4000
_TILE = 32
_MIN_FRAMES = 5
_MIN_HITS = 5
_OFTEN = 2
_RARE = 0.01
_BRIGHTEST = 16
# outliers of the noise itself over those of a Gaussian: shot noise of faint light is skewed
_SKEW = 5.0
_STEPS = 300  # of the maximisation
_FEWEST = 1e-6


@dataclass(frozen=True)
class CosmicHits(Effect):
    """Straight tracks of particles through the sensitive layer, in proportion to the exposure time.

    While a frame waits to be read out it is hit as well: bias frames of a large, slow detector are.

    A track leaves charge in proportion to its length, with the fluctuations of thin layers, and the
    charge spreads before it is collected. Nothing of it is constant in time, so maps of the fit
    neither show it nor can be mended; the samples that are hit have to be left out.
    """

    name = "cosmic_hits"
    title = "hits by cosmic-ray particles"
    acts_at = Stage.CHARGE
    order = 2
    domains = ("noise",)
    strengths = ("rate_cm2_s", "readout_cm2")
    left_because = "few samples are hit, and most of them are masked"
    frames_needed = ("dark",)
    sources = (
        "Particle Data Group, Review of Particle Physics, Cosmic Rays: about one muon per cm^2 and "
        "minute through a horizontal detector at sea level",
        "Groom 2002, Experimental Astronomy 14, 45: Compton electrons of radioactive decay hit "
        "astronomical CCDs as often as muons",
        "Bichsel 1988, Rev. Mod. Phys. 60, 663: energy loss and its fluctuations in thin silicon",
        "Moyal 1955, Phil. Mag. 46, 263: closed form of the distribution of the energy loss",
    )

    rate_cm2_s: float = quantity(
        0.03, unit="/(cm² s)", low=0, high=1e7, doc="flux of particles through the detector"
    )
    readout_cm2: float = quantity(
        0.0, unit="/cm²", low=0, high=1e7, doc="hits in each frame beside the exposure, while it "
        "is read out"
    )  # fmt: skip
    electrons_per_um: float = quantity(
        70.0, unit="e-/um", above=0, high=1e4, doc="most probable charge per length of track"
    )
    thickness_um: float = quantity(
        8.0, unit="um", above=0, high=1e3, doc="thickness of the sensitive layer"
    )
    diffusion_um: float = quantity(
        1.5, unit="um", above=0, high=100, doc="rms width of the charge cloud at collection"
    )

    def charge(self, charge: F32, shot: Shot) -> F32:
        detector = shot.bench.detector
        pitch = detector.pitch_um
        area = np.prod([(n + 2 * MARGIN_PX) * pitch * 1e-4 for n in detector.shape])
        recording = shot.recording
        rng = recording.pixel_rng(self.name, shot.frame)
        # Where no exposure time is known, frames with light last as long as they are apart.
        seconds = recording.exptime_s or (recording.period_s if recording.kind != "bias" else 0.0)
        count = int(rng.poisson((self.rate_cm2_s * seconds + self.readout_cm2) * area))
        if not count:
            return charge
        found = charge.copy()
        tracks = self.tracks(rng, count, pitch, detector.shape)
        add_tracks(found, tracks, self.diffusion_um / pitch, shot.rows[0])
        full = np.inf if detector.full_well_e is None else detector.full_well_e
        return np.minimum(found, np.float32(full))

    def tracks(
        self, rng: np.random.Generator, count: int, pitch_um: float, shape: tuple[int, int],
        margin_px: int = MARGIN_PX,
    ) -> F64:  # fmt: skip
        """Draw tracks as `pixcal.kernels.tracks.draw_tracks` does, for pixels of some pitch."""
        depth, electrons_per_px = self.thickness_um / pitch_um, self.electrons_per_um * pitch_um
        return draw_tracks(rng, count, shape, margin_px, depth, electrons_per_px, _STRAGGLING)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Outliers upwards in single frames, less those downwards, beside all light.

        A pixel that does it again is not hit but noisy, and does not count. Tracks are drawn to
        know how many stay below the noise. Frames of several exposure times, bias frames among
        them, tell hits while they are read out.
        """
        searches = list(_searches(evidence))
        if not any(s.seconds > 0 for s in searches):
            return None
        drawn = _Drawn(cls(), evidence.pitch_um)
        places = [drawn.noise_at(s.sigma) for s in searches]
        scale, scale_error = _scale(searches, places, drawn)
        seen = [
            s.area * len(drawn.peaks(scale, own, s.limit)) / _DRAWN
            for s, own in zip(searches, places, strict=True)
        ]
        exposures = np.array([(a * s.seconds, a) for a, s in zip(seen, searches, strict=True)]).T
        if not exposures[0].sum() > 0:
            return None
        chances = np.array([
            max(_SKEW * s.samples * float(ndtr(-THRESHOLD)), s.downwards) for s in searches
        ])  # fmt: skip
        counts = np.array([float(len(s.peaks)) for s in searches])
        values, spread = _rates(counts, exposures, chances)
        default = cls().electrons_per_um
        errors = dict(zip(cls.strengths, spread, strict=False))
        if scale_error is not None:
            errors["electrons_per_um"] = default * scale_error
        count, chance = int(counts.sum()), float(chances.sum())
        return Estimate(
            cls(values[0], values[1], default * scale),
            errors,
            sigmas_of_count(count, chance),
            "samples in single frames far above the pixel's other frames",
            {"hits": count, "expected_by_chance": chance, "seen_cm2_s": float(exposures[0].sum())},
        )


def _rates(counts: F64, exposures: F64, chances: F64) -> tuple[list[float], list[float]]:
    """Hits per exposure of both kinds, and errors; the second is zero unless it is significant.

    ``counts, chances``: (n,) hits, and how many of them are none; ``exposures``: (2, n).
    """
    found: list[tuple[F64, F64]] = []
    for own in (exposures[:1], exposures):
        # Maximum of the likelihood of Poisson counts, by expectation and maximisation.
        total = own.sum(axis=1)
        rates = counts.sum() / total / len(own)
        for _ in range(_STEPS):
            rates = rates * (own @ (counts / np.maximum(rates @ own + chances, _FEWEST))) / total
        found.append((rates, np.maximum(rates @ own + chances, _FEWEST)))
    (_, one), (_, both) = found
    gain = 2 * float((counts * np.log(both / one) - both + one).sum())
    used = 1 + (gain > SIGNIFICANT**2)
    rates, expected = found[used - 1]
    # One hit at least: none leaves the rate unknown too.
    normal = exposures[:used] @ (exposures[:used] / np.maximum(expected, 1 / len(counts))).T
    errors = np.sqrt(np.diag(np.linalg.inv(normal)))
    return [*rates.tolist(), 0.0][:2], errors.tolist()


@dataclass(frozen=True)
class _Search:
    """Outliers of a sequence of frames."""

    seconds: float  # exposure time, s
    area: float  # of all samples, cm²
    samples: int
    limit: float  # from how many sigmas on a sample is an outlier
    peaks: F64  # (hit,) brightest outlier of each hit upwards, e-
    downwards: int  # hits downwards
    sigma: F32  # (t, y, x) noise of the samples, e-; NaN where they do not count


def _searches(evidence: Evidence) -> Iterator[_Search]:
    area = (evidence.pitch_um * 1e-4) ** 2
    for f in evidence.fringes.values():
        # As in `CosmicHits.charge`.
        seconds = f.exptime_s if f.exptime_s > 0 else float(np.median(np.diff(f.time_s)))
        residual = np.where(f.good, f.residual, np.nan)
        yield _search(residual, np.sqrt(f.variance), seconds, area)
    for stack in (*evidence.of_kind("bias"), *evidence.of_kind("dark")):
        if len(stack.adu) >= _MIN_FRAMES:
            yield _search(*evidence.dark_noise(stack), np.nan_to_num(stack.exptime_s), area)


def _search(residual: F32, sigma: F32, seconds: float, area: float) -> _Search:
    """Outliers of residuals (t, y, x) with some sigma; ``area`` of a pixel, cm²."""
    ratio = residual / sigma
    usable = np.isfinite(ratio)
    # Of every seventh sample: what the noise is beyond what was predicted.
    some = np.abs(ratio.ravel()[::7])
    wide = 1.4826 * float(np.nanmedian(some)) if np.isfinite(some).any() else 1.0
    limit = np.float32(THRESHOLD * max(wide, 1.0))
    up, down = ratio > limit, ratio < -limit
    often = np.count_nonzero(up | down, axis=0) > _OFTEN
    up &= ~often
    down &= ~often
    hits = _hits(up, ratio > JOINED)
    n = int(np.count_nonzero(usable))
    return _Search(
        seconds,
        area * ratio.size,
        n,
        float(limit),
        np.array([residual[hit].max() for hit in hits]),
        len(_hits(down, ratio < -JOINED)),
        np.where(usable, sigma, np.float32(np.nan)),
    )


def _hits(outliers: Mask, joined: Mask) -> list[Samples]:
    """The samples (frame, row, column) of each group of outliers that lie together in a frame.

    Fainter samples join what noise tears apart of a long track.
    """
    found = []
    for frame in np.flatnonzero(outliers.any(axis=(1, 2))):
        together = ndimage.binary_dilation(joined[frame] | outliers[frame], np.ones((3, 3)))
        labels, _ = ndimage.label(together, np.ones((3, 3)))
        rows, columns = np.nonzero(outliers[frame])
        groups = labels[rows, columns]
        for group in np.unique(groups):
            own = groups == group
            found.append((np.full(own.sum(), frame), rows[own], columns[own]))
    return found


class _Drawn:
    """The brightest pixels of tracks, which may lie anywhere in frames of any noise."""

    def __init__(self, effect: CosmicHits, pitch_um: float) -> None:
        self._rng = np.random.default_rng(0)
        tracks = effect.tracks(self._rng, _DRAWN, pitch_um, (1, 1), 0)
        tracks[:, :2] += _TILE // 2
        self._charges = np.empty((_DRAWN, _BRIGHTEST))
        self._pixels = np.empty((_DRAWN, _BRIGHTEST), int)
        for n in range(_DRAWN):
            tile = np.zeros((_TILE, _TILE), np.float32)
            add_tracks(tile, tracks[n : n + 1], effect.diffusion_um / pitch_um, 0)
            self._pixels[n] = np.argpartition(tile.ravel(), -_BRIGHTEST)[-_BRIGHTEST:]
            self._charges[n] = tile.ravel()[self._pixels[n]]
        self._noise = self._rng.standard_normal(self._charges.shape)

    def noise_at(self, sigma: F32) -> F64:
        """Noise (track, pixel) where tracks at random places of frames (t, y, x) lie; e-.

        Infinite in samples that do not count.
        """
        t, y, x = (self._rng.integers(0, n, (_DRAWN, 1)) for n in sigma.shape)
        dy, dx = np.divmod(self._pixels, _TILE)
        # A track that leaves the window comes in on the other side, as others do from beyond it.
        own = sigma[t, (y + dy) % sigma.shape[1], (x + dx) % sigma.shape[2]]
        return np.where(np.isfinite(own), own, np.inf)

    def peaks(self, scale: float, noise: F64, limit: float) -> F64:
        """Brightest outlier (e-) of each track that has one, for ``scale`` times the charge."""
        counts = np.isfinite(noise)
        sigma = np.where(counts, noise, 1.0)
        samples = scale * self._charges + sigma * self._noise
        peaks = np.where(counts & (samples > limit * sigma), samples, 0.0).max(axis=1)
        return np.asarray(peaks[peaks > 0])


def _scale(searches: list[_Search], places: list[F64], drawn: _Drawn) -> tuple[float, float | None]:
    """Charge of the hits over that of the tracks drawn, and its error (None: too few hits)."""
    hits = sum(len(s.peaks) for s in searches)
    if hits < _MIN_HITS:
        return 1.0, None

    def rank(log_scale: float) -> float:
        """Mean rank of the hits among the drawn tracks that are found, less one half."""
        total = 0.0
        for s, noise in zip(searches, places, strict=True):
            found = np.sort(drawn.peaks(np.exp(log_scale), noise, s.limit))
            # Where hardly a drawn track is found, a hit is brighter than they can explain.
            rare = len(found) < _RARE * _DRAWN
            total += len(s.peaks) if rare else np.searchsorted(found, s.peaks).sum() / len(found)
        return total / hits - 0.5

    low, high = np.log(0.05), np.log(20.0)
    if rank(low) * rank(high) >= 0:
        return 1.0, None
    found = float(brentq(rank, low, high, xtol=1e-3))
    slope = abs(rank(found + 0.2) - rank(found - 0.2)) / 0.4
    scale = float(np.exp(found))
    return scale, scale / (max(slope, 0.05) * np.sqrt(12 * hits))
