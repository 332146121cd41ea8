"""Variance components of a series: white noise and random walks.

Walk modes of white noise and of a random walk are independent. Each mode is a normal vector of
covariance ``sum_i size_i part_i`` about ``known @ beta``. The sizes are estimated by restricted
maximum likelihood (Patterson & Thompson 1971, Biometrika 58, 545), by Fisher scoring, and near the
end with the average information (Gilmour, Thompson & Cullis 1995, Biometrics 51, 1440).
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.linalg import eigh_tridiagonal
from scipy.optimize import brentq
from scipy.special import ndtri_exp

from pixcal.kernels.normal_matrix import inverse_normal, root_diagonal
from pixcal.kernels.significance import log_of_any, root_with_error
from pixcal.model.arrays import F64, Mask

MAX_STEPS = 60
CONVERGED = 1e-5  # gain in log-likelihood at which scoring ends
_DOUBLINGS = 60  # of an error, in the search for the upper limit of a size
HALVINGS = 12  # of a step that does not raise the likelihood
FAR = 1e3  # gain by the signals' first step above which they are fitted before the noise
NEAR = 2.0  # gain below which steps use the average information
SHORTEST = 0.1  # least step in time, over the median one


def trace_products(weight: F64, parts: F64) -> F64:
    """Sum over modes of tr(W D_i W D_j), (m, m), of weights (n, c, c) and parts (c, c, m, n)."""
    weights, each = np.ascontiguousarray(weight.transpose(1, 2, 0)), range(len(parts))
    products = [[sum(weights[a, k] * parts[k, b] for k in each) for b in each] for a in each]
    return np.asarray(sum(products[a][b] @ products[b][a].T for a in each for b in each))


@dataclass(frozen=True)
class Modes:
    """Walk modes of one or more series of ``c`` channels, and the parts of their covariance."""

    values: F64  # (n, c)
    known: F64  # (n, c, p) fitted shapes, each with a coefficient
    parts: F64  # (m, n, c, c) covariance of each mode for unit sizes
    # start, least: (m,) initial and lowest sizes; the latter below zero, so that an absent part
    # may have an estimate of either sign
    start: F64
    least: F64
    share: float = 1.0  # share of independent modes, a factor of the log-likelihood

    @property
    def flat(self) -> F64:
        """``parts`` as (m, n c c), for sums over modes and channels."""
        return self.parts.reshape(len(self.parts), -1)

    @cached_property
    def by_channel(self) -> F64:
        """``parts`` as (c, c, m, n), for sums over the modes."""
        return np.ascontiguousarray(self.parts.transpose(2, 3, 0, 1))


@dataclass(frozen=True)
class Components:
    """Estimated sizes and their likelihood."""

    size: F64  # (m,)
    free: Mask  # (m,) sizes that were free
    beta: F64  # beta, beta_covariance: (p,), (p, p) coefficients of the known shapes
    beta_covariance: F64
    likelihood: float  # restricted log-likelihood; comparable for the same known shapes only
    profile: float  # unrestricted log-likelihood; comparable for all known shapes
    modes: Modes  # the data

    @cached_property
    def covariance(self) -> F64:
        """Covariance (m, m) of ``size``; zero for fixed sizes."""
        covariance = np.zeros((len(self.size),) * 2)
        inside = np.ix_(self.free, self.free)
        covariance[inside] = inverse_normal(_State(self.modes, self.size).information()[inside])
        return covariance

    def above(self, part: int) -> float:
        """Upper 1-sigma error of a size, at which the likelihood has fallen by exp(-1/2)."""
        # A walk dominates few modes, so its true size may be far above the estimate.
        sizes = self.size.copy()
        sizes[part] = value = max(float(sizes[part]), 0.0)
        top = _State(self.modes, sizes).likelihood

        def left(above: float) -> float:
            sizes[part] = value + above
            return _State(self.modes, sizes).likelihood - top + 0.5

        width = max(float(np.sqrt(self.covariance[part, part])), 1e-300)
        for _ in range(_DOUBLINGS):
            if left(width) <= 0:
                break
            width *= 2
        else:
            return width  # The modes set no upper limit.
        return width * float(brentq(lambda share: left(share * width), 0.0, 1.0, xtol=1e-3))

    def root(self, part: int) -> tuple[float, float]:
        """Standard deviation of a part, and its error from `above`."""
        below = float(np.sqrt(self.covariance[part, part]))
        root, error = root_with_error(self.size[part], self.above(part), below)
        return float(root), float(error)

    def shape_covariance(self, uncertain: Sequence[int]) -> F64:
        """Covariance (p, p) of ``beta``, a third of it at the sizes' upper limits (simulated)."""
        sizes = np.maximum(self.size, 0.0)
        for part in uncertain:
            sizes[part] += self.above(part)
        return np.asarray((2 * self.beta_covariance + _State(self.modes, sizes).spread) / 3)


