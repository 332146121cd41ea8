"""Estimate an effect from its forward model alone: score test and Gauss-Newton steps.

The frames are simulated without noise (`pixcal.simulation.replica`), with and without the effect.
The change of the `deviations` from the nominal bench, compared with those measured and weighted by
their noise, gives the score test of zero strength (Rao 1948, Proc. Camb. Phil. Soc. 44, 50). A
random effect, or one that mixes the noise of samples, is detected by its second moments
(Lin 1997, Biometrika 84, 309). Parameters follow by Gauss-Newton steps on simulations with the same
random numbers (indirect inference: Gourieroux, Monfort & Renault 1993, J. Appl. Econometrics 8,
S85).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import log_ndtr

from pixcal.estimators.diagnosis.evidence import Evidence, cached_on_evidence
from pixcal.estimators.frame_series.variance_components import log_chance, log_chance_of_any, sigmas
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.kernels.significance import root_with_error
from pixcal.model.arrays import F64
from pixcal.simulation.changes import Changes, Key, Response, Template
from pixcal.simulation.deviations import LINEAR
from pixcal.simulation.forward import ForwardModel, field_of, numbers, with_numbers

STEP = 1.1  # factor on a parameter for its derivative
# factors on the default of a parameter other than a strength for further score tests, then on the
# best of these
GRID = ((1 / 9, 1 / 3, 3.0, 9.0), (1 / 1.7, 1.7))
HINT = 2.0  # sigma above which parameters are fitted
ROUNDS = 4  # steps, each halved up to
HALVINGS = 4  # times, until the misfit falls by less than
CONVERGED = 0.05
MAX_FACTOR = 3.0  # largest factor by which a step changes a parameter
TELLING = 0.02  # share of the information above which a deviation is used again
SINGULAR = 1e-6  # share of the largest eigenvalue below which parameters are degenerate
RANDOM = "changes in the second moments of frames, as its forward model predicts"
STEADY = "changes in frames and maps that the fit does not absorb, as its forward model predicts"


@dataclass(frozen=True)
class Scored:
    """Estimate of an effect by its forward model."""

    model: Any
    errors: dict[str, float]  # 1-sigma errors of the parameters that were fitted
    significance: float
    why: str
    response: Response  # how it shows, in the most informative deviations
    # its change of these, if valid for other frames too: second moments
    template: Template | None = None


def score(kind: type[ForwardModel], evidence: Evidence) -> Scored | None:
    """Parameters of an effect, and its significance; None where it changes nothing in these frames.

    Raises NotImplementedError if none of its strengths is a number.
    """
    start = kind()
    names = tuple(key for key in numbers(start) if field_of(key) in kind.strengths)
    if not names:
        raise NotImplementedError("none of its strengths is a number: define estimate")
    changes = _changes(evidence)
    response = changes.response(start)
    fit = _ScoreFit(changes, response, names)
    if response.random or response.mixes:
        # If frames without light hold all information, the others need not be simulated.
        keys, _ = fit.telling(start)
        fit = _ScoreFit(changes, dataclasses.replace(response, keys=keys), names)
    return fit.result(start)


def score_again(
    model: ForwardModel, response: Response, evidence: Evidence, template: Template | None = None
) -> float:
    """Significance of an effect in other frames, with its parameters fixed."""
    # Compute the template again if it does not match these pixels.
    changes = _changes(evidence)
    fit = _ScoreFit(changes, response, ())
    if template is None or not changes.fits(template):
        template = fit.template(model)
    return float(fit.together([template])[2])


_changes = cached_on_evidence(Changes)


@dataclass(frozen=True)
class _ScoreFit:
    """Score tests of an effect, and the fit of its parameters."""

    changes: Changes
    response: Response
    strengths: tuple[str, ...]

    def template(self, model: ForwardModel) -> Template:
        """Change of the deviations by a model."""
        return self.changes.template(model, self.response)

    def sums(
        self, templates: Sequence[Template], at: Template | None = None
    ) -> tuple[F64, F64, F64]:
        """Right-hand side, normal matrix, and variance of the right-hand side."""
        # The normal matrix excludes the contribution of random draws.
        count = len(templates)
        right, normal, variance = np.zeros(count), np.zeros((count, count)), np.zeros((count,) * 2)
        keys, product = self.response.keys, self.changes.product
        rest = {k: self.changes.measured(k).value for k in keys}
        if at is not None:
            rest = {k: v - at.mean[k] for k, v in rest.items()}
        for i, a in enumerate(templates):
            drawn = [k for k in keys if k in a.half]
            right[i] = product(keys, a.mean, rest)
            if at is not None:
                right[i] += product(drawn, a.half, at.half)
            for j, b in enumerate(templates[: i + 1]):
                size = product(keys, a.mean, b.mean)
                variance[i, j] = variance[j, i] = size
                normal[i, j] = normal[j, i] = size - product(drawn, a.half, b.half)
        return right, normal, variance

    def amplitudes(self, alone: Sequence[ForwardModel]) -> tuple[F64, F64, float]:
        """Relative amplitudes of jointly acting models, errors, and joint significance."""
        return self.together([self.template(one) for one in alone])

    def together(self, templates: Sequence[Template]) -> tuple[F64, F64, float]:
        """As `amplitudes`, given the change by each model."""
        right, normal, variance = self.sums(templates)
        inverse = inverse_normal(normal, SINGULAR)
        size = inverse @ right
        error = np.sqrt(np.maximum(np.diag(inverse @ variance @ inverse), 0))
        if len(size) == 1:
            return size, error, float(right[0] / max(variance[0, 0], 1e-300) ** 0.5)
        square = float(right @ inverse_normal(variance, SINGULAR) @ right)
        return size, error, sigmas(log_chance(square / 2, (len(size) + 1) // 2))

    def _each_strength(self, model: ForwardModel) -> list[ForwardModel]:
        null, values = model.scaled(0.0), numbers(model)
        return [with_numbers(null, {key: values[key]}) for key in self.strengths]

    def result(self, start: ForwardModel) -> Scored | None:
        """The fit, from the default effect."""
        shape, (size, error, sigma), tried = self._best_shape(start)
        if not np.any(error > 0):
            return None
        significance = sigmas(log_chance_of_any([float(log_ndtr(-sigma))] * tried))
        model, errors = self._scaled(shape, size, error)
        if significance > HINT and not model.is_null:
            model, errors = self._fitted(model, errors)
        if self.response.random:
            # An acquisition holds a single draw, whose scatter dominates at high significance.
            for name, scatter in self._scatter(model).items():
                errors[name] = float(np.hypot(errors[name], scatter))
        why = RANDOM if self.response.random else STEADY
        keys, template = self.telling(shape)
        telling = dataclasses.replace(self.response, keys=keys)
        return Scored(model, errors, significance, why, telling, template)

    def _scatter(self, model: ForwardModel) -> dict[str, float]:
        """Scatter of the strengths of a random model over single draws."""
        values = {n: v for n, v in numbers(model).items() if n in self.strengths and v}
        if not values:
            return {}
        null, product = model.scaled(0.0), self.changes.product
        alone = [self.template(with_numbers(null, {n: v})) for n, v in values.items()]
        inverse = inverse_normal(self.sums(alone)[1], SINGULAR)
        sizes = [
            inverse @ [product(self.response.keys, one.mean, drawn) for one in alone]
            for drawn in self.changes.draws(model, self.response)
        ]
        # Half of that of their squares, relatively.
        scatter = np.std(sizes, axis=0, ddof=1) / 2
        return {n: abs(v) * float(s) for (n, v), s in zip(values.items(), scatter, strict=True)}

    def _best_shape(self, start: ForwardModel) -> tuple[ForwardModel, tuple[F64, F64, float], int]:
        """Best other parameters than strengths, one by one on a grid; and the number of trials."""
        best, fit, tried = start, self.amplitudes(self._each_strength(start)), 1
        for name in _shapes(start):
            for factors in GRID:
                value = numbers(best)[name]
                for factor in factors:
                    changed = with_numbers(best, {name: value * factor})
                    if changed == best:
                        continue
                    tried += 1
                    other = self.amplitudes(self._each_strength(changed))
                    if other[2] > fit[2]:
                        best, fit = changed, other
                if fit[2] < HINT:
                    break
        return best, fit, tried

    def telling(self, model: ForwardModel) -> tuple[tuple[Key, ...], Template | None]:
        """Most informative deviations, and their change if it is valid for other frames."""
        template = self.template(model)
        mean, every = template.mean, self.response.keys
        sizes = {k: self.changes.product((k,), mean, mean) for k in every}
        least, whole = TELLING * sum(sizes.values()), self.changes.product(every, mean, mean)

        def lost(key: Key) -> float:
            """Information lost without a map: even a map without the effect shows common noise."""
            return whole - self.changes.product([k for k in every if k != key], mean, mean)

        keys = tuple(k for k in every if max(sizes[k], lost(k)) >= least)
        elsewhere = not any(name in LINEAR for _, name in keys)
        return keys, template.only(keys) if elsewhere else None

    def _scaled(
        self, shape: ForwardModel, size: F64, error: F64
    ) -> tuple[ForwardModel, dict[str, float]]:
        """A model of these amplitudes: square roots if they are from second moments."""
        power = 0.5 if self.response.random else 1.0
        values, errors, usual = {}, {}, numbers(shape)
        for name, a, da in zip(self.strengths, size, error, strict=True):
            values[name] = float(usual[name] * np.sign(a) * abs(a) ** power)
            error = root_with_error(a, da)[1] if self.response.random else da
            errors[name] = float(abs(usual[name]) * error)
        return with_numbers(shape, values), {n: e for n, e in errors.items() if e > 0}

    def _fitted(
        self, model: ForwardModel, errors: dict[str, float]
    ) -> tuple[ForwardModel, dict[str, float]]:
        """Fit all parameters by Gauss-Newton steps."""
        names = [n for n in self.strengths if numbers(model)[n]] + _shapes(model)
        at = self.template(model)
        misfit = self._misfit(at)
        for _ in range(ROUNDS):
            slopes = self._slopes(model, names, at)
            right, normal, variance = self.sums(list(slopes.values()), at)
            inverse = inverse_normal(normal, SINGULAR)
            covariance = np.diag(inverse @ variance @ inverse)
            errors |= {n: float(v) ** 0.5 for n, v in zip(slopes, covariance, strict=True) if v > 0}
            step = dict(zip(slopes, inverse @ right, strict=True))
            gain = 0.0
            for _ in range(HALVINGS):
                moved = _moved(model, step)
                there = self.template(moved)
                gain = misfit - self._misfit(there)
                if gain > 0:
                    model, at, misfit = moved, there, misfit - gain
                    break
                step = {name: size / 2 for name, size in step.items()}
            if gain < CONVERGED:
                break
        return model, errors

    def _slopes(
        self, model: ForwardModel, names: Sequence[str], at: Template
    ) -> dict[str, Template]:
        """Derivatives of the deviations by parameters."""
        slopes = {}
        for name in names:
            value = numbers(model)[name]
            moved = with_numbers(model, {name: value * STEP})
            if moved == model:
                moved = with_numbers(model, {name: value / STEP})
            if step := numbers(moved)[name] - value:
                slopes[name] = at.slope(self.template(moved), step)
        return slopes

    def _misfit(self, at: Template) -> float:
        """Weighted square of the residuals of a model, less that of the deviations."""
        keys, product = self.response.keys, self.changes.product
        rest = {k: at.mean[k] - 2 * self.changes.measured(k).value for k in keys}
        drawn = [k for k in keys if k in at.half]
        return product(keys, at.mean, rest) - product(drawn, at.half, at.half)


def _shapes(model: ForwardModel) -> list[str]:
    """Numbers that can be fitted, other than strengths."""
    return [k for k, v in numbers(model).items() if v and field_of(k) not in model.strengths]


def _moved(model: ForwardModel, step: Mapping[str, float]) -> ForwardModel:
    """The model with parameters changed, each by at most a factor of `MAX_FACTOR`."""
    new, values = {}, numbers(model)
    for name, size in step.items():
        value = values[name]
        low, high = sorted((value / MAX_FACTOR, value * MAX_FACTOR))
        new[name] = float(np.clip(value + size, low, high))
    return with_numbers(model, new)
