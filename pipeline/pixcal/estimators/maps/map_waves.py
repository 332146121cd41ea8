"""Waves common to several maps of a fit: mean light, visibility and phase of each set.

A weak third beam multiplies the mean light by ``1 + Re(s e)`` and the fringe's phasor by
``1 + f e + b / e``, with ``e = exp(i q·r)``. The logarithms of the maps then hold, to first order,
``Re(s e)`` (light over the flat), ``Re((f - s) e) + Re(b / e)`` (visibility) and
``Im(f e) + Im(b / e)`` (phase). Here s, f and b are independent; laws of the effect relate them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import ndtri_exp

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.fringe_fit.fringes import grid
from pixcal.estimators.maps import map_fit
from pixcal.estimators.maps.map_fit import MapPart
from pixcal.estimators.maps.structure import PERIODS
from pixcal.kernels.medians import robust_sigma
from pixcal.kernels.significance import sigmas_of_chi2
from pixcal.model.arrays import C128, F64, Mask

# least distance, periods in the window, of a wave from modes that the fit does not determine
NEAR = 1.5
HARMONICS = 4  # harmonics of the fringes, where a nonlinear response leaves waves
MOST = 3  # largest number of waves of one set
SIGNIFICANT = 5.0  # least significance of a further wave, standard deviations
APART = 30.0  # least gain in chi-square of separate vectors of the sets over a common one
_MIN_PIXELS = 200
_CLIP = 6.0
_ITERATIONS = 4
_SMOOTH = 3  # degree of the patterns of beams and lamp in the maps
LIGHT = "the mean light"


@dataclass(frozen=True)
class WaveFit:
    """One wave of one set."""

    set: str
    q: tuple[float, float]  # along x and y, rad/px
    static: complex  # static, forward, backward: s, f and b, relative to the window's centre
    forward: complex
    backward: complex
    # (5,) float: of s, f, b (of the real and of the imaginary part), then of q
    errors: tuple[float, ...]

    @property
    def amplitudes(self) -> C128:
        """(3,) s, f and the conjugate of b, which a ghost of one fibre shares."""
        return np.array([self.static, self.forward, self.backward.conjugate()])

    def with_amplitudes(self, amplitudes: C128) -> Self:
        """The wave with other `amplitudes`."""
        static, forward, backward = amplitudes.tolist()
        return replace(self, static=static, forward=forward, backward=backward.conjugate())


@dataclass(frozen=True)
class Waves:
    """Waves of all sets."""

    waves: tuple[WaveFit, ...]
    in_flats: bool  # whether the static pattern is in the flats, not in the light over the flat
    # standard deviations of the strongest wave in its second-best map, or in the mean light if
    # that is the best
    significance: float
    seen_in: tuple[str, ...]  # maps in which it is significant, or the two best


@dataclass(frozen=True)
class _Map:
    """A map (y, x), its free terms (n, y, x), and its dependence on a wave's six numbers."""

    kind: str
    data: F64
    free: F64
    good: Mask
    # (3,) complex: the map holds `Re(row · (s e, f e, b / e))`
    row: tuple[complex, complex, complex]

    def rest(self) -> tuple[F64, float]:
        """The map without its free terms, zero where masked, and its variance."""
        left = map_fit.without(self.data[self.good][:, None], self.free[:, self.good].T)[:, 0]
        scatter = robust_sigma(left - np.median(left))
        left = np.where(np.abs(left) > _CLIP * scatter, 0, left)
        out = np.zeros(self.good.shape)
        out[self.good] = left
        return out, float((left @ left) / max(len(left), 1)) or 1e-30

    def signals(self, q: F64) -> F64:
        """Change (6, y, x) of the map by a unit of each of the six numbers."""
        y, x = grid(self.good.shape)
        e = np.exp(1j * (q[0] * x + q[1] * y))
        waves = [factor * wave for factor, wave in zip(self.row, (e, e, e.conj()), strict=True)]
        return np.stack([part for w in waves for part in (w.real, -w.imag)])


Maps = Mapping[str, Sequence[_Map]]  # of each set, by its name