def estimate_components(
    modes: Modes,
    absent: Sequence[int] = (),
    start: Components | None = None,
    steps: int = MAX_STEPS,
) -> Components:
    """Sizes of the parts by restricted maximum likelihood; ``absent`` ones are fixed at zero."""
    free = np.ones(len(modes.parts), bool)
    free[list(absent)] = False
    state: _State | None = None
    if start is not None:
        # Negative sizes of another fit may be too low here.
        with suppress(np.linalg.LinAlgError):
            state = _State(modes, np.where(free, np.maximum(start.size, modes.least), 0.0))
    state = state or _State(modes, np.where(free, modes.start, 0.0))
    # Far from the maximum, a step of all sizes attributes signal to noise.
    signals = free & (modes.start == 0)
    state, gained = _climbed(state, signals, 1) if steps and signals.any() else (state, 0.0)
    if gained > FAR:
        state, _ = _climbed(state, signals, steps)
    state, _ = _climbed(state, free, steps)
    return Components(
        state.size, free, state.beta, state.spread, state.likelihood, state.profile, modes
    )


def _climbed(state: "_State", free: Mask, steps: int) -> tuple["_State", float]:
    """State after at most ``steps`` steps of the free sizes, and the gain of the last step."""
    modes, gain = state.modes, np.inf
    for _ in range(steps):
        score = state.score()
        information = state.information() if gain > NEAR else state.average_information()
        held = ~free | ((state.size <= modes.least) & (score <= 0))
        step = np.zeros(len(held))
        step[~held] = inverse_normal(information[np.ix_(~held, ~held)]) @ score[~held]
        moved = state
        for _ in range(HALVINGS):
            with suppress(np.linalg.LinAlgError):
                least = np.where(free, modes.least, state.size)
                moved = _State(modes, np.maximum(state.size + step, least))
            if moved.likelihood > state.likelihood:
                break
            step /= 2
        gain = moved.likelihood - state.likelihood
        if gain <= 0:
            break
        state = moved
        if gain < CONVERGED:
            break
    return state, gain


class _State:
    """Likelihood at given sizes, and its slope; LinAlgError if a covariance is not positive."""

    def __init__(self, modes: Modes, size: F64) -> None:
        self.modes, self.size = modes, size
        covariance = (size @ modes.flat).reshape(modes.parts.shape[1:])
        self.weight, log_determinant = _swept(covariance)
        self.weighted = self.weight @ modes.known
        normal = np.tensordot(modes.known, self.weighted, axes=((0, 1), (0, 1)))
        self.spread = inverse_normal(normal)
        self.beta = self.spread @ np.tensordot(self.weighted, modes.values, ((0, 1), (0, 1)))
        rest = modes.values - modes.known @ self.beta
        self.pull = (self.weight @ rest[:, :, None])[:, :, 0]
        square = float(log_determinant + np.einsum("na,na->", rest, self.pull))
        self.profile = -0.5 * modes.share * square
        self.likelihood = self.profile - 0.5 * modes.share * _log_determinant(normal)

    def score(self) -> F64:
        """Slope of the log-likelihood (m,)."""
        seen = self.pull[:, :, None] * self.pull[:, None, :]
        # Scatter that the fit of the known shapes removes.
        lost = (self.weighted @ self.spread) @ self.weighted.swapaxes(1, 2)
        more = self.modes.flat @ (seen - self.weight + lost).ravel()
        return np.asarray(self.modes.share * more / 2)

    def average_information(self) -> F64:
        """Mean (m, m) of the Fisher information and the curvature of the log-likelihood."""
        # Channel by channel, because einsum is slow for such short axes.
        parts, each = self.modes.by_channel, range(len(self.modes.by_channel))
        pull, weight = self.pull.T, self.weight.transpose(1, 2, 0)
        pulled = [sum(parts[a, b] * pull[b] for b in each) for a in each]
        weighed = [sum(weight[a, b] * pulled[b] for b in each) for a in each]
        known = sum(pulled[a] @ self.weighted[:, a] for a in each)
        fisher = sum(pulled[a] @ weighed[a].T for a in each)
        return np.asarray(self.modes.share * (fisher - known @ self.spread @ known.T) / 2)

    def information(self) -> F64:
        """Fisher information of the sizes (m, m)."""
        return np.asarray(self.modes.share * trace_products(self.weight, self.modes.by_channel) / 2)


