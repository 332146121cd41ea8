"""Particles that leave their charge in one frame: muons, and electrons of radioactive decay."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from pixcal.estimators.detector.hits import (
    JOINED,
    THRESHOLD,
    Hits,
    HitSearch,
    hit_counts,
    hit_rates,
    hit_searches,
    recur,
    significance_of_hits,
)
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.tracks import add_tracks, draw_tracks
from pixcal.model.arrays import F32, F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.forward import numbers
from pixcal.simulation.shot import Shot

MARGIN_PX = 16  # margin around the window where tracks may begin, px

_STRAGGLING = 0.15
# trial laws of the tracks
_LAWS = {
    "thickness_um": (2.0, 4.0, 8.0, 12.0, 16.0, 24.0, 32.0, 64.0),
    "spread": (0.0, 0.3, 0.6, 0.9, 1.2),
    "diffusion_um": (0.5, 1.0, 1.5, 2.5, 4.0),
}
_LAW_GAIN = 5.0  # gain in log-likelihood above which another law replaces the default
_AS_LIKELY = 3.0  # errors within which other laws widen the error of the rate
_SHAPED = 30  # least number of hits to choose a law
_DRAWN, _TILE = 4000, 48  # tracks drawn for a law, and side of the tile of each, px
_MIN_HITS = 5
_RARE = 0.01
_BRIGHTEST = 16
_NOISY_PIXELS = "the hits recur in the same pixels: these pixels are noisy, as with telegraph noise"


@dataclass(frozen=True)
class CosmicHits(Effect):
    """Straight tracks of particles through the sensitive layer, as many as the exposure is long."""

    name = "cosmic_hits"
    title = "hits by cosmic-ray particles"
    acts_at = Stage.CHARGE
    order = 2
    domains = ("noise",)
    strengths = ("rate_cm2_s", "readout_cm2")
    left_because = "few samples are hit, and most of them are masked"
    frames_needed = ("dark",)
    remedy = "take several frames and reject outliers"
    sources = (
        "Particle Data Group, Review of Particle Physics, Cosmic Rays: about one muon per cm^2 and "
        "minute through a horizontal detector at sea level",
        "Groom 2002, Experimental Astronomy 14, 45: Compton electrons from radioactive decay hit "
        "astronomical CCDs as often as muons",
        "Bichsel 1988, Rev. Mod. Phys. 60, 663: energy loss and its fluctuations in thin silicon",
        "Moyal 1955, Phil. Mag. 46, 263: closed form of the distribution of the energy loss",
    )

    rate_cm2_s: float = quantity(0.03, unit="/(cm² s)", low=0, high=1e7)
    """flux of particles through the detector"""
    readout_cm2: float = quantity(0.0, unit="/cm²", low=0, high=1e7)
    """hits in each frame during the readout, in addition to those of the exposure"""
    electrons_per_um: float = quantity(70.0, unit="e-/um", above=0, high=1e4)
    """most probable charge per length of track"""
    thickness_um: float = quantity(8.0, unit="um", above=0, high=1e3)
    """thickness of the sensitive layer"""
    diffusion_um: float = quantity(1.5, unit="um", above=0, high=100)
    """rms width of the charge cloud at collection"""
    spread: float = quantity(0.0, low=0, high=3)
    """standard deviation of the logarithm of the charge per length, from particle to particle"""

    def charge(self, charge: F32, shot: Shot) -> F32:
        detector = shot.bench.detector
        pitch = detector.pitch_um
        area = np.prod([(n + 2 * MARGIN_PX) * pitch * 1e-4 for n in detector.shape])
        recording = shot.recording
        rng = recording.pixel_rng(self.name, shot.frame)
        # A bias frame has no exposure, whatever its header says. Frames with light and without
        # a known exposure time are exposed for the frame period.
        seconds = 0.0 if recording.kind == "bias" else recording.exptime_s or recording.period_s
        count = int(rng.poisson((self.rate_cm2_s * seconds + self.readout_cm2) * area))
        if not count:
            return charge
        with_hits = charge.copy()
        tracks = self.tracks(rng, count, pitch, detector.shape)
        add_tracks(with_hits, tracks, self.diffusion_um / pitch, shot.rows[0])
        full = np.inf if detector.full_well_e is None else detector.full_well_e
        return np.minimum(with_hits, np.float32(full))

    def tracks(
        self,
        rng: np.random.Generator,
        count: int,
        pitch_um: float,
        shape: tuple[int, int],
        margin_px: int = MARGIN_PX,
    ) -> F64:
        """Draw tracks by `pixcal.kernels.tracks.draw_tracks`, for pixels of a given pitch."""
        depth, electrons_per_px = self.thickness_um / pitch_um, self.electrons_per_um * pitch_um
        tracks = draw_tracks(rng, count, shape, margin_px, depth, electrons_per_px, _STRAGGLING)
        if self.spread:
            tracks[:, 4] *= np.exp(self.spread * rng.standard_normal(count))
        return tracks

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Upward outliers in single frames, less downward ones, in all frames."""
        searches = list(hit_searches(evidence))
        if not searches:
            return None
        (law, _), *others = _laws(cls(), searches, evidence.pitch_um)
        fit = _fitted(law, searches, evidence.pitch_um)
        if fit is None:
            return None
        effect, errors = fit
        step: dict[str, float] = {}
        for other, apart in others:
            if (as_likely := _fitted(other, searches, evidence.pitch_um)) is not None:
                steps = _steps(effect, as_likely[0], max(apart, 1.0))
                step = max(step, steps, key=lambda one: abs(one.get("rate_cm2_s", 0.0)))
        return Estimate(
            effect,
            {n: float(np.hypot(errors.get(n, 0.0), step.get(n, 0.0))) for n in {**errors, **step}},
            significance_of_hits(searches),
            "samples in single frames far above the pixel's other frames",
            (*({n: error} for n, error in errors.items()), step) if step else (),
            refused=_NOISY_PIXELS if recur(searches) else "",
        )

    @classmethod
    def detect(cls, evidence: Evidence) -> float | None:
        """Significance of the hits, for any law of the tracks."""
        return significance_of_hits(s) if (s := list(hit_searches(evidence))) else None


