"""Hyperbolic fringes: those of the exact bench; the foot of the fibres is found again."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pixcal.effects.hyperbolic_fringes import HyperbolicFringes, curvature_phase
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels import optics
from pixcal.kernels.optics import Geometry
from pixcal.kernels.scene import detector_maps, electrons_per_unit, fringe_light, geometry
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Estimate
from pixcal.simulation.recording import recordings

WINDOW = {"detector.shape": [101, 107]}
PAPER = Geometry(632.8e-6, 4.4e-3, 18.0, 18.0, 400.0, 6.0, 0.0)


@pytest.mark.parametrize("foot", [(3.0, -7.0), None])
def test_all_of_it_is_the_path_difference_of_two_fibres(
    make_effect_bench: Callable[..., Bench], foot: tuple[float, float] | None
) -> None:
    bench = make_effect_bench(
        {"detector.shape": [31, 37], "detector.chip": [3000, 4000], "optics.offset_mm": [3.0, -7.0]}
    )
    rows = (5, 31)
    maps = detector_maps(bench.detector, rows)
    x = np.arange(37) + maps.delta_x.astype(float)
    y = np.arange(*rows)[:, None] + maps.delta_y.astype(float)
    for recording in recordings(bench):
        if recording.kind == "fringes":
            e = electrons_per_unit(bench, recording.number)
            plain = fringe_light(bench, recording.number, rows, maps, e)
            made = HyperbolicFringes(foot).light(plain, recording, rows, maps)
            psi = optics.phase(x, y, geometry(bench, recording.number))
            np.testing.assert_allclose(made.mean, plain.mean, rtol=1e-12)
            expected = np.abs(plain.phasor) * np.exp(1j * psi)
            np.testing.assert_allclose(made.phasor, expected, rtol=1e-9)


def test_the_bending_has_its_leading_order_and_in_pixels_no_baseline() -> None:
    """Phase and px both: half the baseline bends half as much in phase, the same in px."""
    y, x = np.mgrid[0:400:20, 0:400:20].astype(float)
    qx, qy = x * 4.4e-3 - 18, y * 4.4e-3 - 18
    bent = []
    for baseline in (6.0, 3.0):
        where = replace(PAPER, baseline_x=baseline)
        k = optics.paraxial_vector(where)[0] / 4.4e-3
        found = curvature_phase(x, y, where)
        # The baseline's own term is a plane, which a fit absorbs.
        plane = -k * qx * baseline**2 / (8 * 400.0**2)
        leading = -k * qx * (qx**2 + qy**2) / (2 * 400.0**2)
        np.testing.assert_allclose(found, leading + plane, rtol=5e-3)
        bent.append(found - plane)
    np.testing.assert_allclose(bent[0], 2 * bent[1], rtol=1e-3)


def test_a_share_of_it_is_that_share(make_effect_bench: Callable[..., Bench]) -> None:
    bench = make_effect_bench({"detector.shape": [31, 37]})
    recording = next(r for r in recordings(bench) if r.kind == "fringes")
    maps = detector_maps(bench.detector, (0, 31))
    plain = fringe_light(bench, 0, (0, 31), maps, 20_000.0)
    turns = []
    for share in (0.1, 1.0):
        bent = HyperbolicFringes(share=share).light(plain, recording, (0, 31), maps)
        turn = bent.phasor * plain.phasor.conj()
        turns.append(np.unwrap(np.angle(turn), axis=1))
    slope = [np.gradient(t, axis=1).mean() for t in turns]
    assert slope[0] == pytest.approx(0.1 * slope[1], rel=1e-3)


def found_near(foot: tuple[float, float], evidence: Evidence, limit: float) -> Estimate:
    """The estimate, whose foot is within four errors of the true one, which are below a limit."""
    found = HyperbolicFringes.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, HyperbolicFringes)
    assert found.effect.foot_mm is not None
    for n in (0, 1):
        error = found.errors[f"foot_mm[{n}]"]
        assert abs(found.effect.foot_mm[n] - foot[n]) < 4 * error < limit
    return found


@pytest.mark.long
@pytest.mark.parametrize("foot", [(18.0, 18.0), (-9.0, 4.0)])
def test_the_foot_is_found(acquired: Callable[..., Evidence], foot: tuple[float, float]) -> None:
    evidence = acquired(WINDOW, {"hyperbolic_fringes": {"foot_mm": list(foot)}})
    found = found_near(foot, evidence, 4.0)
    assert found.significance > 10


@pytest.mark.long
def test_a_foot_far_aside_is_found_from_the_fringes_that_are_wider_there(
    acquired: Callable[..., Evidence],
) -> None:
    """There the fringe vector is 4 to 12 % shorter than the paraxial one."""
    foot = (115.0, -30.0)
    evidence = acquired(WINDOW, {"hyperbolic_fringes": {"foot_mm": list(foot)}})
    found_near(foot, evidence, 8.0)


@pytest.mark.long
def test_positions_of_their_own_are_found(acquired: Callable[..., Evidence]) -> None:
    """The arms of a mount do not move together."""
    feet = {"vertical": (20.0, 14.0), "horizontal": (-16.0, 22.0)}
    pairs = [{"set": name, "foot_mm": list(foot)} for name, foot in feet.items()]
    found = HyperbolicFringes.estimate(acquired(WINDOW, {"hyperbolic_fringes": {"pairs": pairs}}))
    assert found is not None
    assert isinstance(found.effect, HyperbolicFringes)
    assert len(found.effect.pairs) == 2
    assert found.significance > 10
    for n, pair in enumerate(found.effect.pairs):
        for axis, true in enumerate(feet[pair.set]):
            error = found.errors[f"pairs[{n}].foot_mm[{axis}]"]
            assert abs(pair.foot_mm[axis] - true) < 4 * error < 12
        assert abs(pair.height_mm) < 4 * found.errors[f"pairs[{n}].height_mm"]


def test_a_ghost_is_not_taken_for_it(acquired: Callable[..., Evidence]) -> None:
    found = HyperbolicFringes.estimate(acquired(None, {"ghost_fringes": {}}))
    assert found is not None
    assert found.significance < 4
