"""Marks of the study of errors, and one acquisition of it."""

import json

import pytest

import errors
from pixcal.kernels.significance import root_with_error


def test_deviation_of_nothing_is_that_of_the_variance() -> None:
    for variance in (1.5, 9.0, 400.0):
        root, error = map(float, root_with_error(variance, 1.0))
        assert errors.deviation("row_rms", 0.0, root, error) == pytest.approx(variance)
    assert errors.deviation("quadratic", 1.0, 1.5, 0.25) == pytest.approx(2.0)


def test_table_counts_values_and_the_largest_deviation() -> None:
    marks = {"variant": 0, "effect": "lag", "strength": "share", "by_law": False}
    off = [{"share": [1.0, 1.0 + n / 20, 0.1], "decay_frames": [0, 0, 1]} for n in (0, 1, 12)]
    printed = errors.table([{**marks, "parameters": one} for one in off])
    assert "| lag: share | 3 | 67 % | 3.48 | 6.0 (`share`) |" in printed
    assert printed.endswith("| all | 3 | 67 % | 3.48 | 6.0 (`share`) |")
    # What another law describes is not at nothing.
    other = {**marks, "by_law": True, "parameters": {"share": [1.0, 0.0, 0.1]}}
    assert errors.table([other]).endswith("| all | 0 | | | |")


@pytest.mark.long
def test_one_acquisition_gives_a_parameter_within_its_errors() -> None:
    names = [one.effect for one in errors.VARIANTS]
    mark = errors.examine((names.index("nonlinearity"), 5.0, 0))
    json.dumps(mark)
    assert mark["sigmas"] > 10
    for name, values in mark["parameters"].items():
        assert abs(errors.deviation(name, *values)) < 4
