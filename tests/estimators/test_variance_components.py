"""Components of variance: white noise and walks told apart, with honest errors."""

import numpy as np
import pytest
from scipy.fft import dct
from scipy.stats import chi2, norm

from pixcal.estimators.frame_series.profiled import best_shape
from pixcal.estimators.frame_series.variance_components import (
    Components,
    Modes,
    _State,
    estimate_components,
    joint_log_chance,
    log_chance,
    log_chance_of_any,
    sigmas,
    signed_sigmas,
    trace_products,
    walk_modes,
)
from pixcal.kernels.processes import autoregression

T = 199
EVEN = walk_modes(np.arange(float(T)))


def modes_of(series: np.ndarray, *powers: np.ndarray, known: np.ndarray | None = None) -> Modes:
    """One channel of unit noise, and parts of some powers."""
    n, basis = len(series) - 1, walk_modes(np.arange(float(len(series))))
    parts = np.stack([*powers])[..., None, None]
    return Modes(
        values=basis.of(series)[:, None],
        known=np.zeros((n, 1, 0)) if known is None else basis.of(known)[:, None, :],
        parts=parts,
        start=np.array([1.0] + [0.0] * (len(powers) - 1)),
        least=np.array([0.05] + [-0.1 / power.max() for power in powers[1:]]),
    )


def white_and_walk(rng: np.random.Generator, step: float) -> np.ndarray:
    return rng.standard_normal(T) + step * np.cumsum(rng.standard_normal(T))


PAUSED = np.concatenate([np.arange(13.0), 40 + np.arange(9.0), 60.5 + 0.5 * np.arange(9)])


@pytest.mark.parametrize("time_s", [np.arange(31.0), PAUSED], ids=["even", "with pauses"])
def test_modes_of_white_noise_and_a_walk_are_independent_and_of_the_power_that_is_said(
    time_s: np.ndarray,
) -> None:
    # The covariance itself, by the modes of the identity and of a walk's steps.
    modes, n = walk_modes(time_s), len(time_s)
    white = modes.of(np.eye(n))
    walk = modes.of(np.tril(np.ones((n, n))) * np.sqrt(np.diff(time_s, prepend=time_s[0] - 1)))
    np.testing.assert_allclose(white @ white.T, np.eye(n - 1), atol=1e-12)
    np.testing.assert_allclose(walk @ walk.T, np.diag(modes.walk), atol=1e-8)
    series = np.random.default_rng(1).standard_normal((n, 2))
    np.testing.assert_allclose(modes.series(modes.of(series)), series - series.mean(axis=0))


def test_modes_of_equal_steps_are_cosines_in_order_of_frequency() -> None:
    series = np.random.default_rng(2).standard_normal(31)
    cosines = dct(series, type=2, norm="ortho")[1:]
    modes = walk_modes(0.14 * np.arange(31))
    np.testing.assert_allclose(np.abs(modes.of(series)), np.abs(cosines), atol=1e-10)
    assert np.all(np.diff(modes.walk) < 0)


def damped_power(frames: int, keep: float) -> np.ndarray:
    """Of the cosine modes of a first-order autoregression of unit variance."""
    angle = np.pi * np.arange(1, frames) / frames
    return np.asarray((1 - keep**2) / (1 + keep**2 - 2 * keep * np.cos(angle)))


def test_a_damped_walk_has_the_power_that_is_said() -> None:
    rng, modes = np.random.default_rng(3), walk_modes(np.arange(400.0))
    power = np.mean(
        [modes.of(autoregression(rng.standard_normal(400), 0.9)) ** 2 for _ in range(400)], axis=0
    )
    ratio = power / damped_power(400, 0.9)
    blocks = ratio[: 19 * 21].reshape(19, 21).mean(axis=1)
    np.testing.assert_allclose(blocks, 1.0, atol=0.1)


def test_the_slope_of_the_likelihood_is_its_derivative() -> None:
    rng = np.random.default_rng(4)
    time = np.linspace(-1, 1, T)
    modes = modes_of(
        white_and_walk(rng, 0.3) + 5 * time, np.ones(T - 1), EVEN.walk, known=time[:, None]
    )
    size = np.array([1.3, 0.05])
    score = _State(modes, size).score()
    for part, step in enumerate((1e-4, 1e-5)):
        up, down = size.copy(), size.copy()
        up[part] += step
        down[part] -= step
        slope = (_State(modes, up).likelihood - _State(modes, down).likelihood) / (2 * step)
        assert score[part] == pytest.approx(slope, rel=1e-3, abs=1e-3)


def test_a_variance_by_itself_is_the_sample_variance() -> None:
    series = 3 * np.random.default_rng(5).standard_normal(T)
    found = estimate_components(modes_of(series, np.ones(T - 1)))
    assert found.size[0] == pytest.approx(series.var(ddof=1))
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(series.var(ddof=1) * np.sqrt(2 / 198))


def test_sizes_and_errors_are_honest() -> None:
    rng, step = np.random.default_rng(6), 0.1
    pulls, ramps = [], []
    time = np.linspace(-1, 1, T)
    for _ in range(100):
        series = white_and_walk(rng, step) + 2.0 * time
        modes = modes_of(series, np.ones(T - 1), EVEN.walk, known=time[:, None])
        found = estimate_components(modes)
        rms, error = found.root(1)
        pulls.append((rms - step) / error)
        ramps.append((found.beta[0] - 2.0) / np.sqrt(found.shape_covariance([1])[0, 0]))
    assert abs(np.mean(pulls)) < 0.7
    assert 0.6 < np.std(pulls) < 1.4
    # The walk is known from a handful of modes: more tails than a normal.
    assert 0.5 < np.mean(np.abs(ramps) < 1) < 0.85
    assert np.mean(np.abs(ramps) < 2) > 0.8


