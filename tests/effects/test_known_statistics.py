"""The statistics: each sees what it is for, in its own unit, and nothing else."""

import dataclasses
import gc
import weakref
from collections.abc import Callable

import numpy as np
import pytest

from pixcal.effects import effects
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.test_statistics import DETECTOR, known_statistics, measure
from pixcal.estimators.test_statistics.expectation import Reference


@pytest.fixture(scope="module")
def plain(acquired: Callable[..., Evidence]) -> Evidence:
    return acquired()


def test_every_statistic_says_what_it_is() -> None:
    assert len(known_statistics()) > 50
    for name, one in known_statistics().items():
        assert one.name == name
        assert one.domain in {"space", "time", "intensity", "noise"}
        assert one.kind in {"linear", "power"}
        assert one.title


def test_all_that_can_be_measured_is(plain: Evidence) -> None:
    found = measure(plain)
    missing = set(known_statistics()) - {name for name, _ in found}
    # Two baselines along one axis are not there, nor enough levels of flats.
    assert missing == {"apart", "first_flats"}
    for (name, of), curve in found.items():
        assert len(curve.x) == len(curve.value) > 0
        assert (of == DETECTOR) != known_statistics()[name].of_set
        assert known_statistics()[name].kind == "linear" or (curve.value >= 0).all()


def changed(plain: Evidence, **fields: object) -> Evidence:
    one = dataclasses.replace(plain.fringes["vertical"], **fields)  # type: ignore[arg-type]
    return dataclasses.replace(plain, fringes={**plain.fringes, "vertical": one})


def test_rows_in_the_offsets_show_with_their_size(plain: Evidence) -> None:
    rows = np.arange(plain.good.shape[0])[:, None]
    delta = plain.fringes["vertical"].delta + 4e-3 * np.cos(np.pi * rows / 2)
    found = measure(changed(plain, delta=delta))
    curve = found["offset_rows_repeat", "vertical"]
    assert curve.value[list(curve.x).index(4)] == pytest.approx(4e-3, rel=0.1)
    same = measure(plain)
    for key in (("contrast_rows_repeat", "vertical"), ("offset_rows_repeat", "horizontal")):
        np.testing.assert_array_equal(found[key].value, same[key].value)


def test_fringes_in_the_contrast_are_told_apart_from_its_other_patterns(plain: Evidence) -> None:
    """As errors of four phases leave them: a second harmonic, whose size is chance."""
    one = plain.fringes["vertical"]
    psi = np.arctan2(one.theta[1], one.theta[2])
    size = 0.3 * measure(plain)["contrast_by_place", "vertical"].value.mean() ** 0.5
    theta = one.theta * np.stack([np.ones_like(psi), *2 * [1 + size * np.cos(2 * psi)]])
    found, before = measure(changed(plain, theta=theta)), measure(plain)
    rise = (
        found["contrast_fringes", "vertical"].value - before["contrast_fringes", "vertical"].value
    )
    assert rise[2] == pytest.approx(size, rel=0.05)
    for name in ("contrast_by_place", "contrast_scales", "contrast_peak"):
        powers, usual = found[name, "vertical"].value, before[name, "vertical"].value
        np.testing.assert_allclose(powers, usual, rtol=0.02)


def test_neighbours_that_share_noise_correlate(plain: Evidence) -> None:
    one = plain.fringes["horizontal"]
    shared = one.residual + 0.1 * np.roll(np.nan_to_num(one.residual), 1, axis=1)
    rest = dataclasses.replace(one, electrons=(one.model + shared).astype(np.float32))
    evidence = dataclasses.replace(plain, fringes={**plain.fringes, "horizontal": rest})
    before, after = (
        measure(plain)["neighbours", "horizontal"],
        measure(evidence)["neighbours", "horizontal"],
    )
    change = after.value - before.value
    assert change[1] == pytest.approx(0.1, abs=0.01)
    assert np.abs(np.delete(change, 1)).max() < 0.02


