"""An effect of the bench or the detector: a forward model with estimation and correction.

It acts on simulated frames (`pixcal.simulation.forward`). This suffices to estimate its parameters
(`pixcal.simulation.score`). It may also define its action on the maps of a fit, and the inverse.
"""

import dataclasses
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.arrays import F32, F64, Mask
from pixcal.model.bench import SimulatedDetector
from pixcal.model.errors import InputError
from pixcal.simulation.forward import DOMAINS, ForwardModel, Stage, numbers, with_numbers
from pixcal.simulation.frame_changes import acts_on_frames_alone
from pixcal.simulation.frame_fit import fit_frames
from pixcal.simulation.fringe_maps import FringeMaps
from pixcal.simulation.light_fit import LightFit, LightStart, fit_light
from pixcal.simulation.score import score, score_again

__all__ = ["DOMAINS", "SETS_DISAGREE", "Effect", "Estimate", "FringeMaps", "LightStart", "Stage"]

SETS_DISAGREE = "fringe sets disagree: an effect of the detector acts equally on all of them"
NONZERO = 3.0  # sigma above which a strength of an effect counts as different from zero


@dataclass(frozen=True)
class Estimate:
    """Parameters of an effect, estimated from an acquisition.

    Attributes
    ----------
    effect : Effect
        With the best parameters.
    errors : mapping
        1-sigma errors of the parameters that were fitted, by field name (``couplings[0].share``).
    significance : float
        Deviation from no effect, in sigma.
    why : str
        One sentence: the frames and the statistic that show it.
    together : tuple of mapping
        Joint 1-sigma steps, independent of one another, of parameters with correlated errors.
    covariance : (n, n) float64, optional
        Of the parameters of `Effect.phase_slopes`, if measured together.
    law : str
        The best-fitting law of the mechanism, in words; empty if the effect is itself a law.
    by_law : Effect, optional
        The effect by that law.
    law_predicts : bool
        Whether static maps agree with the law where, without it, other values were possible.
    again : Again, optional
        A faster way to detect this effect in other frames.
    in_full : Effect, optional
        The effect with all measured parameters, significant or not; None if it has them all.
    refused : str
        Why it cannot be a cause, however significant.
    size : mapping
        The size if the strengths do not give it: ``value``, ``error``, ``unit`` (empty for a
        ratio), and ``of``, the words that follow the number.
    alike : tuple of str
        Names of effects that these frames cannot tell from this one, whatever their significance.
    """

    effect: "Effect"
    errors: Mapping[str, float]
    significance: float
    why: str
    together: tuple[Mapping[str, float], ...] = ()
    covariance: F64 | None = None
    law: str = ""
    by_law: "Effect | None" = None
    law_predicts: bool = False
    again: "Again | None" = None
    in_full: "Effect | None" = None
    refused: str = ""
    size: Mapping[str, Any] = field(default_factory=dict)
    alike: tuple[str, ...] = ()

    @property
    def significant_part(self) -> "Effect":
        """The effect without strengths and optional parameters that are consistent with zero.

        Poorly known parameters may be tiny in some frames and extreme in others.
        """
        nothing = self.effect.scaled(0.0)
        unclear = {
            n: getattr(nothing, n) for n in self.effect.strengths if not self._is_significant(n)
        }
        unclear |= {n: 0.0 for n in self.effect.optional_parameters if not self._is_significant(n)}
        pruned = dataclasses.replace(self.effect, **unclear)
        return self.effect if pruned.is_null else pruned

    def scattered(self, effect: "Effect", seed: int) -> "Effect":
        """The effect, or a part of it, with its parameters drawn within their errors.

        Zeros stay zero; if a parameter would leave its range, none is moved.
        """
        rng = np.random.default_rng([seed, zlib.crc32(effect.name.encode())])
        values = numbers(effect)
        for steps in self.together or [{key: self.errors[key]} for key in sorted(self.errors)]:
            size = rng.standard_normal()
            values |= {k: values[k] + step * size for k, step in steps.items() if values.get(k)}
        try:
            moved = with_numbers(effect, values)
        except InputError:
            return effect
        return moved if numbers(moved) == values else effect

    def _is_significant(self, name: str) -> bool:
        value = getattr(self.effect, name)
        parts = {f"{name}[{n}]": v for n, v in enumerate(value if isinstance(value, tuple) else ())}
        return not all(
            isinstance(part, (int, float)) and abs(part) <= NONZERO * self.errors.get(key, 0.0)
            for key, part in (parts or {name: value}).items()
        )


