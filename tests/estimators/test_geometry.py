"""Planes of tiles, unwrapping, and the fibres' positions from phases."""

from dataclasses import replace

import numpy as np
import pytest

from pixcal.estimators.fringe_fit.fringes import wrapped
from pixcal.estimators.fringe_fit.shapes import Start, fringe_models
from pixcal.estimators.fringe_fit.tile_sums import tile_plane, unwrap
from pixcal.kernels.optics import Geometry, fringe_vector, phase

RNG = np.random.default_rng(0)


def planes_of(truth, k, reference, shape, step, noise=0.0):
    """Tile planes of an exact phase, relative to a carrier, wrapped."""
    rows, columns = -(-shape[0] // step), -(-shape[1] // step)
    planes = []
    for i in range(rows):
        for j in range(columns):
            y = np.arange(i * step, min((i + 1) * step, shape[0]))[:, None]
            x = np.arange(j * step, min((j + 1) * step, shape[1]))[None, :]
            value = phase(x, y, truth) - phase(reference[1], reference[0], truth)
            value = value - k[0] * (x - reference[1]) - k[1] * (y - reference[0])
            value = value + noise * RNG.normal(size=value.shape)
            folded = wrapped(value).astype(np.float32)
            one = np.ones(value.shape, np.float32)
            centre = ((y[0, 0] + y[-1, 0]) / 2, (x[0, 0] + x[0, -1]) / 2)
            kx, ky = fringe_vector(centre[1], centre[0], truth)
            slope = (float(kx) - k[0] + 1e-4, float(ky) - k[1] - 1e-4)
            planes.append(tile_plane(folded, 1e-3 * one, one, one > 0, slope, centre))
    return planes, (rows, columns)


def test_tile_plane_of_a_plane():
    y, x = np.mgrid[:31, :45] - np.array([15, 22])[:, None, None]
    value = 3.0 + 0.02 * x - 0.05 * y
    folded = wrapped(value).astype(np.float32)
    one = np.ones(x.shape, np.float32)
    plane = tile_plane(folded, one, 2 * one, one > 0, (0.021, -0.049), (15.0, 22.0))
    assert plane.kx == pytest.approx(0.02, abs=1e-6)
    assert plane.ky == pytest.approx(-0.05, abs=1e-6)
    assert np.angle(np.exp(1j * (plane.phase - 3.0))) == pytest.approx(0, abs=1e-5)
    np.testing.assert_allclose(wrapped(value - plane.on(x.shape)), 0, atol=1e-5)


def paper_bench(dx=18.0, dy=-18.0, distance=410.0, baseline=6.3, shape=(5456, 8320)):
    p = 4.4e-3
    centre = ((shape[1] - 1) / 2 * p + dx, (shape[0] - 1) / 2 * p + dy)
    return Geometry(632.8e-6, p, *centre, distance, baseline, 0.02, 0.03)


def test_the_whole_detector_is_unwrapped():
    truth, shape = paper_bench(), (1024, 1600)
    reference = (500.0, 800.0)
    kx, ky = fringe_vector(reference[1], reference[0], truth)
    planes, grid = planes_of(truth, (float(kx), float(ky)), reference, shape, 128)
    done = unwrap(planes, grid)
    for plane in done:
        cy, cx = plane.centre
        value = phase(cx, cy, truth) - phase(reference[1], reference[0], truth)
        value -= kx * (cx - reference[1]) + ky * (cy - reference[0])
        first = done[len(done) // 2]
        base = phase(first.centre[1], first.centre[0], truth) - phase(
            reference[1], reference[0], truth
        )
        base -= kx * (first.centre[1] - reference[1]) + ky * (first.centre[0] - reference[0])
        assert plane.phase - first.phase == pytest.approx(value - base, abs=0.02)


def test_fibres_are_found_from_a_wrong_start_over_the_full_detector():
    """From 10 mm off in distance, 18 mm in offset and 5 % in baseline (physics note, section 4)."""
    truth, shape = paper_bench(), (5456, 8320)
    reference = ((shape[0] - 1) / 2, (shape[1] - 1) / 2)
    kx, ky = (float(v) for v in fringe_vector(reference[1], reference[0], truth))
    planes, grid = planes_of(truth, (kx, ky), reference, shape, 341, noise=7e-3)
    centre = (reference[1] * 4.4e-3, reference[0] * 4.4e-3)
    nominal = Geometry(632.8e-6, 4.4e-3, *centre, 400.0, 6.0, 0.0)
    start = Start((kx, ky), reference, 4160.0, unwrap(planes, grid), nominal)
    shape_found = fringe_models()["hyperbolic"].start(start)
    found = shape_found.geometry
    assert found.distance == pytest.approx(410.0, abs=0.5)
    assert found.centre_x == pytest.approx(truth.centre_x, abs=1.0)
    y, x = np.array([0.0, 2000.0, 5455.0]), np.array([8319.0, 100.0, 4000.0])
    wanted = phase(x, y, truth) - phase(reference[1], reference[0], truth)
    got = shape_found.phase(y, x) - shape_found.phase(
        np.array(reference[:1]), np.array(reference[1:])
    )
    np.testing.assert_allclose(got, wanted, atol=0.2)


@pytest.mark.parametrize("name", sorted(fringe_models()))
def test_modes_are_the_derivatives_of_the_phase(name):
    nominal = Geometry(632.8e-6, 4.4e-3, 40 * 4.4e-3, 30 * 4.4e-3, 400.0, 6.0, 0.5)
    start = Start((1.2, 0.1), (30.0, 40.0), 50.0, [], nominal)
    shape = fringe_models()[name].start(start)
    y, x = np.array([0.0, 300.0, 61.0]), np.array([5.0, -100.0, 900.0])
    modes = shape.modes(y, x)
    assert len(modes) == len(shape.names) == len(shape.precision) == len(shape.prior_offset)
    for n in range(len(modes)):
        step = np.zeros(len(modes))
        step[n] = 1e-4
        difference = (shape.moved(step).phase(y, x) - shape.moved(-step).phase(y, x)) / 2e-4
        np.testing.assert_allclose(
            difference, modes[n], rtol=1e-5, atol=1e-5 * np.abs(modes[n]).max()
        )


def test_tiles_beyond_a_band_without_good_pixels_are_on_the_same_turn():
    truth, shape = paper_bench(), (1024, 1600)
    reference = (500.0, 800.0)
    # A carrier off by half a turn a tile: after some tiles, turns do not agree by chance.
    kx, ky = np.array(fringe_vector(reference[1], reference[0], truth)) + 0.02
    planes, grid = planes_of(truth, (float(kx), float(ky)), reference, shape, 128)
    whole = unwrap(planes, grid)
    row, column = np.divmod(np.arange(len(planes)), grid[1])
    blind = (column == 9) | (row == 1)
    planes = [replace(p, sigma=np.inf) if b else p for p, b in zip(planes, blind, strict=True)]
    for plane, wanted, b in zip(unwrap(planes, grid), whole, blind, strict=True):
        assert b or plane.phase == pytest.approx(wanted.phase, abs=1e-6)