def test_a_third_harmonic_shows_with_its_size(plain: Evidence) -> None:
    one = plain.fringes["vertical"]
    alpha = np.hypot(one.theta[1], one.theta[2])
    psi = np.arctan2(one.theta[1], one.theta[2])
    turn = 3 * (one.phi[:, None, None] + psi)
    # As the model has it: the fringes themselves are sin(phi + psi).
    fringes = one.model - one.g[:, :1, None] * one.theta[0]
    assert np.corrcoef(fringes.ravel(), np.sin(turn / 3).ravel())[0, 1] > 0.99
    more = (one.electrons + 1e-3 * alpha * np.cos(turn)).astype(np.float32)
    curve = measure(changed(plain, electrons=more))["harmonics", "vertical"]
    assert curve.value[list(curve.x).index(3.0)] == pytest.approx(1e-3, rel=0.1)
    assert np.abs(np.delete(curve.value, 2)).max() < 2e-4


def test_harmonics_of_single_pixels_show_where_their_mean_is_zero(plain: Evidence) -> None:
    """As a response that is nonlinear in a way of its own in each pixel leaves them."""
    one, size = plain.fringes["vertical"], 4e-3
    alpha, psi = np.hypot(one.theta[1], one.theta[2]), np.arctan2(one.theta[1], one.theta[2])
    own = size * np.random.default_rng(3).choice([-1, 1], plain.good.shape)
    more = one.electrons + own * alpha * np.cos(2 * (one.phi[:, None, None] + psi))
    found, usual = measure(changed(plain, electrons=more.astype(np.float32))), measure(plain)
    key = ("pixel_harmonics", "vertical")
    rise = found[key].value - usual[key].value
    assert rise[0] == pytest.approx(size**2, rel=0.2)
    assert np.abs(rise[1:]).max() < 0.1 * size**2
    shared = found["harmonics", "vertical"].value - usual["harmonics", "vertical"].value
    assert np.abs(shared).max() < 0.1 * size


def test_harmonics_that_the_phases_do_not_separate_are_not_compared(plain: Evidence) -> None:
    """Four phases to a turn: the third harmonic looks like the fringes, the fourth is constant."""
    number = np.arange(len(plain.fringes["vertical"].g))
    phi = np.pi / 2 * number + 1e-3 * np.sin(7.0 * number)
    g = np.stack([np.ones(len(phi)), np.cos(phi), np.sin(phi)], axis=1)
    found = measure(changed(plain, g=g))
    assert found["pixel_harmonics", "vertical"].x == pytest.approx([2.0])
    assert found["harmonics", "vertical"].x == pytest.approx([2.0, 2.25])


def test_offsets_along_one_axis_are_compared(plain: Evidence) -> None:
    twin = dataclasses.replace(
        plain.fringes["vertical"],
        name="longer",
        delta=plain.fringes["vertical"].delta
        + 1e-3 * np.random.default_rng(1).standard_normal(plain.good.shape),
    )
    evidence = dataclasses.replace(plain, fringes={**plain.fringes, "longer": twin})
    value = measure(evidence)["apart", DETECTOR].value
    assert value[0] == pytest.approx(1e-6, rel=0.1)


def test_a_reference_needs_what_all_simulations_have(plain: Evidence) -> None:
    whole = measure(plain)
    part = {key: curve for key, curve in whole.items() if key[1] != "vertical"}
    known = Reference.of([whole, part])
    assert set(known.usual) == set(part)
    assert set(known.on_scale(whole)) == set(part)


@pytest.mark.long
def test_frames_that_were_looked_at_are_freed(acquired: Callable[..., Evidence]) -> None:
    """At once, not by the garbage collector: a diagnosis looks at hundreds of them."""
    few = {f"frames.fringes.{n}.count": 60 for n in (0, 1)}
    evidence = dataclasses.replace(acquired({"detector.shape": [31, 37]} | few))
    alive = weakref.ref(evidence)
    gc.disable()
    try:
        measure(evidence)
        for kind in effects().values():
            kind.estimate(evidence)
        del evidence
        assert alive() is None
    finally:
        gc.enable()
