"""Fringes of a parasitic reflection: light that comes a second time, by way of a glass plate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri_exp

from pixcal.estimators.evidence import Evidence, FringeEvidence
from pixcal.estimators.map_fit import (
    MapFit,
    MapPart,
    centred,
    fit_maps,
    gauge_terms,
    phase_map,
    polynomial,
    without,
)
from pixcal.estimators.structure import PERIODS
from pixcal.kernels.scene import DetectorMaps, LightMaps, Rows
from pixcal.kernels.significance import sigmas_of_chi2
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, FringeMaps, Stage
from pixcal.simulation.recording import Recording

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
C128 = NDArray[np.complex128]
Mask = NDArray[np.bool_]

NEAR = 1.5
"""Periods in the window: no beat is looked for closer than that to what the fit leaves open."""

HARMONICS = 4
"""Of the fringes: a response that is not linear leaves waves there."""

_MIN_PIXELS = 200
_CLIP = 6.0
_TURNS = 5


@dataclass(frozen=True)
class GhostFringes(Effect):
    """Light reflected twice in a plate interferes with the direct light.

    Seen from the detector the reflection moves the fibres' images aside by the same way in all
    sets, so every ghost beats with what it meets at the same fringe vector, ``beat_rad_px``. Direct
    light of one fibre with the ghost of the other follows the modulator (``follows``): the fringe's
    phasor is multiplied by ``1 + share exp(i (beat·r + phase_rad))``, which shifts the phase by up
    to ``share`` rad, and changes the visibility by as much, a quarter of a period away. Direct
    light with its own ghost stands still: the mean light is multiplied by ``1 + share cos(...)``,
    and so are flats where their lamp is as coherent (``in_flats``).
    """

    name = "ghost_fringes"
    title = "ghost fringes of a parasitic reflection"
    stage = Stage.LIGHT
    domains = ("space",)
    strengths = ("share",)
    told_by = ("baseline", "axis")
    sources = (
        "a ghost of 0.5 % shifts by up to 0.005 / |K|: 4e-3 px at 5 px interfringe",
        "Born & Wolf, Principles of Optics, sections 1.5 and 7.6: a surface of n = 1.5 reflects "
        "4 % of the light, a coated one some 0.5 %; after two, an amplitude of 4 % or 0.5 %; a "
        "wedge of angle w makes fringes of lambda / (2 n w)",
    )

    share: float = quantity(
        0.005, low=0, high=0.9, doc="amplitude of the ghost, of the fringe's or of the mean light"
    )
    beat_rad_px: tuple[float, float] = quantity(
        (0.35, 0.2), unit="rad/px", low=-np.pi, high=np.pi, doc="vector of the beat along x and y"
    )  # fmt: skip
    phase_rad: float = quantity(
        0.0, unit="rad", low=-1e3, high=1e3, doc="of the beat in the window's first pixel"
    )
    follows: bool = quantity(True, doc="whether the ghost's phase follows the modulator")
    in_flats: bool = quantity(False, doc="whether a ghost that stands still is in flats too")

    def beat(self, rows: Rows, columns: Rows) -> C128:
        """``share exp(i (beat·r + phase))`` (y, x) on rows and columns of the window."""
        y, x = np.arange(*rows)[:, None], np.arange(*columns)
        kx, ky = self.beat_rad_px
        return np.asarray(self.share * np.exp(1j * (kx * x + ky * y + self.phase_rad)))

    def light(
        self, light: LightMaps, recording: Recording, rows: Rows, maps: DetectorMaps
    ) -> LightMaps:
        """As in `Effect.light`."""
        beat = self.beat(rows, (0, light.iota.shape[1]))
        if recording.kind == "fringes" and self.follows:
            z = (light.alpha_cos + 1j * light.alpha_sin) * (1 + beat)
            return replace(
                light, alpha_sin=z.imag.astype(np.float32), alpha_cos=z.real.astype(np.float32)
            )
        if recording.kind == "fringes" or (self.in_flats and not self.follows):
            return replace(light, iota=light.iota * (1 + beat.real).astype(np.float32))
        return light

    def predict(self, maps: FringeMaps) -> FringeMaps:
        """As in `Effect.predict`."""
        return self._times(maps, 1)

    def undo(self, maps: FringeMaps) -> FringeMaps:
        """As in `Effect.undo`."""
        return self._times(maps, -1)

    def _times(self, maps: FringeMaps, power: int) -> FringeMaps:
        (row, column), (ny, nx) = maps.origin, maps.theta.shape[1:]
        beat = self.beat((row, row + ny), (column, column + nx))
        iota, sine, cosine = maps.theta
        if self.follows:
            z = (cosine + 1j * sine) * (1 + beat) ** power
            return replace(maps, theta=np.stack([iota, z.imag, z.real]))
        factor = (1 + beat.real) ** power
        theta = np.stack([iota * factor, sine, cosine])
        if not self.in_flats or maps.flat is None:
            return replace(maps, theta=theta)
        return replace(maps, theta=theta / factor, flat=maps.flat * factor)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """One wave, the same in all sets, that phase and visibility share a quarter period apart.

        A ghost that stands still is in the visibility, and against it in iota, or in the flat when
        flats have it too. What true offsets, crosstalk or a flat do is in one of the maps alone, or
        not in these relations, and is not claimed. The chance is that of the best of all waves that
        the window can tell apart; those near the fringes, and near no wave at all, are left out.
        """
        sets = [f for f in evidence.fringes.values() if np.count_nonzero(f.good) > _MIN_PIXELS]
        if not sets:
            return None
        flat = _Map(
            np.log(np.maximum(evidence.flat, 1e-9)), polynomial(evidence.good.shape, 2),
            evidence.good & (evidence.flat > 0), 1,
        )  # fmt: skip
        following = _Found.of(
            [_visibility(f, 1) for f in sets], [_phase(f) for f in sets], (0, 1), sets
        )
        seen = [_visibility(f, -1) for f in sets]
        still = [_Found.of(seen, other, (0,), sets) for other in ([_iota(f) for f in sets], [flat])]
        found = max((following, *still), key=lambda s: s.significance)
        ny, nx = evidence.good.shape
        y0, x0 = evidence.origin[0] + (ny - 1) / 2, evidence.origin[1] + (nx - 1) / 2
        phase = np.angle(found.wave) - found.q @ np.array([x0, y0])
        error = found.errors
        follows = found is following
        return Estimate(
            cls(
                float(min(abs(found.wave), 0.9)),
                (float(found.q[0]), float(found.q[1])),
                float(np.angle(np.exp(1j * phase))),
                follows,
                found is still[1],
            ),
            {
                "share": error[0],
                "phase_rad": float(np.hypot(error[1], np.hypot(error[2] * x0, error[3] * y0))),
                "beat_rad_px[0]": error[2],
                "beat_rad_px[1]": error[3],
            },
            found.significance,
            "a wave that visibility and phase share"
            if follows
            else "a wave in the visibility that the mean light explains",
            {"of_following": following.significance, "of_still": [s.significance for s in still]},
        )


@dataclass(frozen=True)
class _Map:
    """A map (y, x) in which a ghost G is seen as ``Re(part G)``; free terms (n, y, x)."""

    data: F64
    free: F64
    good: Mask
    part: complex

    def rest(self) -> tuple[F64, float]:
        """The map without its free terms, zero where masked, and its variance."""
        left = without(self.data[self.good][:, None], self.free[:, self.good].T)[:, 0]
        scatter = 1.4826 * float(np.median(np.abs(left - np.median(left))))
        left = np.where(np.abs(left) > _CLIP * scatter, 0, left)
        out = np.zeros(self.good.shape)
        out[self.good] = left
        return out, float((left @ left) / len(left)) or 1e-30


def _terms(found: FringeEvidence) -> F64:
    return np.concatenate([polynomial(found.good.shape, 2), gauge_terms(found)])


def _log(found: FringeEvidence, value: F64) -> F64:
    return np.asarray(np.log(np.where(found.good, np.maximum(value, 1e-9), 1.0)))


def _alpha_of(found: FringeEvidence) -> F64:
    return np.asarray(np.hypot(found.theta[1], found.theta[2]))


def _visibility(found: FringeEvidence, part: complex) -> _Map:
    visibility = _alpha_of(found) / np.maximum(found.theta[0], 1e-9)
    return _Map(_log(found, visibility), _terms(found), found.good, part)


def _phase(found: FringeEvidence) -> _Map:
    return _Map(phase_map(found), _terms(found), found.good, -1j)


def _iota(found: FringeEvidence) -> _Map:
    return _Map(_log(found, found.theta[0]), _terms(found), found.good, 1)


@dataclass(frozen=True)
class _Found:
    """The best wave of some maps.

    Attributes
    ----------
    wave : complex
        Share and phase at the middle of the part.
    q : (2,) float64
        Along x and y, rad/px.
    errors : (4,) float
        Of share, phase, and q.
    significance : float
    """

    wave: complex
    q: F64
    errors: tuple[float, ...]
    significance: float

    @classmethod
    def of(
        cls,
        one: Sequence[_Map],
        other: Sequence[_Map],
        searched: Sequence[int],
        sets: Sequence[FringeEvidence],
    ) -> "_Found":
        """Of maps of two kinds: searched in those numbered, confirmed in both."""
        kinds = [one, other]
        search = [m for n in searched for m in kinds[n]]
        q, trials = _best_wave(search, sets)
        wave, q, fit = _fitted(search, q)
        own = [_amplitude(kind, q) for kind in kinds]
        apart = own[0].values - own[1].values
        spread = own[0].covariance + own[1].covariance
        scale = np.sqrt(max(1.0, float(apart @ np.linalg.solve(spread, apart)) / 2))
        ways = [_best_of(_amplitude(search, q).gain, trials)]
        ways += [sigmas_of_chi2(o.gain, 2) for o in own]
        errors = np.sqrt(np.diag(fit.covariance))
        # Share and phase: along the wave, and across it.
        share = max(abs(wave), errors[0])
        turned = (errors[0], min(errors[1] / share, np.pi), errors[2], errors[3])
        return cls(wave, q, tuple(float(e) for e in turned), float(min(ways) / scale))


def _best_wave(maps: Sequence[_Map], sets: Sequence[FringeEvidence]) -> tuple[F64, float]:
    """Vector with the largest chi-square on a fine grid, and how many waves there were."""
    shape = maps[0].good.shape
    size = (2 * shape[0], 2 * shape[1])
    seen = np.zeros(shape, complex)
    for m in maps:
        data, variance = m.rest()
        seen += data / variance * np.conj(m.part)
    power = np.abs(np.fft.fft2(seen, size)) ** 2
    fy, fx = np.meshgrid(*(np.fft.fftfreq(n) for n in size), indexing="ij")
    allowed = ~_of_lines(fx, fy, shape)
    for f in sets:
        for n in range(HARMONICS + 1):
            for sign in (1, -1):
                dx, dy = fx - sign * n * f.k[0] / 2 / np.pi, fy - sign * n * f.k[1] / 2 / np.pi
                far = np.hypot((dx - np.rint(dx)) * shape[1], (dy - np.rint(dy)) * shape[0])
                allowed &= far > NEAR
    if np.isrealobj(seen) or not np.any(seen.imag):
        allowed &= (fy > 0) | ((fy == 0) & (fx > 0))
    at = int(np.argmax(np.where(allowed, power, -1)))
    q = 2 * np.pi * np.array([fx.flat[at], fy.flat[at]])
    # Between the waves of the window there are some that are alike but not the same.
    return q, 3 * np.count_nonzero(allowed) / 4


def _of_lines(fx: F64, fy: F64, shape: tuple[int, ...]) -> Mask:
    """Frequencies (cycles/px) of rows or columns that repeat: those are circuits, and not glass."""
    found = np.zeros(fx.shape, bool)
    for across, along, n, m in ((fx, fy, shape[1], shape[0]), (fy, fx, shape[0], shape[1])):
        level = np.abs(across) * n < NEAR
        for period in PERIODS:
            harmonic = np.abs(along * period - np.rint(along * period)) / period * m < NEAR
            found |= level & harmonic & (np.abs(along) * m >= NEAR)
    return found


def _fitted(maps: Sequence[_Map], q: F64) -> tuple[complex, F64, MapFit]:
    """Wave and vector by Gauss and Newton; covariance along and across the wave, and of q."""
    first = _amplitude(maps, q).values
    wave, limit = complex(first[0], first[1]), 2 * np.pi / np.array(maps[0].good.shape[::-1])
    start = q
    for _ in range(_TURNS):
        parts = []
        for m in maps:
            y, x = centred(m.good.shape)
            e = np.exp(1j * (q[0] * x + q[1] * y + np.angle(wave)))
            slope = 1j * abs(wave) * e
            signals = np.stack([(m.part * s).real for s in (e, 1j * e, x * slope, y * slope)])
            model = (m.part * abs(wave) * e).real
            parts.append(MapPart.of(signals, m.data - model, m.free, m.good))
        fit = fit_maps(parts)
        along, across, *turn = fit.values
        wave = (abs(wave) + complex(along, across)) * np.exp(1j * np.angle(wave))
        q = np.clip(q + np.array(turn), start - limit, start + limit)
    return wave, q, fit


def _amplitude(maps: Sequence[_Map], q: F64) -> MapFit:
    """Real and imaginary part of the wave of a vector."""
    parts = []
    for m in maps:
        y, x = centred(m.good.shape)
        e = np.exp(1j * (q[0] * x + q[1] * y))
        signals = np.stack([(m.part * e).real, (m.part * 1j * e).real])
        parts.append(MapPart.of(signals, m.data, m.free, m.good))
    return fit_maps(parts)


def _best_of(gain: float, trials: float) -> float:
    """Standard deviations as rare as the best chi-square of so many waves."""
    log_rate = np.log(trials) - gain / 2
    log_chance = log_rate if log_rate < -20 else np.log(-np.expm1(-np.exp(log_rate)))
    return -float(ndtri_exp(min(float(log_chance), -1e-300)))