class _Drawn:
    """The brightest pixels of drawn tracks, placed in the frames of searches."""

    def __init__(self, law: CosmicHits, searches: Sequence[HitSearch], pitch_um: float) -> None:
        rng, self._searches = np.random.default_rng(0), searches
        tracks = law.tracks(rng, _DRAWN, pitch_um, (1, 1), 0)
        # At the centre of a tile; longer tracks are truncated.
        tracks[:, :2] += (_TILE - tracks[:, 2:4]) / 2
        self._charges = np.zeros((_DRAWN, _BRIGHTEST))
        self._pixels = np.zeros((_DRAWN, _BRIGHTEST), int)
        for n in range(_DRAWN):
            tile = np.zeros((_TILE, _TILE), np.float32)
            add_tracks(tile, tracks[n : n + 1], law.diffusion_um / pitch_um, 0)
            lit = np.flatnonzero(tile)
            if len(lit) > _BRIGHTEST:
                lit = lit[np.argpartition(tile.flat[lit], -_BRIGHTEST)[-_BRIGHTEST:]]
            self._pixels[n, : len(lit)] = lit
            self._charges[n, : len(lit)] = tile.flat[lit]
        self._noise = rng.standard_normal(self._charges.shape)
        self._sigmas = [self._placed(s.sigma, rng) for s in searches]
        self.scale, self.scale_error = self._scaled()

    def _placed(self, sigma: F32, rng: np.random.Generator) -> F64:
        """Noise (track, pixel), e-, at random places; infinite for excluded samples."""
        t, y, x = (rng.integers(0, n, (_DRAWN, 1)) for n in sigma.shape)
        dy, dx = np.divmod(self._pixels, _TILE)
        # Periodic window: tracks that leave it replace tracks that enter from outside.
        noise = sigma[t, (y + dy) % sigma.shape[1], (x + dx) % sigma.shape[2]]
        return np.where(np.isfinite(noise), noise, np.inf)

    def hits(self, scale: float) -> list[Hits]:
        """Tracks that each search detects, for ``scale`` times the charge."""
        every = zip(self._searches, self._sigmas, strict=True)
        return [self._detected(scale, sigma, s.limit) for s, sigma in every]

    def _detected(self, scale: float, noise: F64, limit: float) -> Hits:
        counts = np.isfinite(noise)
        sigma = np.where(counts, noise, 1.0)
        samples = np.where(counts, scale * self._charges + sigma * self._noise, 0.0)
        detected = (samples > limit * sigma).any(axis=1)
        samples, pixels = samples[detected], self._pixels[detected]
        bright = samples > limit * JOINED / THRESHOLD * sigma[detected]
        at = samples.argmax(axis=1)[:, None]
        (y, x), (y0, x0) = (
            np.divmod(p, _TILE) for p in (pixels, np.take_along_axis(pixels, at, 1))
        )
        near = bright & (abs(y - y0) <= 1) & (abs(x - x0) <= 1)
        sizes = (np.count_nonzero(one, axis=1).astype(float) for one in (bright, near))
        return Hits(samples.max(axis=1, initial=0), *sizes)

    def _scaled(self) -> tuple[float, float | None]:
        """Charge of the hits over that of the tracks, and its error (None: too few hits)."""
        hits = sum(len(s.hits.peaks) for s in self._searches)
        if hits < _MIN_HITS:
            return 1.0, None

        def rank(log_scale: float) -> float:
            """Mean rank of the hits among the detected drawn tracks, minus one half."""
            total = 0.0
            for s, drawn in zip(self._searches, self.hits(np.exp(log_scale)), strict=True):
                peaks = np.sort(drawn.peaks)
                # If few drawn tracks are detected, hits are brighter than the law can explain.
                rare = len(peaks) < _RARE * _DRAWN
                ranks = np.searchsorted(peaks, s.hits.peaks)
                total += len(ranks) if rare else ranks.sum() / len(peaks)
            return total / hits - 0.5

        low, high = np.log(0.05), np.log(20.0)
        if rank(low) * rank(high) >= 0:
            return 1.0, None
        best = float(brentq(rank, low, high, xtol=1e-3))
        slope = abs(rank(best + 0.2) - rank(best - 0.2)) / 0.4
        scale = float(np.exp(best))
        return scale, scale / (max(slope, 0.05) * np.sqrt(12 * hits))

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of the classes of the hits, given those of the tracks."""
        total = 0.0
        for s, drawn in zip(self._searches, self.hits(self.scale), strict=True):
            seen, likely = (hits.classes(s.faintest) for hits in (s.hits, drawn))
            for hits, expected in zip(seen, likely, strict=True):
                # Half a track more per class, so that none has zero probability.
                share = (expected + 0.5) / (expected + 0.5).sum()
                total += float(hits @ np.log(share))
        return total


def _laws(
    start: CosmicHits, searches: list[HitSearch], pitch_um: float
) -> list[tuple[CosmicHits, float]]:
    """Laws of the tracks: the likeliest, then nearly as likely ones; distances in errors."""
    if sum(len(s.hits.peaks) for s in searches) < _SHAPED:
        return [(start, 0.0)]
    tried: dict[CosmicHits, float] = {}

    def likelihood(law: CosmicHits) -> float:
        if law not in tried:
            tried[law] = _Drawn(law, searches, pitch_um).log_likelihood
        return tried[law]

    best, before = start, -np.inf
    while likelihood(best) > before:
        before = likelihood(best)
        for name, values in _LAWS.items():
            best = max((replace(best, **{name: v}) for v in values), key=likelihood)
    if before <= likelihood(start) + _LAW_GAIN:
        return [(start, 0.0)]
    seen = [h[h > 0] for s in searches for h in s.hits.classes(s.faintest)]
    exact = sum(float(h @ np.log(h / h.sum())) for h in seen)
    chance = max(2 * (exact - before) / sum(map(len, seen)), 1.0)
    apart = {law: np.sqrt(2 * (before - likely) / chance) for law, likely in tried.items()}
    return sorted(((n, a) for n, a in apart.items() if a < _AS_LIKELY), key=lambda one: one[1])


def _fitted(
    law: CosmicHits, searches: list[HitSearch], pitch_um: float
) -> tuple[CosmicHits, dict[str, float]] | None:
    """A law with its best rates and charge, and errors; None without detection."""
    drawn = _Drawn(law, searches, pitch_um)
    every = zip(searches, drawn.hits(drawn.scale), strict=True)
    seen = [(s, s.area * len(hits.peaks) / _DRAWN) for s, hits in every]
    exposures = np.array([(area * s.seconds, area) for s, area in seen]).T
    if not exposures.sum() > 0:
        return None
    exposed = np.flatnonzero(exposures.any(axis=1))
    values, spread = hit_rates(*hit_counts(searches), exposures[exposed])
    of = [law.strengths[n] for n in exposed]
    charge = "electrons_per_um"
    errors = dict(zip(of, spread, strict=False))
    if drawn.scale_error is not None:
        errors[charge] = law.electrons_per_um * drawn.scale_error
    rates = dict.fromkeys(law.strengths, 0.0) | dict(zip(of, values, strict=True))
    fitted = replace(law, **rates | {charge: law.electrons_per_um * drawn.scale})
    return fitted, errors


def _steps(effect: CosmicHits, other: CosmicHits, errors: float) -> dict[str, float]:
    """Change of each number per error, for another law at a distance of ``errors``."""
    these, others = numbers(effect), numbers(other)
    return {n: (others[n] - these[n]) / errors for n in these if others[n] != these[n]}
