"""Fields of the foundry's stitching in maps of offsets."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from pixcal.estimators.maps.map_fit import MapPart, fit_maps, polynomial
from pixcal.estimators.maps.stitching import FieldFit, fields
from pixcal.estimators.maps.structure import legendre, stitched_fields

SHAPE = (97, 113)
NOISE = 6e-3
ROWS, COLUMNS = (31, 70), (17, 55, 93)


def white(seed: int) -> np.ndarray:
    return NOISE * np.random.default_rng(seed).standard_normal(SHAPE)


def numbers(rows: tuple[int, ...] = ROWS, columns: tuple[int, ...] = COLUMNS) -> np.ndarray:
    row, column = (
        np.searchsorted(own, np.arange(n), side="right")
        for own, n in zip((rows, columns), SHAPE, strict=True)
    )
    return row[:, None] * (len(columns) + 1) + column


def stitched(seed: int, rms: float = 3e-3) -> np.ndarray:
    steps = rms * np.random.default_rng([seed, 1]).standard_normal(numbers().max() + 1)
    return white(seed) + steps[numbers()]


def lines(field: np.ndarray, axis: int) -> np.ndarray:
    """First rows (axis 0) or columns of later fields."""
    along = field[:, 0] if axis == 0 else field[0]
    return np.flatnonzero(np.diff(along)) + 1


@pytest.mark.parametrize("seed", range(5))
def test_lines_are_found_where_they_are(seed: int) -> None:
    bent = 0.01 * legendre(SHAPE, 3)[3]
    found = fields([stitched(seed, 6e-3) + bent], [legendre(SHAPE, 3)[1:]])
    for axis, true in enumerate((ROWS, COLUMNS)):
        own = lines(found, axis)
        assert all(np.abs(own - line).min() <= 1 for line in true)
        assert len(own) <= len(true) + 1


def test_what_one_map_does_not_show_two_do() -> None:
    terms = legendre(SHAPE, 3)[1:]
    maps = [stitched(seed, 1e-3) for seed in range(8)]
    found = fields(maps, [terms] * len(maps))
    assert [len(lines(found, axis)) for axis in (0, 1)] == [len(ROWS), len(COLUMNS)]
    alone = [fields([one], [terms]) for one in maps]
    assert np.mean([len(lines(one, 1)) for one in alone]) < len(COLUMNS) - 0.5


def test_maps_without_steps_have_one_field() -> None:
    y = np.arange(SHAPE[0])[:, None]
    pattern = 0.02 * np.cos(2 * np.pi * y / 4) + 0.05 * legendre(SHAPE, 3)[5]
    fringes = np.stack([turn(0.7 * y) * np.ones(SHAPE) for turn in (np.cos, np.sin)])
    pattern = pattern + 0.01 * fringes[0]
    one = [not stitched_fields([white(seed) + pattern], [fringes]).any() for seed in range(60)]
    assert np.mean(one) > 0.9


def test_a_fit_beside_fields_is_one_with_a_column_for_each() -> None:
    terms, values = legendre(SHAPE, 3)[1:], stitched(6)
    values[3:9, 40:60] = np.nan
    good = np.isfinite(values)
    fit = FieldFit.of(values, terms, numbers())
    columns = np.stack([numbers() == n for n in range(numbers().max() + 1)])
    design = np.concatenate([terms, columns])[:, good].T
    expected, *_ = np.linalg.lstsq(design, values[good], rcond=None)
    np.testing.assert_allclose(fit.values, expected[: len(terms)], rtol=1e-8)
    covariance = np.linalg.inv(design.T @ design)[: len(terms), : len(terms)]
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(fit.rest[good], values[good] - design @ expected, atol=1e-12)
    assert np.isnan(fit.rest[~good]).all()


def test_curvature_beside_fields_has_the_error_that_is_told() -> None:
    """And a smaller one than where steps count as noise."""
    signal, good = legendre(SHAPE, 3)[3:6], np.ones(SHAPE, bool)
    free, true = polynomial(SHAPE, 1), np.array([1e-3, -5e-4, 2e-3])
    pulls, ratios = [], []
    for seed in range(40):
        data = stitched(seed) + np.tensordot(true, signal, 1)
        one, other = (
            fit_maps([MapPart.of(signal, data, free, good, field)]) for field in (numbers(), None)
        )
        pulls.append((one.values - true) / np.sqrt(np.diag(one.covariance)))
        ratios.append(np.diag(one.covariance) / np.diag(other.covariance))
    assert np.std(pulls) == pytest.approx(1, abs=0.25)
    assert np.sqrt(np.median(ratios)) < 0.7


def blurred(values: np.ndarray) -> np.ndarray:
    return gaussian_filter(values, 0.7, mode="wrap")


PATTERNS = {
    "alike neighbours": lambda y, x, rng: blurred(rng.standard_normal(SHAPE)) * 2.5,
    "short wave": lambda y, x, rng: rng.standard_normal(SHAPE) + 0.5 * np.cos(2 * np.pi * x / 20),
    "long wave": lambda y, x, rng: rng.standard_normal(SHAPE) + np.cos(2 * np.pi * x / 40),
    "columns": lambda y, x, rng: rng.standard_normal(SHAPE) + 0.3 * rng.standard_normal(SHAPE[1]),
}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_other_patterns_are_no_fields(pattern: str) -> None:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    none = np.zeros((0, *SHAPE))
    one = [
        not stitched_fields(
            [NOISE * PATTERNS[pattern](y, x, np.random.default_rng(seed))], [none]
        ).any()
        for seed in range(12)
    ]
    assert np.mean(one) > 0.8


@pytest.mark.parametrize("seed", range(4))
def test_fields_are_kept_where_there_is_no_pattern(seed: int) -> None:
    assert stitched_fields([stitched(seed)], [np.zeros((0, *SHAPE))]).any()


def test_masked_pixels_have_the_offset_of_their_field() -> None:
    terms, values = legendre(SHAPE, 3)[1:], stitched(6)
    masked = values.copy()
    masked[3:9, 40:60] = np.nan
    fit, whole = (FieldFit.of(one, terms, numbers()) for one in (masked, values))
    np.testing.assert_allclose(fit.steps, whole.steps, atol=5 * NOISE / 20)
    assert whole.variance == pytest.approx(NOISE**2, rel=0.05)
