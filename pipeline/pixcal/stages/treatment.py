"""What is done about each effect of a diagnosis: undone on samples, on maps, or left, and why."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.effects import known_effects, parse_effects
from pixcal.effects.hyperbolic_fringes import HyperbolicFringes
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect

F64 = NDArray[np.float64]

HYPERBOLIC = "hyperbolic"
"""The shape of fringes (`pixcal.estimators.models`) that takes up `HyperbolicFringes`."""
IN_CORRECTED = "in the corrected fit"
CORRECTED = ("undone on maps", "undone on samples", IN_CORRECTED)
"""Treatments after which the corrected maps are free of an effect."""
ABSORBED = {
    "bias_drift": "the free intensity of each frame absorbs a level common to all pixels",
    "contrast_noise": "the fit has a free fringe amplitude in each frame",
    "flat_error": "it scales level and fringes of a pixel equally and leaves the phase",
    "fringe_drift": "the fit has a free fringe vector in each frame where it moves",
    "fringe_jitter": "the fit has a free fringe vector in each frame where it moves",
    "intensity_noise": "the fit has a free intensity in each frame",
    "lag": "the fit absorbs a uniform lag; its variation moves phases by hundredths of the bound",
    "wavelength_drift": "the fit has a free phase and fringe vector in each frame",
}
"""Effects that the fit absorbs, and how (docs/appendix/correction-study.md)."""

LEFT = {
    "cosmic_hits": "few samples are hit, and most of them are masked",
    "gain_error": "only SIGMA is wrong: correct gain_e_per_adu in acquisition.yaml, or "
    "use 'pixcal reduce --gain measured', and fit again",
    "quantisation": "rounding adds noise of some hundredths of the bound",
    "rolling_shutter": "the part that the fit leaves is a tenth of the bound of 300 frames",
    "row_noise": "noise that is independent in each frame averages out",
    "telegraph_noise": "such pixels have larger errors, and SIGMA shows them",
}
"""Effects that are noise, or too small to be worth undoing (docs/appendix/correction-study.md)."""


@dataclass(frozen=True)
class Treatment:
    """An effect and what is done about it.

    Attributes
    ----------
    effect : Effect
    origin : str
        ``diagnosis``, or ``nominal``: known to be there before the diagnosis.
    errors : mapping
        Of its parameters, 1-sigma, by name.
    how : str
        ``undone on samples``, ``undone on maps``, ``in the fit``, ``in the corrected fit``,
        ``absorbed by the fit`` or ``not undone``.
    why : str
    covariance : (n, n) float64, optional
        Of the parameters, where they were measured together.
    """

    effect: Effect
    origin: str
    errors: Mapping[str, float]
    how: str
    why: str
    covariance: F64 | None = None

    @property
    def corrects(self) -> bool:
        """Whether corrected maps are made without it."""
        return self.how in CORRECTED

    @property
    def action(self) -> str:
        """As in ``diagnosis.json``: what is to be done about the map."""
        if self.corrects:
            return "corrected"
        absorbed = self.how in ("in the fit", "absorbed by the fit") or self.effect.name in LEFT
        return "unaffected" if absorbed else "fix the bench"

    @property
    def plain(self) -> dict[str, Any]:
        """For ``correction.json``."""
        return {
            "effect": self.effect.name,
            "title": self.effect.title,
            "parameters": to_plain(self.effect),
            "uncertainty": dict(self.errors),
            "origin": self.origin,
            "treatment": self.how,
            "why": self.why,
        }


@dataclass(frozen=True)
class Treatments:
    """All effects of a diagnosis.

    Attributes
    ----------
    every : tuple of Treatment
        In the order of the diagnosis.
    """

    every: tuple[Treatment, ...]

    def _those(self, how: str) -> tuple[Effect, ...]:
        """Effects of a treatment, the last that acted first."""
        own = [t.effect for t in self.every if t.how == how]
        return tuple(sorted(own, key=lambda e: (e.acts_at, e.name), reverse=True))

    @property
    def on_samples(self) -> tuple[Effect, ...]:
        """To undo on samples, in that order."""
        return self._those("undone on samples")

    @property
    def on_maps(self) -> tuple[Effect, ...]:
        """To undo on maps, in that order."""
        return self._those("undone on maps")

    @property
    def changes(self) -> bool:
        """Whether there are other maps to be made."""
        return bool(self.undone) or self.bent

    @property
    def bent(self) -> bool:
        """Whether hyperbolic fringes are to be fitted where the fit took straight ones."""
        return any(t.how == IN_CORRECTED for t in self.every)

    @property
    def errors(self) -> dict[str, Mapping[str, float]]:
        """Of the parameters of each effect."""
        return {t.effect.name: t.errors for t in self.every}

    @property
    def covariances(self) -> dict[str, F64]:
        """Of the parameters of effects that were measured together."""
        return {t.effect.name: t.covariance for t in self.every if t.covariance is not None}

    @property
    def undone(self) -> tuple[Effect, ...]:
        """All that are undone."""
        return (*self.on_samples, *self.on_maps)


def treatments(
    causes: Sequence[Mapping[str, Any]],
    nominal: Mapping[str, Any],
    asked: str,
    models: Mapping[str, str],
    own: Sequence[Path],
    where: Path,
) -> Treatments:
    """What to do about the effects of a diagnosis.

    Parameters
    ----------
    causes : sequence of mapping
        Of ``diagnosis.json``.
    nominal : mapping
        Parameters of the effects that the nominal bench had, by name.
    asked : str
        Shape of the fringes that the fit was asked for.
    models : mapping
        The one that was fitted, by fringe set.
    own : sequence of Path
        Files with effects of the user's own.
    where : Path
        The diagnosis, for messages.

    Raises
    ------
    InputError
        If an effect is not known: it is of the user's own, and its file has not been given.
    """
    known = known_effects(own)
    found: list[tuple[str, str, Any, Mapping[str, float]]]
    found = [("nominal", name, parameters, {}) for name, parameters in nominal.items()]
    found += [
        ("diagnosis", str(c["effect"]), c["parameters"], c.get("uncertainty", {})) for c in causes
    ]
    for _, name, _, _ in found:
        if name not in known:
            raise InputError(
                f"{where}: {name!r:.80} is an effect of your own; give its file again with "
                "--own FILE"
            )
    every = []
    for origin, name, parameters, errors in found:
        (effect,) = parse_effects({name: parameters}, str(where), known)
        every.append(Treatment(effect, origin, errors, *_treated(effect, asked, models)))
    return Treatments(tuple(every))


def treatment_of(effect: Effect, asked: str, models: Mapping[str, str]) -> Treatment:
    """What to do about an effect that a diagnosis found; parameters as in `treatments`."""
    return Treatment(effect, "diagnosis", {}, *_treated(effect, asked, models))


def _treated(effect: Effect, asked: str, models: Mapping[str, str]) -> tuple[str, str]:
    kind = type(effect)
    if kind.undo is not Effect.undo:
        return "undone on maps", "it acts on the three maps of a fit alike"
    if kind.undo_samples is not Effect.undo_samples:
        return "undone on samples", "it depends on the light of each frame: swept again without it"
    if isinstance(effect, HyperbolicFringes):
        return _of_bent_fringes(asked, models)
    if effect.name in ABSORBED:
        return "absorbed by the fit", ABSORBED[effect.name]
    return "not undone", LEFT.get(effect.name, "its file does not say how to undo it")


def _of_bent_fringes(asked: str, models: Mapping[str, str]) -> tuple[str, str]:
    straight = [name for name, model in models.items() if model != HYPERBOLIC]
    if not straight:
        return "in the fit", "the shape that was fitted to the fringes is hyperbolic"
    if asked == "auto":
        return (
            IN_CORRECTED,
            f"the fit took straight fringes ({', '.join(straight)}); the corrected maps do not",
        )
    return "not undone", "straight fringes were asked for: give --model hyperbolic"
