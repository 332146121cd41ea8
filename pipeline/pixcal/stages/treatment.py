"""Treatment of each effect of a diagnosis: corrected on samples, on maps, or not, and why."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pixcal.effects import known_effects, parse_effects
from pixcal.model.arrays import F64
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect
from pixcal.storage.manifest import MANIFEST, read_json
from pixcal.storage.stage import require

# the shape of fringes (`pixcal.estimators.fringe_fit.shapes`) beside straight ones
HYPERBOLIC = "hyperbolic"
SUFFIX = "_corrected"  # of the names of the corrected products
IN_CORRECTED = "in the corrected fit"
# treatments after which the corrected maps are free of an effect
CORRECTED = ("corrected on maps", "corrected on samples", IN_CORRECTED)


@dataclass(frozen=True)
class Treatment:
    """An effect and its treatment."""

    effect: Effect
    origin: str  # `diagnosis`, or `nominal`: known to be there before the diagnosis
    errors: Mapping[str, float]  # of its parameters, 1-sigma, by name
    how: str  # one of `CORRECTED`, `in the fit`, `absorbed by the fit` or `not corrected`
    why: str
    covariance: F64 | None = None  # (n, n) of the parameters, where they were measured together

    @property
    def action(self) -> str:
        """What to do about the map, as in ``diagnosis.json``."""
        if self.how in CORRECTED:
            return "corrected"
        absorbed = self.how in ("in the fit", "absorbed by the fit")
        return "unaffected" if absorbed or self.effect.left_because else "fix the bench"

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
    """All effects of a diagnosis."""

    every: tuple[Treatment, ...]  # in the order of the diagnosis

    def _those(self, how: str) -> tuple[Treatment, ...]:
        """Effects corrected in one way; the last to act comes first."""
        matching = [t for t in self.every if t.how == how]
        return tuple(sorted(matching, key=lambda t: t.effect.sort_key, reverse=True))

    @property
    def on_samples(self) -> tuple[Effect, ...]:
        """To correct on samples, in that order."""
        return tuple(t.effect for t in self._those("corrected on samples"))

    @property
    def on_maps(self) -> tuple[Treatment, ...]:
        """To correct on maps, in that order."""
        return self._those("corrected on maps")

    @property
    def curved(self) -> bool:
        """Whether hyperbolic fringes must be fitted where the fit used straight ones."""
        return any(t.how == IN_CORRECTED for t in self.every)

    @property
    def corrected(self) -> tuple[str, ...]:
        """Names of all that are corrected."""
        return tuple(e.name for e in (*self.on_samples, *(t.effect for t in self.on_maps)))


def treatments(
    causes: Sequence[Mapping[str, Any]],
    nominal: Mapping[str, Any],
    model: str,
    models: Mapping[str, str],
    own: Sequence[Path],
    where: Path,
) -> Treatments:
    """What to do about the effects of a diagnosis, by the ``causes`` of ``diagnosis.json``.

    ``nominal``: effects of the nominal bench, by name. ``model, models``: shape of the fringes
    asked for, and those fitted, by set. ``own``: files of own effects; an unknown one is refused.
    ``where``: the diagnosis.
    """
    known = known_effects(own)
    entries: list[tuple[str, str, Any, Mapping[str, float]]]
    entries = [("nominal", name, parameters, {}) for name, parameters in nominal.items()]
    entries += [
        ("diagnosis", str(c["effect"]), c["parameters"], c.get("uncertainty", {})) for c in causes
    ]
    for _, name, _, _ in entries:
        if name not in known:
            raise InputError(
                f"{where}: {name!r:.80} is not an effect of pixcal; give its file with --own FILE"
            )
    effects = []
    for origin, name, parameters, errors in entries:
        (effect,) = parse_effects({name: parameters}, str(where), known)
        effects.append(
            Treatment(effect, origin, errors, *treatment_of_kind(type(effect), model, models))
        )
    return Treatments(tuple(effects))


def treatments_of(
    run_dir: Path, model: str, models: Mapping[str, str], own: Sequence[Path]
) -> Treatments:
    """`treatments` of the diagnosis of a run; InputError if its frames were reduced anew since."""
    diagnosed = require(run_dir, "diagnose")
    if diagnosed.inputs["reduce"] != require(run_dir, "reduce").key:
        raise InputError(
            f"{run_dir / 'diagnose'}: made from frames that were reduced differently; run "
            f"'pixcal diagnose {run_dir}' again"
        )
    causes = read_json(run_dir / "diagnose" / "diagnosis.json")["causes"]
    nominal = diagnosed.config["nominal"]
    return treatments(causes, nominal, model, models, own, run_dir / "diagnose")


def fitted_shapes(run_dir: Path) -> tuple[str, Mapping[str, str]]:
    """Shape of the fringes that was asked for, and the one fitted to each set."""
    if not (run_dir / "fit" / MANIFEST).exists():
        return "auto", {}
    sets = read_json(run_dir / "fit" / "fit.json")["sets"]
    asked = read_json(run_dir / "fit" / MANIFEST)["config"].get("model", "auto")
    return asked, {name: facts["model"] for name, facts in sets.items()}


def treatment_of_kind(kind: type[Effect], model: str, models: Mapping[str, str]) -> tuple[str, str]:
    """How a kind of effect is treated, and why; parameters as in `treatments`."""
    if kind.undo is not Effect.undo:
        return "corrected on maps", "its change of the maps is computed and removed"
    if kind.undo_samples is not Effect.undo_samples:
        return (
            "corrected on samples",
            "it depends on the light of each frame: removed from the samples, which are fitted "
            "again",
        )
    if kind.fit_model == HYPERBOLIC:
        return _of_curved_fringes(model, models)
    if kind.absorbed_because:
        return "absorbed by the fit", kind.absorbed_because
    why = kind.left_because or kind.remedy or "its file has no method to correct it"
    return "not corrected", why


def _of_curved_fringes(requested: str, models: Mapping[str, str]) -> tuple[str, str]:
    straight = [name for name, model in models.items() if model != HYPERBOLIC]
    if not straight:
        return "in the fit", "hyperbolic fringes were fitted"
    if requested == "auto":
        return (
            IN_CORRECTED,
            f"straight fringes were fitted ({', '.join(straight)}); the corrected maps use "
            "hyperbolic ones",
        )
    return "not corrected", "--model paraxial was given: use --model hyperbolic"
