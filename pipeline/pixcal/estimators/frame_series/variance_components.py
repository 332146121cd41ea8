"""Components of a series' variance: white noise and random walks.

In walk modes white noise and a walk are independent from mode to mode. Each mode is a normal vector
of covariance ``sum_i size_i part_i`` about ``known @ beta``. The sizes are those of restricted
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
from pixcal.kernels.significance import root_with_error
from pixcal.model.arrays import F64, Mask

MAX_STEPS = 60
CONVERGED = 1e-5  # growth of the log-likelihood at which scoring ends
_DOUBLINGS = 60  # of an error in search of the upper limit of a size
HALVINGS = 12  # of a step that does not make the data likelier
FAR = 1e3  # growth by the signals' first step above which they are fitted before the noise
NEAR = 2.0  # growth below which steps use the average information
SHORTEST = 0.1  # least step in time, over the median one


def trace_products(weight: F64, parts: F64) -> F64:
    """Sum over modes of tr(W D_i W D_j), (m, m), of weights (n, c, c) and parts (c, c, m, n)."""
    own, each = np.ascontiguousarray(weight.transpose(1, 2, 0)), range(len(parts))
    products = [[sum(own[a, k] * parts[k, b] for k in each) for b in each] for a in each]
    return np.asarray(sum(products[a][b] @ products[b][a].T for a in each for b in each))


@dataclass(frozen=True)
class Modes:
    """Walk modes of one or more series of ``c`` channels, and the parts of their covariance."""

    values: F64  # (n, c)
    known: F64  # (n, c, p) shapes that are fitted, each by a coefficient
    parts: F64  # (m, n, c, c) covariance of each mode for unit sizes
    # start, least: (m,) sizes to begin with and lowest ones; below zero, so that what is not
    # there may come out either side of nothing
    start: F64
    least: F64
    share: float = 1.0  # of the modes that are independent: the likelihood counts no more

    @property
    def flat(self) -> F64:
        """``parts`` as (m, n c c), for sums over all else."""
        return self.parts.reshape(len(self.parts), -1)

    @cached_property
    def by_channel(self) -> F64:
        """``parts`` as (c, c, m, n), for sums over the modes."""
        return np.ascontiguousarray(self.parts.transpose(2, 3, 0, 1))


@dataclass(frozen=True)
class Components:
    """Sizes found, and how well."""

    size: F64  # (m,)
    free: Mask  # (m,) sizes that were not held
    beta: F64  # beta, beta_covariance: (p,), (p, p) coefficients of the known shapes
    beta_covariance: F64
    likelihood: float  # logarithm, restricted; comparable where the known shapes are the same
    profile: float  # logarithm, not restricted; comparable whatever the known shapes
    modes: Modes  # that it is of

    @cached_property
    def covariance(self) -> F64:
        """Covariance (m, m) of ``size``; zero for those that were held."""
        found = np.zeros((len(self.size),) * 2)
        inside = np.ix_(self.free, self.free)
        found[inside] = inverse_normal(_State(self.modes, self.size).information()[inside])
        return found

    def above(self, part: int) -> float:
        """1-sigma error of a size, upwards: where the likelihood has fallen by exp(-1/2)."""
        # A walk shows in few modes: a small one found in them may well be a large one.
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
        """Standard deviation of a part, and its error by `above`."""
        below = float(np.sqrt(self.covariance[part, part]))
        root, error = root_with_error(self.size[part], self.above(part), below)
        return float(root), float(error)

    def shape_covariance(self, uncertain: Sequence[int]) -> F64:
        """Covariance (p, p) of ``beta``: by simulation, a third at the limits of the sizes."""
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
    """Sizes of the parts by restricted maximum likelihood; ``absent`` ones are held at zero."""
    free = np.ones(len(modes.parts), bool)
    free[list(absent)] = False
    state = _begin(modes, free, start)
    # Far from the maximum a step of all sizes gives to the noise what is a signal.
    signals = free & (modes.start == 0)
    state, gained = _climbed(state, signals, 1) if steps and signals.any() else (state, 0.0)
    if gained > FAR:
        state, _ = _climbed(state, signals, steps)
    state, _ = _climbed(state, free, steps)
    return Components(
        state.size, free, state.beta, state.spread, state.likelihood, state.profile, modes
    )


def _climbed(state: "_State", free: Mask, steps: int) -> tuple["_State", float]:
    """After so many steps of some sizes, or where none helps; and how much likelier the last is."""
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


def _begin(modes: Modes, free: Mask, start: Components | None) -> "_State":
    if start is not None:
        try:
            return _State(modes, np.where(free, np.maximum(start.size, modes.least), 0.0))
        except np.linalg.LinAlgError:
            pass  # Sizes below zero elsewhere may be too low here: from the beginning.
    return _State(modes, np.where(free, modes.start, 0.0))


class _State:
    """Likelihood of the modes at given sizes, and its slope; LinAlgError if not positive."""

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
        # What the fit of the known shapes takes away of the scatter.
        lost = (self.weighted @ self.spread) @ self.weighted.swapaxes(1, 2)
        more = self.modes.flat @ (seen - self.weight + lost).ravel()
        return np.asarray(self.modes.share * more / 2)

    def average_information(self) -> F64:
        """Mean (m, m) of Fisher's information and of the curvature of the log-likelihood."""
        # Channel by channel: einsum is slow over axes this short.
        parts, each = self.modes.by_channel, range(len(self.modes.by_channel))
        pull, weight = self.pull.T, self.weight.transpose(1, 2, 0)
        pulled = [sum(parts[a, b] * pull[b] for b in each) for a in each]
        weighed = [sum(weight[a, b] * pulled[b] for b in each) for a in each]
        known = sum(pulled[a] @ self.weighted[:, a] for a in each)
        fisher = sum(pulled[a] @ weighed[a].T for a in each)
        return np.asarray(self.modes.share * (fisher - known @ self.spread @ known.T) / 2)

    def information(self) -> F64:
        """Fisher's information of the sizes (m, m)."""
        return np.asarray(self.modes.share * trace_products(self.weight, self.modes.by_channel) / 2)


