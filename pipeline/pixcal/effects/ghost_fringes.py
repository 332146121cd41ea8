"""Fringes of a parasitic reflection: light that arrives again after reflection in a glass plate."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.maps.map_waves import WaveFit, find_waves
from pixcal.kernels.beams import FIXED, MODULATED, Beam, Light
from pixcal.kernels.scene import DetectorMaps, Rows
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_chi2
from pixcal.model.arrays import C128, F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, FringeMaps, Stage
from pixcal.simulation.forward import Scalable
from pixcal.simulation.recording import Recording

Beat = tuple[float, float]
Parent = tuple[str, bool]  # a fibre; whether the ghost is polarised orthogonally to the other
_EVERY_PARENT: tuple[Parent, ...] = ((MODULATED, False), (FIXED, False), (MODULATED, True))
PARENTS: dict[str, tuple[Parent, ...]] = {
    "modulated": _EVERY_PARENT[:1],
    "fixed": _EVERY_PARENT[1:2],
    "both": _EVERY_PARENT[:2],
    "crossed": _EVERY_PARENT[2:],
}
# laws: static, forward and (conjugate) backward amplitude of a unit of each ghost
LAWS = {
    "static fringes alone: a ghost crossed in polarisation with the other fibre": ((1, 0, 0),),
    "ghost of the modulated fibre: static and moving fringes": ((1, 1, 0),),
    "ghost of the fixed fibre: static and moving fringes": ((1, 0, 1),),
    "ghosts of both fibres": ((1, 1, 0), (1, 0, 1)),
}
# least chi-square per wave for a second ghost
TWO_GHOSTS = 25.0
# largest misfit of the law of a beam over that of unrelated amplitudes, per degree of freedom;
# ghosts of both fibres, accepted only if they fit far better, always pass
UNTIED = 0.75
# largest differences between sets, relative and in errors, of a pattern of the flat,
ALIKE, ALIKE_SIGMAS = 0.1, 5.0
# and largest wave of the phase relative to it, as of crosstalk; distance, periods in the window, of
# the waves that together describe a curved one
PHASE_SHARE, CLOSE = 0.05, 1.5
# largest misfit of the law of one ghost, over that of the next law, that no chance pattern has
PREDICTED = 0.1


@dataclass(frozen=True)
class GhostWave(Scalable):
    """One ghost as measured in the maps of a fringe set, with no assumption about its origin."""

    strengths = ("static", "forward", "backward")

    beat_rad_px: tuple[float, float] = quantity(unit="rad/px", low=-np.pi, high=np.pi)
    """beat vector along x and y"""
    set: str = quantity("")
    """name of the fringe set; default: all"""
    static: tuple[float, float] = quantity((0.0, 0.0), low=-0.9, high=0.9)
    """cosine and sine of the pattern of the mean light"""
    forward: tuple[float, float] = quantity((0.0, 0.0), low=-0.9, high=0.9)
    """the same for fringes at fringe vector plus beat"""
    backward: tuple[float, float] = quantity((0.0, 0.0), low=-0.9, high=0.9)
    """the same for fringes at fringe vector minus beat"""

    @property
    def of_beams(self) -> tuple[complex, ...]:
        """Amplitudes of the three ghosts that make this wave, in the order of `_EVERY_PARENT`."""
        forward, backward = complex(*self.forward), complex(*self.backward).conjugate()
        return forward, backward, complex(*self.static).conjugate() - forward - backward


@dataclass(frozen=True)
class GhostFringes(Effect):
    """A weak reflection of one fibre interferes with the two direct beams."""

    name = "ghost_fringes"
    title = "ghost fringes from a parasitic reflection"
    acts_at = Stage.LIGHT
    order = 7
    domains = ("space",)
    strengths = ("share", "waves")
    frames_needed = ("baseline", "axis")
    sources = (
        "a ghost of 0.5 % shifts by up to 0.005 / |K|: 4e-3 px at a fringe period of 5 px",
        "Born & Wolf, Principles of Optics, sections 1.5 and 7.6: a surface of n = 1.5 reflects "
        "4 % of the light, a coated one some 0.5 %; after two, an amplitude of 4 % or 0.5 %; a "
        "wedge of angle w makes fringes of lambda / (2 n w)",
    )

    share: float = quantity(0.005, low=0, high=0.9)
    """amplitude of the ghost over that of its parent beam"""
    beat_rad_px: tuple[float, float] = quantity((0.35, 0.2), unit="rad/px", low=-np.pi, high=np.pi)
    """beat vector along x and y"""
    phase_rad: float = quantity(0.0, unit="rad", low=-1e3, high=1e3)
    """phase of the beat in the first pixel of the window"""
    parent: str = quantity("modulated", choices=tuple(PARENTS))
    """reflected fibre"""
    in_flats: bool = quantity(False)
    """whether the flats contain the static pattern too"""
    waves: tuple[GhostWave, ...] = quantity(())
    """measured ghosts, in addition to the one above"""

    def _ghosts(self, of: str) -> list[tuple[Beat, complex, Parent]]:
        """Beat, amplitude relative to the parent beam, and parent of all ghosts in a set."""
        ratio = self.share * np.exp(1j * self.phase_rad)
        ghosts = [(self.beat_rad_px, ratio, parent) for parent in PARENTS[self.parent]]
        for wave in self.waves:
            if wave.set in ("", of):
                each = zip(wave.of_beams, _EVERY_PARENT, strict=True)
                ghosts += [(wave.beat_rad_px, amplitude, parent) for amplitude, parent in each]
        return [ghost for ghost in ghosts if ghost[1]]

    def _reflected(self, light: Light, of: str, rows: Rows, columns: Rows) -> Light:
        """Light with its ghosts, on rows and columns."""
        y, x = np.arange(*rows)[:, None], np.arange(*columns)
        ghosts: list[Beam] = []
        for (qx, qy), amplitude, (fibre, crossed) in self._ghosts(of):
            phase = qx * x + qy * y + np.angle(amplitude)
            ghosts += [
                beam.reflected(abs(amplitude), phase, crossed=crossed)
                for beam in light.beams
                if beam.fibre == fibre
            ]
        return light.with_beams(ghosts)

    def _factors(self, of: str, rows: Rows, columns: Rows) -> tuple[F64, C128]:
        """Factors (y, x) of mean light and fringe phasor on rows and columns."""
        one = np.ones((rows[1] - rows[0], columns[1] - columns[0]))
        light = self._reflected(Light.of_fringes(one, one.astype(complex)), of, rows, columns)
        return light.mean, light.phasor

    def light(self, light: Light, recording: Recording, rows: Rows, maps: DetectorMaps) -> Light:
        columns = (0, maps.response.shape[1])
        if recording.kind == "flat" and self.in_flats:
            mean, _ = self._factors("", rows, columns)
            return light.masked(mean)
        if recording.kind != "fringes":
            return light
        return self._reflected(light, recording.set_name, rows, columns)

    def predict(self, maps: FringeMaps) -> FringeMaps:
        return self._times(maps, 1)

    def undo(self, maps: FringeMaps) -> FringeMaps:
        return self._times(maps, -1)

    def _times(self, maps: FringeMaps, power: int) -> FringeMaps:
        (row, column), (ny, nx) = maps.origin, maps.theta.shape[1:]
        mean, fringe = self._factors(maps.name, (row, row + ny), (column, column + nx))
        iota, sine, cosine = maps.theta
        z = (cosine + 1j * sine) * fringe**power
        theta = np.stack([iota * mean**power, z.imag, z.real])
        if not self.in_flats or maps.flat is None:
            return replace(maps, theta=theta)
        lamp = self._factors("", (row, row + ny), (column, column + nx))[0] ** power
        return replace(maps, theta=theta / lamp, flat=maps.flat * lamp)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Waves that mean light and fringes share, set by set (`find_waves`)."""
        ghosts = find_waves(evidence)
        if ghosts is None:
            return None
        ny, nx = evidence.good.shape
        middle = (evidence.origin[1] + (nx - 1) / 2, evidence.origin[0] + (ny - 1) / 2)
        waves: list[GhostWave] = []
        errors: dict[str, float] = {}
        *single, both = (TiedWaves.of(law, ghosts.waves) for law in LAWS)
        best, second, _ = sorted(single, key=lambda tied: tied.misfit)
        static = sum(abs(w.static) ** 2 / w.errors[0] ** 2 for w in ghosts.waves)
        # Two ghosts have more free numbers, and must explain much more than one. Crosstalk causes
        # no static fringes.
        two = best.misfit > 2 * both.misfit + TWO_GHOSTS * len(ghosts.waves) < static
        tied = both if two else best
        columns = [abs(f.k[0]) >= abs(f.k[1]) for f in evidence.fringes.values()]
        alike = max(sum(columns), len(columns) - sum(columns))
        taken = tied.shrunk(ghosts.waves, alike)
        for n, (one, shrunk) in enumerate(zip(ghosts.waves, taken, strict=True)):
            waves.append(_wave(shrunk, middle))
            for key, error in zip(("static", "forward", "backward"), one.errors, strict=False):
                errors |= {f"waves[{n}].{key}[{part}]": error for part in (0, 1)}
            errors |= {f"waves[{n}].beat_rad_px[{axis}]": one.errors[3 + axis] for axis in (0, 1)}
        by_law = tuple(_wave(one, middle) for one in tied.waves)
        return Estimate(
            cls(0.0, waves[0].beat_rad_px, in_flats=ghosts.in_flats, waves=tuple(waves)),
            errors,
            ghosts.significance if _of_a_beam(ghosts.waves, tied, evidence) else 0.0,
            "fringes of a common vector in " + " and ".join(ghosts.seen_in),
            law=tied.law,
            by_law=cls(0.0, waves[0].beat_rad_px, in_flats=ghosts.in_flats, waves=by_law),
            # The static fringes, in size and phase, are then those of one moving sideband.
            law_predicts=not two and tied.moves and best.misfit < PREDICTED * second.misfit,
        )


