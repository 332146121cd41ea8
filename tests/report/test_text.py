"""Numbers as a reader sees them."""

import math

import pytest

from pixcal.estimators.fringe_fit.gauge import FRINGE_MODES
from pixcal.kernels.optics import PARAMETERS
from pixcal.report.text import (
    date_of_mjd,
    duration,
    exact,
    mode_in_words,
    number,
    share,
    with_error,
)


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (2.7769e-4, 3, "2.78 × 10⁻⁴"),
        (-2.7769e-12, 2, "−2.8 × 10⁻¹²"),
        (0.00602, 3, "0.00602"),
        (1.0, 3, "1.00"),
        (0.99996, 3, "1.00"),
        (9.9996e-5, 3, "1.00 × 10⁻⁴"),
        (18507.3, 2, "19\u202f000"),
        (123456789.0, 3, "1.23 × 10⁸"),
        (46_000_000, 3, "46\u202f000\u202f000"),
        (0.0, 3, "0"),
        (None, 3, "–"),
        (math.nan, 3, "–"),
        (math.inf, 3, "–"),
        ("words", 3, "words"),
    ],
)
def test_numbers(value: float | str | None, digits: int, text: str) -> None:
    assert number(value, digits) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (5.0, "5"),
        (0.02, "0.02"),
        (1e-6, "1 × 10⁻⁶"),
        (10.0, "10"),
        (100, "100"),
        (1.234567, "1.23457"),
    ],
)
def test_exact_numbers_end_without_zeros(value: float, text: str) -> None:
    assert exact(value) == text


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (-0.50049, 0.0019, "−0.5005 ± 0.0019"),
        (391.649, 8.7, "391.6 ± 8.7"),
        (338_936.2, 2898.3, "338\u202f900 ± 2\u202f900"),
        (1.2566374, 1.6e-6, "1.2566374 ± 0.0000016"),
        (3.2e-8, 1.1e-9, "(3.20 ± 0.11) × 10⁻⁸"),
        (3.0, None, "3.000"),
        (3.0, 0.0, "3.000"),
        (131.816610, 4e-15, "131.817"),
        (None, 1.0, "–"),
    ],
)
def test_values_have_two_digits_of_their_error(
    value: float | None, error: float | None, text: str
) -> None:
    assert with_error(value, error) == text


def test_shares_times_and_dates() -> None:
    assert share(0, 10) == "0\u00a0%"
    assert share(18, 7680) == "0.23\u00a0%"
    assert duration(33.5) == "33.5 s"
    assert duration(7200) == "2.00 h"
    assert duration(1e6) == "11.6 d"
    assert date_of_mjd(51544.5) == "2000-01-01 12:00:00"


def test_every_mode_of_the_shapes_is_explained() -> None:
    names = ["1", "x", "y", *FRINGE_MODES, *(f"d psi / d {p}" for p in PARAMETERS)]
    words = [mode_in_words(name) for name in names]
    assert len(set(words)) == len(words)
    assert mode_in_words("of tomorrow") not in words
    assert "_" not in "".join(words)
