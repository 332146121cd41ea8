"""Pixels at the border and beside flagged ones: what is known of those around, and its error."""

import numpy as np
import pytest

from pixcal.effects.ipc import Ipc
from pixcal.kernels.crosstalk import couple_fringes, uncouple_fringes
from pixcal.model.flags import PixelFlag
from pixcal.simulation.effect import FringeMaps
from pixcal.stages.correct.correct_maps import border_misfit, open_sides, perturbed
from pixcal.stages.correct.sweep_to_correct import usable

K = (2 * np.pi / 9, 0.02)
KERNEL = Ipc.nearest(0.008).couplings
MARGIN = 4


def window(*, is_open):
    """Maps of a window read through crosstalk, as it ends with the chip or lies within it."""
    rng = np.random.default_rng(1)
    shape = (96 + 2 * MARGIN, 100 + 2 * MARGIN)
    y, x = np.indices(shape, float)
    psi = K[0] * x + K[1] * y + 4e-3 * rng.standard_normal(shape)
    theta = np.stack([np.full(shape, 2e4), 1.8e4 * np.sin(psi), 1.8e4 * np.cos(psi)])
    inside = (slice(None), slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    read = couple_fringes(theta, KERNEL)[inside]
    return read if is_open else couple_fringes(theta[inside], KERNEL)


@pytest.mark.parametrize("is_open", [True, False])
def test_the_maps_tell_whether_the_detector_goes_on_at_a_side(is_open):
    """What a window without surroundings lacks at its left side is there, or is not."""
    read = window(is_open=is_open)
    alone = uncouple_fringes(read, KERNEL)
    y, x = np.indices(read.shape[1:])
    beyond = np.exp(1j * (K[0] * (x - MARGIN) + K[1] * y))[:, :MARGIN] * 1.8e4
    z = read[2] + 1j * read[1]
    beyond *= np.mean(z * np.exp(-1j * (K[0] * x + K[1] * y))) / 1.8e4
    ring = np.stack([np.full(beyond.shape, 2e4), beyond.imag, beyond.real])
    wider = uncouple_fringes(np.concatenate([ring, read], axis=2), KERNEL)[:, :, MARGIN:]
    strips = [m.swapaxes(1, 2)[:, :24] for m in (alone, wider)]
    good = np.ones(strips[0].shape[1:], bool)
    closed, opened = (border_misfit(s, (K[1], K[0]), good) for s in strips)
    assert (opened < closed) == is_open
    assert abs(opened - closed) > 50


def test_a_side_that_does_not_tell_goes_by_the_others():
    misfits = np.array([[100.0, 3.0], [2.0, 3.0], [40.0, 90.0], [5.0, 4.0]])
    assert open_sides(misfits) == (True, True, False, True)


def test_errors_of_neighbours_add_up_in_squares():
    shape = (9, 9)
    psi = K[0] * np.arange(9) + np.zeros((9, 1))
    theta = np.stack([np.full(shape, 2e4), 2e4 * np.sin(psi), 2e4 * np.cos(psi)])
    unknown = np.zeros(shape, bool)
    unknown[4, 3] = unknown[3, 4] = True
    moved = perturbed(
        FringeMaps(theta, K, (5, 7)), unknown, np.zeros_like(unknown), np.zeros(shape)
    )
    z = np.array([m.theta[2] + 1j * m.theta[1] for m in moved]) - (theta[2] + 1j * theta[1])
    both = np.abs(z[:, 4, 3] + z[:, 3, 4]) ** 2
    apart = np.abs(z[:, 4, 3]) ** 2 + np.abs(z[:, 3, 4]) ** 2
    assert both.mean() == pytest.approx(apart.mean())
    assert np.count_nonzero(z) == 2 * len(moved)


def test_a_flagged_pixel_that_was_fitted_tells_what_it_gives():
    theta = np.ones((3, 1, 4))
    theta[1, 0, 3] = np.nan
    flags = [PixelFlag.DEAD, PixelFlag.HOT | PixelFlag.BAD_FIT, PixelFlag.SATURATED, 0]
    mask = np.array([flags], np.uint8)
    assert usable(theta, mask).tolist() == [[True, True, False, False]]
