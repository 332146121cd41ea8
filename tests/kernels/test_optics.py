"""Optical paths, held against 50 digits, finite differences and the paraxial limit."""

from dataclasses import replace
from decimal import Decimal, localcontext

import numpy as np
import pytest

from pixcal.kernels.optics import (
    PARAMETERS,
    Geometry,
    fringe_vector,
    gaussian_beam,
    interfringe,
    paraxial_phase,
    paraxial_vector,
    phase,
    phase_jacobian,
)

BENCH = Geometry(
    wavelength=632.8e-6,
    pitch=4.4e-3,
    centre_x=18.3,
    centre_y=12.0,
    distance=400.0,
    baseline_x=6.0,
    baseline_y=0.4,
    baseline_z=0.05,
)


def exact(x: float, y: float, g: Geometry) -> Decimal:
    """The phase as the paper writes it (eq. 3), with 50 digits."""
    with localcontext() as context:
        context.prec = 50
        pi = Decimal("3.14159265358979323846264338327950288419716939937510")
        r = (Decimal(x) * Decimal(g.pitch), Decimal(y) * Decimal(g.pitch), Decimal(0))
        centre = (Decimal(g.centre_x), Decimal(g.centre_y), Decimal(g.distance))
        half = [Decimal(b) / 2 for b in (g.baseline_x, g.baseline_y, g.baseline_z)]
        to_a = sum((p - c + h) ** 2 for p, c, h in zip(r, centre, half, strict=True)).sqrt()
        to_b = sum((p - c - h) ** 2 for p, c, h in zip(r, centre, half, strict=True)).sqrt()
        return 2 * pi / Decimal(g.wavelength) * (to_a - to_b)


@pytest.mark.parametrize("seed", range(4))
def test_the_phase_is_exact_all_over_the_chip(seed: int) -> None:
    rng = np.random.default_rng(seed)
    g = BENCH.with_vector(
        [*rng.uniform(-20, 40, 2), rng.uniform(50, 800), *rng.uniform(-6, 6, 2), rng.normal() / 10]
    )
    x, y = rng.uniform(0, 8320, 50), rng.uniform(0, 5456, 50)
    found = phase(x, y, g)
    for n in range(x.size):
        assert abs(Decimal(found[n]) - exact(x[n], y[n], g)) < Decimal("1e-9")


def test_the_phase_grows_along_the_baseline_by_the_paraxial_vector() -> None:
    g = replace(BENCH, centre_x=0.0, centre_y=0.0, baseline_x=6.0, baseline_y=0.0, baseline_z=0.0)
    k = 2 * np.pi / g.wavelength * g.pitch * 6.0 / 400.0
    assert paraxial_vector(g) == pytest.approx((k, 0.0))
    assert interfringe(paraxial_vector(g)) == pytest.approx(9.588, abs=1e-3)
    assert phase(1.0, 0.0, g) - phase(0.0, 0.0, g) == pytest.approx(k, rel=1e-4)
    swapped = replace(g, baseline_x=-6.0)
    assert phase(1.0, 0.0, swapped) == pytest.approx(-phase(1.0, 0.0, g), rel=1e-14)


def test_far_away_the_fringes_are_straight() -> None:
    x, y = np.meshgrid(np.arange(0.0, 400, 13), np.arange(0.0, 300, 11))
    errors = []
    for far in (400.0, 4000.0):
        g = replace(BENCH, centre_x=0.9, centre_y=0.7, distance=far, baseline_z=0.0)
        straight = paraxial_phase(x, y, g)
        reach = np.hypot(x * g.pitch - 0.9, y * g.pitch - 0.7).max() + 3.1
        errors.append(np.abs(phase(x, y, g) - straight).max() / np.abs(straight).max())
        assert errors[-1] < 0.5 * (reach / far) ** 2
    assert errors[1] == pytest.approx(errors[0] / 100, rel=0.01)


def test_the_fringe_vector_is_the_gradient() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0, 8320, 40), rng.uniform(0, 5456, 40)
    h = 0.05
    kx, ky = fringe_vector(x, y, BENCH)
    assert np.allclose(kx, (phase(x + h, y, BENCH) - phase(x - h, y, BENCH)) / (2 * h), rtol=1e-8)
    numeric = (phase(x, y + h, BENCH) - phase(x, y - h, BENCH)) / (2 * h)
    assert np.allclose(ky, numeric, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("column", range(6))
def test_the_jacobian_is_that_of_the_phase(column: int) -> None:
    rng = np.random.default_rng(4)
    x, y = rng.uniform(0, 8320, 30), rng.uniform(0, 5456, 30)
    step = np.zeros(6)
    step[column] = 1e-3
    before = phase(x, y, BENCH.with_vector(BENCH.vector() - step))
    after = phase(x, y, BENCH.with_vector(BENCH.vector() + step))
    found = phase_jacobian(x, y, BENCH)
    assert found.shape == (30, 6)
    assert np.allclose(found[:, column], (after - before) / 2e-3, rtol=1e-6, atol=1e-7)


def test_parameters_survive_the_vector() -> None:
    assert BENCH.with_vector(BENCH.vector()) == BENCH
    assert [getattr(BENCH, name) for name in PARAMETERS] == BENCH.vector().tolist()


def test_positions_broadcast() -> None:
    x, y = np.arange(7), np.arange(5)[:, None]
    grid = phase(*np.meshgrid(np.arange(7), np.arange(5)), BENCH)
    assert np.array_equal(phase(x, y, BENCH), grid)
    assert grid.shape == (5, 7)
    assert phase_jacobian(x, y, BENCH).shape == (5, 7, 6)
    assert fringe_vector(x, y, BENCH)[0].shape == (5, 7)


def test_a_beam_falls_to_its_radius() -> None:
    beam = gaussian_beam(np.arange(200), np.arange(100)[:, None], (40.0, 60.0), 30.0)
    assert beam.shape == (100, 200)
    assert np.unravel_index(beam.argmax(), beam.shape) == (60, 40)
    assert beam[60, 40] == 1
    assert beam[60, 70] == pytest.approx(np.exp(-2))
    assert beam[60 + 18, 40 + 24] == pytest.approx(np.exp(-2))
