"""Modes of the frames' series: what an effect changes, and nuisances from frame to frame."""

from collections.abc import Mapping, Sequence

import numpy as np

from pixcal.estimators.diagnosis.evidence import cached_on_evidence
from pixcal.estimators.frame_series.fringe_motion import motion_part, ramps
from pixcal.estimators.frame_series.light import LIGHT_PARTS
from pixcal.estimators.frame_series.series import assemble
from pixcal.estimators.frame_series.variance_components import (
    MAX_STEPS,
    Components,
    estimate_components,
)
from pixcal.model.arrays import F64
from pixcal.simulation.frame_changes import (
    DRAWS,
    LIGHT,
    AffectedSeries,
    FrameChanges,
    Strength,
    unit_of,
)

MOTION_PARTS = ("jitter_x", "jitter_y", "walk_x", "walk_y", "walk_k")
# shortest time constant tried (frames), for random and for steady changes; number of trials
FASTEST, QUICKEST, TRIALS = 0.3, 3.0, 9
SAME = 0.8  # share of a nuisance explained by the effect above which it is part of the effect
SLOW = 0.1  # share of the modes, the lowest, that hold most of a slow change
ROUGH = 0.5  # relative excess scatter of draws above which they are not normal
ALIKE = (
    "; with fringes of one direction, motion of the fibres along the fringe axis and drift of the "
    "wavelength look the same"
)