def find_waves(evidence: Evidence) -> Waves | None:
    """The strongest waves in all sets' maps, at most `MOST` per set; None without enough pixels."""
    # The significance counts all resolvable waves as trials. Waves near harmonics of a set's
    # fringes, near zero frequency, and of repeating rows or columns are left out.
    sets = [f for f in evidence.fringes.values() if np.count_nonzero(f.good) > _MIN_PIXELS]
    if not sets:
        return None
    ways = {still: {f.name: _maps(f, evidence, still) for f in sets} for still in (False, True)}
    allowed = {f.name: _allowed(f) for f in sets}
    light, flats = (_gains(ways[still], allowed) for still in (False, True))
    # A pattern common to light and flats is in flats and visibility, not in light over flat.
    in_flats = all(flat > other + APART for flat, other in zip(flats, light, strict=True))
    best = _strongest(ways[in_flats], allowed, in_flats)
    waves = list(best.waves)
    if best.significance > SIGNIFICANT:
        maps: Maps = ways[best.in_flats]
        for _ in range(MOST - 1):
            # Maps minus given waves.
            remaining = dict(maps)
            for w in waves[-len(sets) :]:
                six = np.array([w.static, w.forward, w.backward]).view(float)
                remaining[w.set] = [
                    replace(m, data=m.data - np.tensordot(six, m.signals(np.array(w.q)), 1))
                    for m in remaining[w.set]
                ]
            maps = remaining
            more = _strongest(maps, allowed, best.in_flats)
            if more.significance < SIGNIFICANT:
                break
            waves += more.waves
    return Waves(tuple(waves), best.in_flats, best.significance, best.seen_in)


def _maps(fringes: FringeEvidence, evidence: Evidence, in_flats: bool) -> list[_Map]:
    alpha = np.hypot(fringes.theta[1], fringes.theta[2])
    good = fringes.good & (alpha > 0) & (fringes.theta[0] > 0) & (evidence.flat > 0)
    iota = np.where(good, fringes.theta[0], 1.0)
    visibility = np.log(np.where(good, alpha, 1.0) / iota)
    terms = np.concatenate([map_fit.polynomial(good.shape, _SMOOTH), map_fit.gauge_terms(fringes)])
    light = evidence.flat if in_flats else iota
    light = np.log(np.where(good, light, 1.0))
    free = map_fit.polynomial(good.shape, _SMOOTH) if in_flats else terms
    return [
        _Map("the flats" if in_flats else LIGHT, light, free, good, (1, 0, 0)),
        _Map("the visibility", visibility, terms, good, (-1, 1, 1)),
        _Map("the phase", np.nan_to_num(map_fit.phase_map(fringes)), terms, good, (0, -1j, -1j)),
    ]


def _gains(maps: Maps, allowed: Mapping[str, Mask]) -> tuple[float, float]:
    """Chi-square of the strongest wave in the light or flats, and in its second-best map."""
    q = _vector(_common({name: _power(of_set, allowed[name]) for name, of_set in maps.items()}))
    gains: dict[str, float] = {}
    for of_set in maps.values():
        for m in of_set:
            gains[m.kind] = gains.get(m.kind, 0.0) + _plain_gain(m, q)
    return next(iter(gains.values())), sorted(gains.values())[-2]


def _strongest(maps: Maps, allowed: Mapping[str, Mask], in_flats: bool) -> Waves:
    """The strongest wave of each set, with a common vector if that fits as well."""
    power = {name: _power(of_set, allowed[name]) for name, of_set in maps.items()}
    apart = sum(float(p.max()) for p in power.values()) - float(_common(power).max())
    groups = [[name] for name in maps] if apart > APART and len(maps) > 1 else [list(maps)]
    trials = 0.0
    waves: list[WaveFit] = []
    gains: dict[str, float] = {}
    dof = 2 * len(maps)
    for names in groups:
        together = _common({n: power[n] for n in names})
        start, trials = _vector(together), trials + 3 * np.count_nonzero(together) / 4
        pairs = [(n, m) for n in names for m in maps[n]]
        fitted, q = _fitted(pairs, names, start)
        waves += fitted
        for _, m in pairs:
            gains[m.kind] = gains.get(m.kind, 0.0) + _plain_gain(m, q)
    by_map = {kind: sigmas_of_chi2(gain, dof) for kind, gain in gains.items()}
    order = sorted(by_map, key=lambda kind: -by_map[kind])
    # Significance (standard deviations) of the best chi-square of a number of waves.
    log_rate = np.log(max(trials, 1.0)) + np.log(dof / 2) - gains[order[0]] / 2
    log_chance = log_rate if log_rate < -20 else np.log(-np.expm1(-np.exp(log_rate)))
    first = -float(ndtri_exp(min(float(log_chance), -1e-300)))
    significance = float(min(first, by_map[order[1]]))
    if order[0] == LIGHT:
        # Equal ghosts of both fibres change neither visibility nor phase.
        significance = float(first)
    return Waves(
        tuple(waves),
        in_flats,
        significance,
        tuple(kind for kind in order if by_map[kind] > SIGNIFICANT) or tuple(order[:2]),
    )


