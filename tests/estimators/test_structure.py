"""What is kept of measured offsets, and what is drawn anew."""

import numpy as np
import pytest

from pixcal.estimators.maps.stitching import FieldFit
from pixcal.estimators.maps.structure import (
    PERIODS,
    OffsetModel,
    fit_terms,
    legendre,
    profile,
    redness,
    repeats,
    smooth_surface,
    stitched_fields,
    true_offsets,
    without_outliers,
)

SHAPE = (61, 67)


def plane() -> np.ndarray:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 1.1 * x + 0.07 * y


def white(seed: int, rms: float = 2e-3) -> np.ndarray:
    return rms * np.random.default_rng(seed).standard_normal(SHAPE)


def spread(found: OffsetModel) -> np.ndarray:
    """Standard deviation of the coefficient of each term, by chance."""
    return np.linalg.norm(found.scatter, axis=1)


def test_a_polynomial_is_its_own_surface_whatever_stands_out() -> None:
    terms = legendre(SHAPE, 3)
    assert len(terms) == 10
    values = np.tensordot(np.arange(1.0, 11), terms, 1)
    wild = values.copy()
    wild[5, 7] = 1e3
    np.testing.assert_allclose(smooth_surface(wild, np.ones(SHAPE, bool)), values, atol=1e-6)


def test_lines_that_repeat_are_measured() -> None:
    rows = np.arange(SHAPE[0])[:, None]
    pattern = 0.01 * np.cos(2 * np.pi * rows / 4 + 0.3) * np.ones(SHAPE)
    size = np.abs(repeats(pattern, 0))
    assert size[PERIODS.index(4)] == pytest.approx(0.01, rel=0.05)
    # 67 columns are no whole number of periods.
    assert np.abs(repeats(pattern, 1)).max() < 2e-3 * 0.01
    assert profile(pattern, 0).shape == (61,)


def test_what_effects_make_is_taken_out_and_the_rest_is_kept() -> None:
    true = white(1)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    made = 0.01 * np.cos(np.pi * y / 2) + 2e-6 * (x - 33) ** 2 + 0.003 * np.cos(plane())
    found = true_offsets(true + made, np.zeros(SHAPE), plane())
    left = fit_terms(found.kept, found.terms)
    assert np.abs(left).max() < 1e-10
    assert np.corrcoef(found.kept.ravel(), true.ravel())[0, 1] > 0.99


def test_drawn_offsets_scatter_as_the_measured_ones_do() -> None:
    true = white(2)
    found = true_offsets(true, np.zeros(SHAPE), plane())
    rng = np.random.default_rng(3)
    draws = np.stack([found.drawn(rng) for _ in range(200)])
    assert draws.var() == pytest.approx(true.var(), rel=0.02)
    size = np.array([fit_terms(d, found.terms) for d in draws[:100]])
    expected = fit_terms(true, found.terms) / spread(found)
    assert np.abs(expected).max() < 5
    # Terms that are not quite orthogonal on odd sizes share their scatter.
    assert np.median(size.std(axis=0) / spread(found)) == pytest.approx(1, rel=0.1)


def test_noise_is_not_kept() -> None:
    noise = 1e-3
    found = true_offsets(white(4) + white(5, noise), np.full(SHAPE, noise), plane())
    assert found.kept.std() == pytest.approx(2e-3, rel=0.05)
    nothing = true_offsets(white(5, noise), np.full(SHAPE, 1.1 * noise), plane())
    assert np.abs(nothing.kept).max() < 1e-15
    assert not nothing.scatter.any()


def test_stitches_are_red_and_white_noise_is_not() -> None:
    assert redness(white(6)) == pytest.approx(1, abs=0.5)
    stitched = white(6) + 0.01 * (np.mgrid[:61, :67][1] // 32 % 2)
    assert redness(stitched) > 10


@pytest.mark.parametrize("steps", [0.0, 3e-3])
def test_curvature_of_stitched_offsets_is_no_more_than_chance(steps: float) -> None:
    """What steps between a few large blocks give to a parabola lies within what is drawn."""
    sizes, psi = [], plane()
    fringes = np.stack([np.cos(psi), np.sin(psi), np.cos(2 * psi), np.sin(2 * psi)])
    for seed in range(30):
        rng = np.random.default_rng(seed)
        true = white(seed)
        (rows, columns), start = rng.integers(20, 60, 2), rng.integers(0, 60)
        y, x = (np.arange(SHAPE[0]) + start) // rows, (np.arange(SHAPE[1]) + start) // columns
        true += steps * rng.standard_normal((9, 9))[y][:, x]
        found = true_offsets(true, np.zeros(SHAPE), plane())
        fit = FieldFit.of(true, found.terms, stitched_fields([true], [fringes]))
        sizes.append((fit.values / spread(found))[2:5])
    assert 0.7 < np.sqrt(np.mean(np.square(sizes))) < 1.6


def test_bad_pixels_do_not_matter() -> None:
    true = white(7)
    holes = true.copy()
    holes[::7, ::5] = np.nan
    found = true_offsets(holes, np.zeros(SHAPE), plane())
    assert np.isfinite(found.kept).all()
    assert np.abs(found.kept[::7, ::5]).max() < 1e-15
    # In a simulation they are pixels like all others.
    drawn = found.drawn(np.random.default_rng(8))[::7, ::5]
    assert drawn.std() == pytest.approx(np.nanstd(holes), rel=4 / np.sqrt(2 * drawn.size))


def test_outliers_are_told_from_a_strong_pattern() -> None:
    y, x = np.mgrid[:61, :70]
    rng = np.random.default_rng(4)
    bump = 50 * np.exp(-((x - 30) ** 2 + (y - 20) ** 2) / 200)
    values = bump + rng.standard_normal(bump.shape)
    values[7, 9] += 15
    values[40, 3] = np.nan
    left = without_outliers(values)
    assert np.isnan(left[7, 9])
    assert np.isnan(left[40, 3])
    assert np.isfinite(left).sum() >= values.size - 4


def test_terms_need_not_be_known_where_the_map_is_not() -> None:
    rng = np.random.default_rng(8)
    terms = rng.standard_normal((3, 40, 30))
    values = np.tensordot([2.0, -1.0, 0.5], terms, 1)
    values[3, 4] = terms[:, 3, 4] = np.nan
    np.testing.assert_allclose(fit_terms(values, terms), [2.0, -1.0, 0.5])