def _swept(covariance: F64) -> tuple[F64, float]:
    """Inverses (n, c, c) of covariances, and the summed logarithms of their determinants.

    By the sweep operator over all modes at once (Goodnight 1979, American Statistician 33, 149).
    """
    own, log_determinant = np.ascontiguousarray(covariance.transpose(1, 2, 0)), 0.0
    for k in range(len(own)):
        pivot, row = own[k, k].copy(), own[k].copy()
        if not pivot.min(initial=np.inf) > 0:
            raise np.linalg.LinAlgError("a covariance is not positive")
        log_determinant += float(np.log(pivot).sum())
        scaled = row / pivot
        own -= row[:, None] * scaled
        own[k] = own[:, k] = scaled
        own[k, k] = -1 / pivot
    return np.ascontiguousarray(-own.transpose(2, 0, 1)), log_determinant


def _log_determinant(matrix: F64) -> float:
    """Logarithm of the determinant, without what `inverse_normal` leaves out."""
    scale = root_diagonal(matrix)
    values = np.linalg.eigvalsh(matrix / np.outer(scale, scale))
    kept = values > 1e-9 * values.max(initial=0.0)
    return float(np.log(values[kept]).sum() + 2 * np.log(scale).sum())


def signed_sigmas(growth: float, size: float) -> float:
    """Standard deviations by which a part is there, by the growth of the log-likelihood."""
    return float(np.copysign(np.sqrt(max(2 * growth, 0.0)), size))


def log_chance(growth: float, pairs: int = 1) -> float:
    """Logarithm of the chance of such a growth of log-likelihood by ``2 * pairs`` parameters."""
    # Tail of chi-square with an even number of degrees of freedom: a finite sum.
    x = max(growth, 0.0)
    terms = np.cumprod(np.concatenate([[1.0], x / np.arange(1, pairs)]))
    return float(np.log(terms.sum()) - x)


def joint_log_chance(full: Components, less: Components, sizes: F64) -> float:
    """Logarithm of the chance of two absent parts of these sizes (2,) coming out as they did."""
    growth = full.likelihood - less.likelihood
    # One time in four both come out below nothing.
    if np.any(sizes > 0):
        return float(np.log(0.75)) + log_chance(growth)
    return float(np.log1p(-0.25 * np.exp(-max(growth, 0.0))))


def log_chance_of_any(log_chances: Sequence[float]) -> float:
    """Logarithm of the chance that the rarest of several independent findings is as rare."""
    rarest, number = min(*log_chances, 0.0), len(log_chances)
    if rarest < -30:
        return float(rarest + np.log(number))
    return float(np.log(-np.expm1(number * np.log1p(-min(np.exp(rarest), 1 - 1e-12)))))


def sigmas(log_chance: float) -> float:
    """Standard deviations of a normal variable beyond which lies a chance, by its logarithm."""
    return -float(ndtri_exp(min(log_chance, -1e-6)))


# Modes of a series in which white noise and a random walk are independent


@dataclass(frozen=True, eq=False)
class WalkModes:
    """Modes of series of t frames."""

    vectors: F64  # (t - 1, t) orthonormal, slowest first
    walk: F64  # (t - 1,) variance, s, of the modes of a random walk of unit variance a second

    def of(self, series: F64) -> F64:
        """Modes (t - 1, ...) of series (t, ...)."""
        return np.asarray(np.tensordot(self.vectors, series, 1))

    def series(self, modes: F64) -> F64:
        """Series (t, ...), without mean, of some modes (t - 1, ...)."""
        return np.asarray(np.tensordot(self.vectors.T, modes, 1))


def walk_modes(time_s: F64) -> WalkModes:
    """Modes of series at some times (t,), ascending, s."""
    return _modes(np.ascontiguousarray(time_s, float).tobytes())


@lru_cache(maxsize=16)
def _modes(times: bytes) -> WalkModes:
    steps = np.diff(np.frombuffer(times))
    usual = float(np.median(steps)) if len(steps) else 1.0
    # The inverse of a walk's covariance without the mean: differences of neighbours, weighted.
    weight = 1 / np.maximum(steps, SHORTEST * usual if usual > 0 else 1.0)
    diagonal = np.append(weight, 0.0) + np.append(0.0, weight)
    values, vectors = eigh_tridiagonal(diagonal, -weight)
    return WalkModes(np.ascontiguousarray(vectors.T[1:]), 1 / values[1:])