def _power(maps: Sequence[_Map], allowed: Mask) -> F64:
    """Chi-square (frequency, frequency) of a wave in all maps of a set."""
    total = np.zeros(allowed.shape)
    for m in maps:
        data, variance = m.rest()
        count = np.count_nonzero(m.good)
        total += 2 * np.abs(np.fft.fft2(data, allowed.shape)) ** 2 / (count * variance)
    return np.where(allowed, total, 0.0)


def _common(power: Mapping[str, F64]) -> F64:
    """Chi-square of a common wave in these sets, zero where it is excluded in one of them."""
    maps = np.stack(list(power.values()))
    return np.asarray(np.where((maps > 0).all(axis=0), maps.sum(axis=0), 0.0))


def _allowed(f: FringeEvidence) -> Mask:
    """Frequencies at which waves of a set are sought, on a grid of half the window's step."""
    shape = f.good.shape
    fy, fx = np.meshgrid(*(np.fft.fftfreq(2 * n) for n in shape), indexing="ij")
    allowed = ~_of_lines(fx, fy, shape) & ((fy > 0) | ((fy == 0) & (fx > 0)))
    for n in range(-HARMONICS, HARMONICS + 1):
        dx, dy = fx - n * f.k[0] / 2 / np.pi, fy - n * f.k[1] / 2 / np.pi
        far = np.hypot((dx - np.rint(dx)) * shape[1], (dy - np.rint(dy)) * shape[0])
        allowed &= far > NEAR
    return np.asarray(allowed)


def _vector(power: F64) -> F64:
    fy, fx = np.meshgrid(*(np.fft.fftfreq(n) for n in power.shape), indexing="ij")
    at = int(np.argmax(power))
    return 2 * np.pi * np.array([fx.flat[at], fy.flat[at]])


def _of_lines(fx: F64, fy: F64, shape: tuple[int, ...]) -> Mask:
    """Whether frequencies (cycles/px) are of periodic rows or columns, due to electronics."""
    marked = np.zeros(fx.shape, bool)
    for across, along, n, m in ((fx, fy, shape[1], shape[0]), (fy, fx, shape[0], shape[1])):
        level = np.abs(across) * n < NEAR
        for period in PERIODS:
            harmonic = np.abs(along * period - np.rint(along * period)) / period * m < NEAR
            marked |= level & harmonic & (np.abs(along) * m >= NEAR)
    return marked


def _fitted(
    maps: Sequence[tuple[str, _Map]], names: Sequence[str], start: F64
) -> tuple[list[WaveFit], F64]:
    """Six numbers of every set and the common vector, by the Gauss-Newton method."""
    q, size = start.copy(), 6 * len(names)
    six = np.zeros(size)
    limit = 2 * np.pi / np.array(maps[0][1].good.shape[::-1])
    for turn in range(_ITERATIONS):
        parts = []
        for name, m in maps:
            y, x = grid(m.good.shape)
            place = slice(6 * names.index(name), 6 * names.index(name) + 6)
            signals = np.zeros((size + 2, *m.good.shape))
            signals[place] = m.signals(q)
            # d/dq of Re(row s e) is the same with s rotated by 90 degrees, times x or y.
            turned = six[place].view(complex) * [1j, 1j, -1j]
            slope = np.tensordot(turned.view(float), signals[place], 1)
            signals[size], signals[size + 1] = x * slope, y * slope
            model = np.tensordot(six[place], signals[place], 1)
            parts.append(
                MapPart.of(signals if turn else signals[:size], m.data - model, m.free, m.good)
            )
        step, _, _ = map_fit.fitted_values(parts)
        six = six + step[:size]
        if turn:
            q = np.clip(q + step[size:], start - limit, start + limit)
    errors = np.sqrt(np.diag(map_fit.fit_maps(parts).covariance))
    waves = []
    for n, name in enumerate(names):
        place = slice(6 * n, 6 * n + 6)
        spread = errors[place].reshape(3, 2).max(axis=1)
        every = (*spread.tolist(), *errors[size:].tolist())
        static, forward, backward = six[place].view(complex).tolist()
        waves.append(WaveFit(name, (float(q[0]), float(q[1])), static, forward, backward, every))
    return waves, q


def _plain_gain(m: _Map, q: F64) -> float:
    """Chi-square of a wave of any amplitude and phase in one map."""
    y, x = grid(m.good.shape)
    e = np.exp(1j * (q[0] * x + q[1] * y))
    signals = np.stack([e.real, e.imag])
    return map_fit.fit_maps([MapPart.of(signals, m.data, m.free, m.good)]).gain