def _wave(fit: WaveFit, middle: tuple[float, float]) -> GhostWave:
    """A wave relative to the window's first pixel instead of its centre."""
    qx, qy = fit.q
    turn = np.exp(-1j * (qx * middle[0] + qy * middle[1]))
    # Mean light: Re(s e); fringes: f e and b / e.
    static, forward, backward = fit.static * turn, fit.forward * turn, fit.backward / turn
    return GhostWave(
        (float(np.clip(qx, -np.pi, np.pi)), float(np.clip(qy, -np.pi, np.pi))),
        fit.set,
        _pair(static.conjugate()),
        _pair(forward),
        _pair(backward),
    )


def _pair(value: complex) -> tuple[float, float]:
    return float(np.clip(value.real, -0.9, 0.9)), float(np.clip(value.imag, -0.9, 0.9))


@dataclass(frozen=True)
class TiedWaves:
    """Waves whose amplitudes follow a law, and the misfit."""

    law: str
    waves: list[WaveFit]
    misfit: float  # chi-square that the law leaves
    freedom: int  # its expectation from noise

    @property
    def moves(self) -> bool:
        """Whether fringes of the ghost follow the modulator."""
        return bool(np.any(np.array(LAWS[self.law])[:, 1:]))

    @classmethod
    def of(cls, law: str, measured: Sequence[WaveFit]) -> "TiedWaves":
        """Least squares of the measured amplitudes."""
        each, waves, misfit = np.array(LAWS[law]).T, [], 0.0
        for one in measured:
            amplitudes, error = one.amplitudes, np.array(one.errors[:3])
            sizes = np.linalg.lstsq(each / error[:, None], amplitudes / error)[0]
            misfit += float((np.abs((amplitudes - each @ sizes) / error) ** 2).sum())
            waves.append(one.with_amplitudes(each @ sizes))
        return cls(law, waves, misfit, 2 * len(waves) * (3 - each.shape[1]))

    def shrunk(self, measured: Sequence[WaveFit], alike: int) -> list[WaveFit]:
        """The measured waves, shrunk to the law by the share of noise in their misfit.

        By Stein's estimator (James & Stein 1961), if they depart from the law significantly.
        ``alike``: number of sets along one axis, whose waves the true offsets change equally.
        """
        chi2, freedom = self.misfit / alike, self.freedom // alike
        sure = sigmas_of_chi2(max(chi2, 1e-9), max(freedom, 1)) > SIGNIFICANT
        share = 1 - freedom / chi2 if sure else 0.0
        return [
            by_law.with_amplitudes(share * one.amplitudes + (1 - share) * by_law.amplitudes)
            for one, by_law in zip(measured, self.waves, strict=True)
        ]