@dataclass(frozen=True)
class Effect(ForwardModel):
    """A forward model that can also be measured, and undone where physics allows.

    Attributes
    ----------
    absorbed_because : str
        How the fit absorbs it; empty if it does not.
    left_because : str
        Why maps still need no correction for it: it is noise, or small.
    remedy : str
        What to do about it on a detector without fringes; empty if it shows only in fringes.
    is_gain : bool
        Whether it scales all samples equally, which photon transfer measures.
    fit_model : str
        Shape of the fringes (`pixcal.estimators.fringe_fit.shapes`) that absorbs it.
    smooth_degree : int
        Degree of the surfaces that maps have for other reasons; used with ``starts``.
    """

    absorbed_because: ClassVar[str] = ""
    left_because: ClassVar[str] = ""
    remedy: ClassVar[str] = ""
    is_gain: ClassVar[bool] = False
    fit_model: ClassVar[str] = ""
    smooth_degree: ClassVar[int] = 3

    # Its estimation, and its action on maps.

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Parameters and errors from an acquisition; None without evidence of it.

        Uses the forward model alone, unless an effect overrides it: from series of the frames if it
        acts on whole frames, from the maps if it gives ``starts``, else from simulated frames.
        """
        if starts := cls.starts(evidence):
            found_light = fit_light(starts, evidence, cls.smooth_degree)
            return None if found_light is None else _of_light(found_light, cls.smooth_degree)
        if acts_on_frames_alone(cls):
            series = fit_frames(cls, evidence)
            if series is None:
                return None
            return Estimate(series.model, series.errors, series.significance, series.why)
        scored = score(cls, evidence)
        if scored is None:
            return None
        ask = partial(score_again, scored.model, scored.response, template=scored.template)
        again = Again(scored.model, ask, simulates=True)
        return Estimate(scored.model, scored.errors, scored.significance, scored.why, again=again)

    @classmethod
    def detect(cls, evidence: Evidence) -> float | None:
        """Significance as in `estimate`; most simulations need nothing else."""
        estimate = cls.estimate(evidence)
        return None if estimate is None else estimate.significance

    def read_variance(self, detector: SimulatedDetector) -> float:
        """Variance (e-²) that it adds to the samples, about the mean of the frame."""
        return 0.0

    def noisy_pixels(self, detector: SimulatedDetector) -> Mask:
        """Pixels whose measured noise, beyond that of usual pixels, it simulates one by one."""
        return np.zeros(detector.shape, bool)

    @classmethod
    def starts(cls, evidence: Evidence) -> Sequence[LightStart]:
        """Starting points of a fit to the maps, if it acts only on the light of the fringes.

        Those with fewer numbers first; without any, frames are simulated.
        """
        return ()

    def replayed(self, evidence: Evidence) -> Self | None:
        """The effect that repeats its measured action on each of these frames, without a law.

        None for effects whose law describes single frames completely.
        """
        return None

    def predict(self, maps: FringeMaps) -> FringeMaps | None:
        """Maps that a fit finds with the effect; None if maps alone do not determine them."""
        return None

    def undo(self, maps: FringeMaps) -> FringeMaps | None:
        """Maps without the effect, from those with it; None if impossible."""
        return None

    def undo_samples(self, charge: F32) -> F32 | None:
        """Frames without the effect, if it acts on samples and not on maps.

        Parameters
        ----------
        charge : (t, y, x) float32
            e-, as collected: dark signal included, not divided by the flat. All finite.
        """
        return None

    def measured_again(self, parts: Iterable[Evidence]) -> Estimate | None:
        """The effect remeasured on all frames for a correction; None if there is no need.

        Parameters
        ----------
        parts : iterable of Evidence
            Of the same pixels, with different frames; calibration frames are in the first.
        """
        return None

    def phase_slopes(self, maps: FringeMaps) -> F64 | None:
        """Change (n, y, x) of the corrected phase, rad, by each parameter with a covariance.

        Parameters
        ----------
        maps : FringeMaps
            After `undo`.
        """
        return None

    @property
    def undo_halo(self) -> int:
        """Width (pixels) of the surroundings needed to undo the effect on part of the window."""
        return 0

    def noise_factor(self, charge: float, read_noise: float, maps: FringeMaps) -> F64:
        """Ratio (y, x) of the error of a pixel's phase after `undo` to that before.

        Parameters
        ----------
        charge, read_noise : float
            Mean signal and read noise, e-.
        maps : FringeMaps
            To undo.
        """
        return np.ones(maps.theta.shape[1:])


@dataclass(frozen=True)
class Again:
    """An effect as measured, with a faster way to detect it in other frames."""

    effect: Effect
    # its significance in evidence; None if undetermined
    detect: Callable[[Evidence], float | None] = field(repr=False, compare=False)
    simulates: bool = False  # whether it simulates frames, which takes a fifth of a simulation

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.effect.name

    @property
    def domains(self) -> tuple[str, ...]:
        """Of the effect."""
        return self.effect.domains

    @property
    def quick(self) -> bool:
        """Of the effect."""
        return self.effect.quick


def _of_light(fit: LightFit, degree: int) -> Estimate:
    """An estimate from the maps; fits of other maps start from it."""
    here = replace(fit.start, model=fit.model)
    return Estimate(
        fit.model,
        fit.errors,
        fit.significance,
        fit.why,
        law=fit.start.law,
        again=Again(fit.model, partial(_of_light_again, here, degree)),
    )


def _of_light_again(start: LightStart, degree: int, evidence: Evidence) -> float | None:
    fit = fit_light([start], evidence, degree)
    return None if fit is None else fit.significance