class FrameBasis:
    """Parts and shapes of strengths and nuisances in the series."""

    def __init__(
        self, changes: FrameChanges, every: Sequence[AffectedSeries], strengths: Sequence[Strength]
    ) -> None:
        self.every = every
        self._made: dict[tuple[Strength, float | None], list[F64]] = {}
        self._number = {id(w.series): n for n, w in enumerate(every)}
        own = {
            steady: [v for s in strengths if s.steady == steady for v in self._extremes(s)]
            for steady in (False, True)
        }
        roots = [np.diag(np.diag(w.series.noise) ** -0.5) for w in every]

        def whole(values: Sequence[F64], steady: bool) -> F64:
            """All series as a vector, in units of the noise."""
            if steady:
                scaled = [(v - v.mean(axis=0)) @ r for v, r in zip(values, roots, strict=True)]
            else:
                scaled = [r @ v @ r for v, r in zip(values, roots, strict=True)]
            return np.concatenate([v.ravel() for v in scaled])

        def is_own(values: Sequence[F64], steady: bool) -> bool:
            vector = rest = whole(values, steady)
            if own[steady]:
                basis = np.stack([whole(v, steady) for v in own[steady]], axis=1)
                basis /= np.maximum(np.linalg.norm(basis, axis=0), 1e-300)
                rest = vector - basis @ np.linalg.lstsq(basis, vector, rcond=1e-6)[0]
            return bool(rest @ rest <= (1 - SAME) * (vector @ vector))

        parts = {name: _nuisance_parts(changes, name, every) for name in _names(changes, every)}
        self._nuisances = {n: part for n, part in parts.items() if not is_own(part, False)}
        shapes = [
            ramps(w.series, colour=changes.crossed) * (w.channels is not LIGHT) for w in every
        ]
        kept = [
            q for q in range(shapes[0].shape[2]) if not is_own([v[..., q] for v in shapes], True)
        ]
        self._shapes = [v[..., kept] for v in shapes]

    def trials(self, of: Strength) -> F64:
        """Values of a strength's shape parameter to try."""
        assert of.shape is not None
        series = [w.series for w in self.every if w.recording is not None]
        step, longest = self.step_s, max(float(np.ptp(s.time_s)) for s in series)
        first, last = (QUICKEST, 1.0) if of.steady else (FASTEST, 2.0)
        times = np.geomspace(first * step, last * longest, TRIALS)
        unit, value = unit_of(of.model, of.shape), getattr(of.model, of.shape)
        if unit in ("s", "1/h"):
            return np.asarray(times if unit == "s" else 3600 / times[::-1])
        return np.asarray((value or 1.0) * np.geomspace(1 / 9, 9, TRIALS))

    @property
    def step_s(self) -> float:
        """Time between frames, s."""
        return min(w.series.step_s for w in self.every if w.recording is not None)

    def own(self, of: Strength, shape: float | None) -> list[F64]:
        """Parts or shapes of a strength in all series."""
        if (of, shape) not in self._made:
            model = of.at(shape)
            self._made[of, shape] = [
                w.changes(model, 1)[0] if of.steady else w.part(model) for w in self.every
            ]
        return self._made[of, shape]

    def _extremes(self, of: Strength) -> list[list[F64]]:
        ends = [] if of.shape is None else [float(v) for v in self.trials(of)[[0, -1]]]
        return [self.own(of, shape) for shape in (None, *ends)]

    def components(
        self,
        strengths: Sequence[Strength],
        shapes: Mapping[str, float],
        start: Components | None = None,
        steps: int = MAX_STEPS,
        *,
        by_set: bool = False,
    ) -> Components:
        """Sizes of strengths: random ones first in ``size``, steady ones first in ``beta``.

        ``shapes``: shape parameters by the field of the strength. With ``by_set``, the differences
        of each later set from the first follow in ``beta``.
        """
        by_strength = [(s.steady, self.own(s, shapes.get(s.field))) for s in strengths]
        parts = [*(v for steady, v in by_strength if not steady), *self._nuisances.values()]
        known = [v for steady, v in by_strength if steady]
        if by_set:
            later = [n for n, w in enumerate(self.every) if w.recording is not None][1:]
            known += [
                [w * (n == one) for n, w in enumerate(v)] for v in list(known) for one in later
            ]
        modes = assemble(
            [w.series for w in self.every],
            lambda s: np.stack([part[self._number[id(s)]] for part in parts]),
            lambda s: np.concatenate(
                [
                    *(v[self._number[id(s)]][..., None] for v in known),
                    self._shapes[self._number[id(s)]],
                ],
                axis=2,
            ),
        )
        if start is not None and len(start.size) != len(modes.start):
            start = None
        return estimate_components(modes, (), start, steps)

    def slow(self, random: Sequence[Strength], shapes: Mapping[str, float]) -> list[int]:
        """Indices of the parts with few modes, whose sizes are poorly determined."""
        indices = []
        parts = [*(self.own(s, shapes.get(s.field)) for s in random), *self._nuisances.values()]
        for n, part in enumerate(parts):
            power = [np.einsum("kaa->k", v) for v in part]
            low = sum(float(p[: max(int(SLOW * len(p)), 1)].sum()) for p in power)
            if low > sum(float(p.sum()) for p in power) / 2:
                indices.append(n)
        return indices

    def rough(self, of: Strength, shape: float | None, fit: Components) -> float:
        """Relative scatter of a strength's size in excess of normal draws."""
        normal = square = seen = 0.0
        sizes = np.maximum(fit.size, 0.0)
        covariance = (sizes @ fit.modes.flat).reshape(fit.modes.parts.shape[1:])
        at = 0
        for w, part in zip(self.every, self.own(of, shape), strict=True):
            weight = np.linalg.inv(covariance[at : at + len(part)])
            weighed = weight @ part @ weight
            both = weighed @ part
            modes = w.series.walk_modes.of(w.changes(of.at(shape), DRAWS).transpose(1, 0, 2))
            seen += float(np.einsum("kra,kab,krb->r", modes, weighed, modes).var(ddof=1))
            normal += 2 * float(np.einsum("kab,kba->", both, both))
            square += float(np.einsum("kaa->", both))
            at += 2 * len(part)
        more = seen - normal
        return float(np.sqrt(more)) / square if more > ROUGH * normal else 0.0


_changes_of = cached_on_evidence(FrameChanges)


def _names(changes: FrameChanges, every: Sequence[AffectedSeries]) -> list[str]:
    kinds = {w.channels is LIGHT for w in every}
    motion = MOTION_PARTS if changes.crossed else MOTION_PARTS[:-1]
    return [*(LIGHT_PARTS if True in kinds else ()), *(motion if False in kinds else ())]


def _nuisance_parts(changes: FrameChanges, name: str, every: Sequence[AffectedSeries]) -> list[F64]:
    """Covariance (t - 1, 2, 2) of the modes of each series by a nuisance."""
    parts = []
    for w in every:
        if (w.channels is LIGHT) != (name in LIGHT_PARTS):
            parts.append(np.zeros((len(w.series) - 1, 2, 2)))
        elif w.channels is LIGHT and changes.light is not None:
            parts.append(changes.light.part(name, w.series))
        else:
            parts.append(motion_part(name, w.series))
    return parts