def _of_a_beam(waves: Sequence[WaveFit], tied: TiedWaves, evidence: Evidence) -> bool:
    """Whether waves are due to a reflection, by their law and the misfit that it leaves."""
    chi2 = sum(float((np.abs(w.amplitudes / w.errors[:3]) ** 2).sum()) for w in waves)
    untied = tied.misfit * 6 * len(waves) > UNTIED * tied.freedom * chi2
    return not untied and not (tied.moves and _of_the_flat(waves, evidence))


def _of_the_flat(waves: Sequence[WaveFit], evidence: Evidence) -> bool:
    """Whether the waves of all sets are one pattern of the light, as from an error of the flat."""
    # Such a pattern multiplies mean light and fringes equally, not the phases. Ghosts of both
    # fibres do so only where they are in phase.
    first = waves[0]
    same = [w for w in waves if w.q == first.q]
    near = 2 * np.pi * CLOSE / np.array(evidence.good.shape[::-1])
    close = [w for w in waves if np.all(np.abs(np.subtract(w.q, first.q)) < near)]

    def alike(one: WaveFit) -> bool:
        apart = ALIKE_SIGMAS * float(np.hypot(one.errors[0], first.errors[0]))
        return abs(one.static - first.static) < ALIKE * abs(first.static) + apart

    def leaves_phases(of: str) -> bool:
        in_set = [w for w in close if w.set == of]
        moved = np.linalg.norm([w.forward - w.backward.conjugate() for w in in_set])
        error = np.linalg.norm([w.errors[1:3] for w in in_set])
        return bool(moved < PHASE_SHARE * abs(first.static) + ALIKE_SIGMAS * error)

    return (
        any(evidence.of_kind("flat"))
        and len(same) == len(evidence.fringes)
        and all(alike(w) and leaves_phases(w.set) for w in same)
    )