@pytest.mark.parametrize("size", [1e3, 1e5])
def test_a_drift_far_above_the_noise_is_a_walk(size: float) -> None:
    """Not noise of two channels, whose covariance the first step would take below zero."""
    rng = np.random.default_rng(9)
    ramp = size * np.linspace(-1, 1, T)
    channels = [EVEN.of(rng.standard_normal(T) + sign * ramp) for sign in (1, -1)]
    one = np.ones(T - 1)[:, None, None]
    eye, cross = np.diag([1.0, 0.0]), np.array([[0.0, 0.3], [0.3, 0.0]])
    white, walk = [one * eye, one * eye[::-1, ::-1]], EVEN.walk[:, None, None]
    modes = Modes(
        values=np.stack(channels, axis=1),
        known=np.zeros((T - 1, 2, 0)),
        parts=np.stack(
            [walk * eye, walk * eye[::-1, ::-1], *white, white[0], one * cross, white[1]]
        ),
        start=np.array([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]),
        least=np.array([-1e-3, -1e-3, -0.01, -0.01, 0.05, -np.inf, 0.05]),
    )
    found = estimate_components(modes)
    # Its steps are all alike: 2 size over T frames.
    assert found.size[:2] == pytest.approx((2 * size / T) ** 2, rel=0.5)


def test_chances_are_those_of_chi_square_and_sigmas_those_of_a_normal() -> None:
    for pairs in (1, 2, 5):
        for growth in (0.1, 3.0, 40.0):
            assert log_chance(growth, pairs) == pytest.approx(chi2.logsf(2 * growth, 2 * pairs))
    for size in (-1.0, 0.0, 3.0, 12.0):
        assert sigmas(norm.logsf(size)) == pytest.approx(size, abs=1e-6)
    assert sigmas(-1e6) > 1000
    assert signed_sigmas(2.0, -1.0) == -2.0
    two = log_chance_of_any([np.log(0.3), np.log(0.5)])
    assert two == pytest.approx(np.log(1 - 0.7**2))
    assert log_chance_of_any([-500.0, 0.0]) == pytest.approx(-500 + np.log(2))


def test_what_is_not_there_comes_out_normal() -> None:
    rng = np.random.default_rng(7)
    found = []
    for _ in range(150):
        modes = modes_of(white_and_walk(rng, 0.0), np.ones(T - 1), EVEN.walk)
        full, less = estimate_components(modes), estimate_components(modes, absent=[1])
        found.append(signed_sigmas(full.likelihood - less.likelihood, full.size[1]))
        assert less.size[1] == 0
        assert full.likelihood >= less.likelihood - 1e-6
    assert max(found) < 4
    assert abs(np.mean(found)) < 0.4
    assert 0.5 < np.std(found) < 1.2


@pytest.mark.long
def test_two_parts_together_are_as_rare_as_they_should_be() -> None:
    rng = np.random.default_rng(8)
    chances = []
    for _ in range(150):
        series = rng.standard_normal((T, 2))
        unit = np.ones((T - 1, 1, 1))
        x, y = np.diag([1.0, 0.0]) * unit, np.diag([0.0, 1.0]) * unit
        half = np.zeros_like(x)
        # Noise is seen alone in a second series.
        modes = Modes(
            values=EVEN.of(np.hstack([series, rng.standard_normal((T, 2))])).reshape(-1, 2),
            known=np.zeros((2 * (T - 1), 2, 0)),
            parts=np.stack(
                [
                    np.stack([part, other], axis=1).reshape(-1, 2, 2)
                    for part, other in ((x, half), (y, half), (x, x), (y, y))
                ]
            ),
            start=np.array([0.0, 0.0, 1.0, 1.0]),
            least=np.array([-0.3, -0.3, 0.05, 0.05]),
        )
        full, less = estimate_components(modes), estimate_components(modes, absent=[0, 1])
        chances.append(np.exp(joint_log_chance(full, less, full.size[:2])))
    assert np.quantile(chances, [0.1, 0.5, 0.9]) == pytest.approx([0.1, 0.5, 0.9], abs=0.12)


def test_a_time_constant_is_found() -> None:
    rng = np.random.default_rng(9)
    pulls = []
    for _ in range(6):
        slow = autoregression(rng.standard_normal(600), np.exp(-0.1))
        series = rng.standard_normal(600) + 2 * slow

        def fit(
            value: float, start: Components | None, steps: int = 60, series: np.ndarray = series
        ) -> Components:
            power = damped_power(600, float(np.exp(-1 / value)))
            modes = modes_of(series, np.ones(599), power)
            return estimate_components(modes, start=start, steps=steps)

        profile = best_shape(fit, np.geomspace(0.3, 1200.0, 9), steady=False)
        rms, error = profile.components.root(1)
        owed = profile.slope([side.root(1)[0] for side in profile.sides])
        pulls.append((profile.value - 10) / profile.error)
        assert abs(rms - 2) < 4 * np.hypot(error, owed) < 2.0
    assert np.max(np.abs(pulls)) < 3.5


def test_sums_of_traces() -> None:
    rng = np.random.default_rng(2)
    n, m = 23, 5
    weight = rng.standard_normal((n, 2, 2))
    weight = weight + np.swapaxes(weight, 1, 2)
    parts = rng.standard_normal((m, n, 2, 2))
    parts = parts + np.swapaxes(parts, 2, 3)
    parts[1, 3:], parts[4, :10] = 0.0, 0.0
    product = np.einsum("nab,inbc->inac", weight, parts)
    np.testing.assert_allclose(
        trace_products(weight, parts.transpose(2, 3, 0, 1)),
        np.einsum("inab,jnba->ij", product, product),
        rtol=1e-10,
    )