def _swept(covariance: F64) -> tuple[F64, float]:
    """Inverses (n, c, c) of covariances, and the summed logarithms of their determinants."""
    # By the sweep operator over all modes at once (Goodnight 1979, American Statistician 33, 149).
    matrix, log_determinant = np.ascontiguousarray(covariance.transpose(1, 2, 0)), 0.0
    for k in range(len(matrix)):
        pivot, row = matrix[k, k].copy(), matrix[k].copy()
        if not pivot.min(initial=np.inf) > 0:
            raise np.linalg.LinAlgError("a covariance is not positive")
        log_determinant += float(np.log(pivot).sum())
        scaled = row / pivot
        matrix -= row[:, None] * scaled
        matrix[k] = matrix[:, k] = scaled
        matrix[k, k] = -1 / pivot
    return np.ascontiguousarray(-matrix.transpose(2, 0, 1)), log_determinant


def _log_determinant(matrix: F64) -> float:
    """Logarithm of the determinant, without eigenvalues that `inverse_normal` leaves out."""
    scale = root_diagonal(matrix)
    values = np.linalg.eigvalsh(matrix / np.outer(scale, scale))
    kept = values > 1e-9 * values.max(initial=0.0)
    return float(np.log(values[kept]).sum() + 2 * np.log(scale).sum())


def signed_sigmas(growth: float, size: float) -> float:
    """Signed significance (standard deviations) of a part from its gain in log-likelihood."""
    return float(np.copysign(np.sqrt(max(2 * growth, 0.0)), size))


def log_chance(growth: float, pairs: int = 1) -> float:
    """Log probability that ``2 * pairs`` parameters bring such a log-likelihood gain by chance."""
    # Tail of chi-square with an even number of degrees of freedom: a finite sum.
    x = max(growth, 0.0)
    terms = np.cumprod(np.concatenate([[1.0], x / np.arange(1, pairs)]))
    return float(np.log(terms.sum()) - x)


def joint_log_chance(full: Components, less: Components, sizes: F64) -> float:
    """Log probability that two absent parts have estimates as large as ``sizes`` (2,) by chance."""
    growth = full.likelihood - less.likelihood
    # Both estimates are negative in one case of four.
    if np.any(sizes > 0):
        return float(np.log(0.75)) + log_chance(growth)
    return float(np.log1p(-0.25 * np.exp(-max(growth, 0.0))))


def log_chance_of_any(log_chances: Sequence[float]) -> float:
    """Log probability that the rarest of several independent findings is as rare by chance."""
    return log_of_any(float(min(*log_chances, -1e-12)), len(log_chances))


def sigmas(log_chance: float) -> float:
    """Normal deviate (standard deviations) of a one-sided log probability."""
    return -float(ndtri_exp(min(log_chance, -1e-6)))


# Modes of a series in which white noise and a random walk are independent


@dataclass(frozen=True, eq=False)
class WalkModes:
    """Walk modes of series of t frames."""

    vectors: F64  # (t - 1, t) orthonormal, slowest first
    walk: F64  # (t - 1,) variance, s, of the modes of a random walk of unit variance per second

    def of(self, series: F64) -> F64:
        """Modes (t - 1, ...) of series (t, ...)."""
        return np.asarray(np.tensordot(self.vectors, series, 1))

    def series(self, modes: F64) -> F64:
        """Zero-mean series (t, ...) from modes (t - 1, ...)."""
        return np.asarray(np.tensordot(self.vectors.T, modes, 1))


def walk_modes(time_s: F64) -> WalkModes:
    """Walk modes for ascending times (t,), s."""
    return _modes(np.ascontiguousarray(time_s, float).tobytes())


@lru_cache(maxsize=16)
def _modes(times: bytes) -> WalkModes:
    steps = np.diff(np.frombuffer(times))
    usual = float(np.median(steps)) if len(steps) else 1.0
    # Inverse covariance of a walk without its mean: weighted differences of neighbours.
    weight = 1 / np.maximum(steps, SHORTEST * usual if usual > 0 else 1.0)
    diagonal = np.append(weight, 0.0) + np.append(0.0, weight)
    values, vectors = eigh_tridiagonal(diagonal, -weight)
    return WalkModes(np.ascontiguousarray(vectors.T[1:]), 1 / values[1:])
