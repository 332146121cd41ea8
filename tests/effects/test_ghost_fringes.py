"""Ghost fringes: constant in phase, a quarter period apart in the visibility, and found again."""

from collections.abc import Callable

import numpy as np
import pytest

from pixcal.effects import ghost_fringes
from pixcal.effects.ghost_fringes import GhostFringes
from pixcal.estimators.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.simulation.effect import FringeMaps
from pixcal.simulation.exposure import frames_of
from pixcal.simulation.recording import recordings


def plain_maps(k: tuple[float, float]) -> FringeMaps:
    y, x = np.mgrid[:40, :50]
    psi = k[0] * x + k[1] * y
    return FringeMaps(2e4 * np.stack([np.ones_like(psi), np.sin(psi), np.cos(psi)]), k)


@pytest.mark.parametrize("k", [(1.2, 0.0), (0.6, 0.1)])
def test_it_shifts_the_phase_by_its_share_whatever_the_interfringe(k: tuple[float, float]) -> None:
    maps, ghost = plain_maps(k), GhostFringes(0.004, (0.3, -0.2), 0.7)
    changed = ghost.predict(maps).theta
    ratio = (changed[2] + 1j * changed[1]) / (maps.theta[2] + 1j * maps.theta[1])
    y, x = np.mgrid[:40, :50]
    beat = 0.3 * x - 0.2 * y + 0.7
    np.testing.assert_allclose(np.angle(ratio), 0.004 * np.sin(beat), atol=2e-5)
    np.testing.assert_allclose(np.abs(ratio) - 1, 0.004 * np.cos(beat), atol=2e-5)
    np.testing.assert_array_equal(changed[0], maps.theta[0])


@pytest.mark.parametrize("in_flats", [False, True])
def test_one_that_stands_still_leaves_the_phase_alone(in_flats: bool) -> None:
    ghost = GhostFringes(0.05, follows=False, in_flats=in_flats)
    maps = plain_maps((1.2, 0.0))
    maps = FringeMaps(maps.theta, maps.k, (3, 4), np.ones((40, 50)))
    changed = ghost.predict(maps)
    np.testing.assert_allclose(
        np.arctan2(changed.theta[1], changed.theta[2]), np.arctan2(*maps.theta[1:]), atol=1e-12
    )
    y, x = np.mgrid[3:43, 4:54]
    wave = 1 + 0.05 * np.cos(0.35 * x + 0.2 * y)
    seen = changed.flat if in_flats else changed.theta[0] / 2e4
    np.testing.assert_allclose(seen, wave)
    np.testing.assert_allclose(ghost.undo(changed).theta, maps.theta)


def test_frames_hold_it(make_effect_bench: Callable[..., Bench]) -> None:
    """Mean of many frames: static fringes of its own vector; flats only where they are coherent."""
    bench = make_effect_bench(
        {"detector.shape": [32, 36], "frames.flats": [{"exptime_s": 0.02, "count": 40}]}
    )
    y, x = np.mgrid[:32, :36]
    carrier = np.exp(-1j * (0.35 * x + 0.2 * y))
    for in_flats in (False, True):
        ghost = GhostFringes(0.05, follows=False, in_flats=in_flats)
        for r in recordings(bench):
            if r.kind not in ("flat", "fringes"):
                continue
            plain, on = (frames_of(bench, r, e).mean(axis=0) for e in ((), (ghost,)))
            wave = 2 * np.mean((on / plain - 1) * carrier).real
            # Bias and dark dilute it by some per cent.
            expected = 0.05 if in_flats or r.kind == "fringes" else 0.0
            assert wave == pytest.approx(expected, abs=0.003)


@pytest.mark.parametrize("share", [5e-4, 5e-3])
def test_one_that_follows_is_found(acquired: Callable[..., Evidence], share: float) -> None:
    check(acquired(None, {"ghost_fringes": {"share": share, "phase_rad": 1.0}}), share, True, False)


@pytest.mark.parametrize("in_flats", [False, True])
def test_one_that_stands_still_is_found(acquired: Callable[..., Evidence], in_flats: bool) -> None:
    on = {"share": 5e-3, "phase_rad": 1.0, "follows": False, "in_flats": in_flats}
    check(acquired(None, {"ghost_fringes": on}), 5e-3, False, in_flats)


def check(evidence: Evidence, share: float, follows: bool, in_flats: bool) -> None:
    found = GhostFringes.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, GhostFringes)
    assert (found.effect.follows, found.effect.in_flats) == (follows, in_flats)
    truth = {
        "share": (found.effect.share, share),
        "phase_rad": (found.effect.phase_rad, 1.0),
        "beat_rad_px[0]": (found.effect.beat_rad_px[0], 0.35),
        "beat_rad_px[1]": (found.effect.beat_rad_px[1], 0.2),
    }
    for name, (value, true) in truth.items():
        assert abs(value - true) < 4 * found.errors[name], name
    assert found.errors["share"] < 0.02 * share + 5e-6
    assert found.significance > 7


@pytest.mark.parametrize("other", ["ipc", "nonlinearity", "flat_error"])
def test_others_are_not_taken_for_it(acquired: Callable[..., Evidence], other: str) -> None:
    found = GhostFringes.estimate(acquired(None, {other: {}}))
    assert found is not None
    assert found.significance < 4


def test_crosstalk_of_every_other_row_is_not_taken_for_it(
    acquired: Callable[..., Evidence], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is a wave in phase and visibility too, of rows that repeat."""
    coupling = {"dy": 1, "dx": 0, "share": 0.0023, "every_rows": 2}
    found = GhostFringes.estimate(acquired(None, {"ipc": {"couplings": [coupling]}}))
    assert found is not None
    assert found.significance < 4
    monkeypatch.setattr(ghost_fringes, "PERIODS", ())
    there = GhostFringes.estimate(acquired(None, {"ipc": {"couplings": [coupling]}}))
    assert there is not None
    assert there.significance > 6
