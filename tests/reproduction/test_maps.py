"""What is looked for in maps is found where it was put, and not where there is chance alone."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pixcal.effects.ipc import Ipc
from pixcal.kernels.crosstalk import Coupling, couple
from pixcal.kernels.optics import Geometry, phase
from reproduction.figure_12 import period_of, predicted_teeth
from reproduction.maps import Crest, Whiteness, harmonics, plane, sloping_harmonics, teeth, without

F64 = NDArray[np.float64]
SHAPE = (83, 101)


def test_modes_are_taken_off_and_the_rest_stays() -> None:
    rng = np.random.default_rng(1)
    basis = np.concatenate([plane(SHAPE), harmonics(SHAPE, (0.7, 0.1))])
    noise = without(rng.normal(size=SHAPE), basis)
    found = without(noise + np.tensordot(rng.normal(size=len(basis)), basis, 1), basis)
    np.testing.assert_allclose(found, noise, atol=1e-10)


def test_sloping_harmonics_hold_the_even_ones() -> None:
    vector = (0.7, 0.1)
    even = harmonics(SHAPE, vector)[2]
    assert np.abs(without(even, sloping_harmonics(SHAPE, vector))).max() < 1e-10


def test_masked_pixels_stay_masked() -> None:
    values = np.random.default_rng(2).normal(size=SHAPE)
    values[5, 7] = np.nan
    found = without(values, plane(SHAPE))
    assert np.isnan(found[5, 7])
    assert np.isfinite(found).sum() == values.size - 1


@pytest.mark.parametrize("period", [3, 4, 7])
def test_teeth_of_any_period(period: int) -> None:
    rng = np.random.default_rng(period)
    true = rng.normal(size=period)
    true -= true.mean()
    rows = np.resize(true, SHAPE[0])[:, None] + np.zeros(SHAPE)
    rows[:2], rows[-2:] = 9.0, -9.0  # edges do not count
    found = teeth(rows, period)
    np.testing.assert_allclose(found - found[0], true - true[0], atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("offset", [(18.0, -18.0), (18.0, 18.0), (-7.0, 11.0)])
def test_a_crest_tells_where_the_fibres_are(axis: int, offset: tuple[float, float]) -> None:
    pitch, distance, side = 4.4e-3, 400.0, 201
    middle = (side - 1) / 2 * pitch
    baseline = (6.0, 0.0) if axis == 0 else (0.0, 6.0)
    geometry = Geometry(
        632.8e-6, pitch, middle + offset[0], middle + offset[1], distance, *baseline
    )
    y, x = np.indices((side, side))
    k = 2 * np.pi / 632.8e-6 * pitch * 6.0 / distance
    crest = Crest.of(phase(x, y, geometry) / k)
    # To leading order only: the offsets are a twentieth of the distance.
    assert crest.fibre_offset(distance, pitch, axis) == pytest.approx(offset, rel=0.015)


@pytest.mark.parametrize(
    ("surface", "ridge"), [((1, 0, 0), 90), ((0, 0, 1), 0), ((1, -2, 1), 45), ((1, 2, 1), -45)]
)
def test_the_ridge_runs_where_the_surface_is_flat(
    surface: tuple[float, float, float], ridge: float
) -> None:
    v, u = np.indices(SHAPE) - np.array(SHAPE)[:, None, None] / 2 + 0.5
    found = Crest.of(surface[0] * u * u + surface[1] * u * v + surface[2] * v * v)
    assert abs(found.ridge_deg) == pytest.approx(abs(ridge), abs=1e-6)
    if abs(ridge) == 45:
        assert found.ridge_deg == pytest.approx(ridge, abs=1e-6)


def test_a_white_map_is_white_and_a_patterned_one_is_not() -> None:
    noise = np.random.default_rng(3).normal(size=SHAPE)
    white = Whiteness.of(noise)
    four = (white.neighbours_x, white.neighbours_y, white.rows, white.columns)
    assert max(map(abs, four)) < 4
    assert white.peak > 1e-3
    rows = Whiteness.of(noise + np.random.default_rng(4).normal(size=SHAPE[0])[:, None])
    assert rows.rows > 10
    wave = Whiteness.of(noise + 0.3 * np.cos(2 * np.pi * np.arange(SHAPE[1]) * 11 / SHAPE[1]))
    assert wave.peak < 1e-6
    smooth = Whiteness.of(noise + np.roll(noise, 1, axis=1))
    assert smooth.neighbours_x > 10


KERNELS = {
    "of the paper's size": Ipc().couplings,
    "one up": (Coupling(1, 0, 0.03),),
    "odd rows, across": (Coupling(0, 1, 0.02, every_rows=2, row=1), Coupling(-2, 1, 0.01)),
    "three and two": (Coupling(1, 0, 0.03, every_rows=3), Coupling(0, -1, 0.02, every_rows=2)),
}


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("vector", [(0.0, 2 * np.pi / 9), (2 * np.pi / 8, 0.0), (0.5, -0.4)])
def test_predicted_teeth_are_those_of_coupled_fringes(
    kernel: str, vector: tuple[float, float]
) -> None:
    couplings = KERNELS[kernel]
    y, x = np.indices((61, 47))
    psi = vector[0] * x + vector[1] * y
    read = couple(np.cos(psi), couplings) + 1j * couple(np.sin(psi), couplings)
    shift = np.angle(read * np.exp(-1j * psi)) / np.hypot(*vector)
    inner = shift[5:-5, 5:-5]
    period = period_of(couplings)
    seen = np.array(
        [inner[(np.arange(len(inner)) + 5) % period == r].mean() for r in range(period)]
    )
    np.testing.assert_allclose(predicted_teeth(couplings, vector), seen - seen.mean(), atol=1e-12)


def test_teeth_of_rows_are_not_all_of_a_kernel_of_columns() -> None:
    with pytest.raises(ValueError, match="depend on the column"):
        predicted_teeth((Coupling(0, 1, 0.01, every_columns=2),), (0.5, 0.0))
