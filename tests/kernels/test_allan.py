"""Overlapping Allan deviation: published data sets, allantools, a plain oracle, closed forms."""

import allantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pixcal.kernels.allan import allan_deviation, averaging_lengths, disjoint_differences

F64 = NDArray[np.float64]

NBS14 = np.array([892.0, 809, 823, 798, 671, 644, 883, 903, 677])
"""NBS14, the frequencies of ten phases: NBS Monograph 140, annex 8.E; NIST SP 1065, page 107."""


def nist_thousand() -> F64:
    """The 1000 frequencies of NIST SP 1065, page 107: a linear congruence over its modulus."""
    numbers = [1234567890]
    while len(numbers) < 1000:
        numbers.append(16807 * numbers[-1] % 2147483647)
    assert numbers[1:4] == [395529916, 1209410747, 633705974], "as the publication prints them"
    return np.array(numbers) / 2147483647


def by_allantools(series: F64, lengths: list[int]) -> F64:
    taus, deviation, _, _ = allantools.oadev(
        series, data_type="freq", taus=np.array(lengths, float)
    )
    assert list(taus) == lengths
    return np.asarray(deviation)


def by_definition(series: F64, m: int) -> float:
    """One series, the sum over k written out."""
    squares = []
    for k in range(len(series) - 2 * m + 1):
        first, second = series[k : k + m], series[k + m : k + 2 * m]
        if np.isfinite(first).all() and np.isfinite(second).all():
            squares.append((second.mean() - first.mean()) ** 2)
    return float(np.sqrt(np.mean(squares) / 2)) if squares else np.nan


def test_nbs14_as_published() -> None:
    # NIST SP 1065, page 107: overlapping Allan deviation at averaging factors 1 and 2.
    found = allan_deviation(NBS14[:, None], [1, 2])[:, 0]
    assert found == pytest.approx([91.22945, 85.95287], rel=1e-7)
    assert found == pytest.approx(by_allantools(NBS14, [1, 2]), rel=1e-12)


def test_the_thousand_points_as_published() -> None:
    # NIST SP 1065, page 108: overlapping Allan deviation at averaging factors 1, 10 and 100.
    series = nist_thousand()
    found = allan_deviation(series[:, None], [1, 10, 100])[:, 0]
    assert found == pytest.approx([2.922319e-01, 9.159953e-02, 3.241343e-02], rel=3e-7)
    lengths = list(averaging_lengths(1000))
    found = allan_deviation(series[:, None], lengths)[:, 0]
    assert found == pytest.approx(by_allantools(series, lengths), rel=1e-10)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32), n=st.integers(3, 200), pixels=st.sampled_from([1, 3, 127, 131]))
def test_agrees_with_allantools_without_gaps(seed: int, n: int, pixels: int) -> None:
    rng = np.random.default_rng(seed)
    series = rng.normal(size=(n, pixels)).cumsum(axis=0) + rng.normal(size=(n, pixels)) * 3
    lengths = averaging_lengths(n)
    found = allan_deviation(series, lengths)
    column = int(rng.integers(pixels))
    expected = by_allantools(series[:, column], list(lengths))
    assert found[:, column] == pytest.approx(expected, rel=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32), n=st.integers(3, 41), missing=st.floats(0, 0.6))
def test_gaps_are_left_out_and_never_bridged(seed: int, n: int, missing: float) -> None:
    rng = np.random.default_rng(seed)
    series = rng.normal(size=(n, 5))
    series[rng.random((n, 5)) < missing] = np.nan
    lengths = averaging_lengths(n)
    found = allan_deviation(series, lengths)
    expected = [[by_definition(column, m) for column in series.T] for m in lengths]
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_gap_is_not_a_zero() -> None:
    series = np.full((30, 1), 7.0)
    series[10:13] = np.nan
    assert np.all(allan_deviation(series, [1, 2, 4, 8]) == 0)
    assert np.isnan(allan_deviation(series, [10])).all(), "two means of ten do not fit beside it"


def test_each_pixel_stands_alone() -> None:
    rng = np.random.default_rng(3)
    series = rng.normal(size=(37, 389)).astype(np.float32)
    series[rng.random(series.shape) < 0.05] = np.nan
    lengths = averaging_lengths(37)
    whole = allan_deviation(series, lengths)
    for start, stop in ((0, 1), (1, 128), (128, 257), (200, 389)):
        part = allan_deviation(series[:, start:stop], lengths)
        np.testing.assert_array_equal(part, whole[:, start:stop])


@pytest.mark.parametrize("m", [1, 2, 3, 8, 12])
def test_closed_forms(m: int) -> None:
    n = 41
    k = np.arange(n, dtype=float)
    step, alternating = 0.37 * k, np.where(k % 2, 1.0, -1.0)
    found = allan_deviation(np.stack([step, alternating, step + 100], axis=1), [m])[0]
    # A drift: means of neighbouring batches differ by m steps. A sign that alternates is gone
    # from means of an even number; of an odd number, 1/m is left, twice over in the difference.
    assert found[0] == pytest.approx(0.37 * m / np.sqrt(2), rel=1e-12)
    assert found[1] == pytest.approx(np.sqrt(2) / m if m % 2 else 0.0, abs=1e-12)
    assert found[2] == pytest.approx(found[0], rel=1e-10), "blind to a constant"


@pytest.mark.parametrize(
    ("n", "lengths"),
    [(0, ()), (2, ()), (3, (1,)), (6, (1, 2)), (24, (1, 2, 3, 4, 6, 8)), (25, (1, 2, 3, 4, 6, 8))],
)
def test_lengths_up_to_a_third(n: int, lengths: tuple[int, ...]) -> None:
    assert averaging_lengths(n) == lengths


def test_no_lengths_no_rows() -> None:
    assert allan_deviation(np.zeros((2, 3)), []).shape == (0, 3)


def test_disjoint_differences_share_no_batch() -> None:
    weights = disjoint_differences(np.eye(23), 3, most=16)
    assert weights.shape == (3, 23)
    np.testing.assert_allclose(weights @ weights.T, np.eye(3) * 2 / 3, atol=1e-12)
    assert np.all(weights.sum(axis=1) == pytest.approx(0)), "blind to a constant"
    some = disjoint_differences(np.eye(101), 1, most=4)
    assert (len(some), np.flatnonzero(some[0])[0], np.flatnonzero(some[-1])[-1]) == (4, 0, 99)


def test_disjoint_differences_with_a_gap() -> None:
    series = np.arange(12.0)[:, None] * [1, 2]
    series[5] = np.nan
    np.testing.assert_array_equal(
        disjoint_differences(series, 2, most=8), [[2, 4], [np.nan, np.nan], [2, 4]]
    )
