"""Of an effect's strengths, those that are not known to be there are left out."""

import numpy as np
import pytest

from pixcal.effects.bias_drift import BiasDrift
from pixcal.effects.ipc import Ipc
from pixcal.effects.lag import Lag
from pixcal.effects.straylight import Straylight
from pixcal.simulation.effect import Effect, Estimate


def significant_part(effect: Effect, **errors: float) -> Effect:
    return Estimate(effect, errors, 5.0, "").significant_part


def test_a_strength_within_its_error_is_left_out() -> None:
    drift = BiasDrift(jitter_rms=2.0, ramp_e_h=3000.0, walk_e_h=0.0, settle_e=0.0, settle_s=60.0)
    found = significant_part(drift, jitter_rms=0.3, ramp_e_h=1300.0, walk_e_h=50.0)
    assert found == BiasDrift(
        jitter_rms=2.0, ramp_e_h=0.0, walk_e_h=0.0, settle_e=0.0, settle_s=60.0
    )
    assert significant_part(drift, jitter_rms=0.3, ramp_e_h=900.0) == drift


def test_one_sure_part_keeps_all_parts() -> None:
    light = Straylight(share=0.05, slope_per_px=(1e-5, 1e-6))
    errors = {"slope_per_px[0]": 1e-6, "slope_per_px[1]": 1e-6}
    assert significant_part(light, share=0.1, **errors) == Straylight(
        share=0.0, slope_per_px=(1e-5, 1e-6)
    )
    assert significant_part(light, share=0.001, **dict.fromkeys(errors, 1e-4)) == Straylight(
        share=0.05, slope_per_px=(0.0, 0.0)
    )


def test_a_part_that_was_not_there_to_be_measured_is_no_sure_part() -> None:
    light = Straylight(share=0.05, slope_per_px=(1e-6, 0.0))
    found = significant_part(light, share=0.001, **{"slope_per_px[0]": 1e-5})
    assert found == Straylight(share=0.05, slope_per_px=(0.0, 0.0))


def test_finer_points_that_may_be_nothing_are_left_out() -> None:
    lag = Lag(share=1e-4, decay_frames=0.9, spread=0.7)
    errors = {"share": 7e-6, "decay_frames": 0.08, "spread": 0.4}
    assert significant_part(lag, **errors) == Lag(share=1e-4, decay_frames=0.9, spread=0.0)
    assert significant_part(lag, **errors | {"spread": 0.2}) == lag


def test_an_effect_stays_what_it_is_where_nothing_of_it_is_sure_or_errors_are_not_told() -> None:
    drift = BiasDrift()
    assert (
        significant_part(drift, jitter_rms=9.0, ramp_e_h=9.0, walk_e_h=9.0, settle_e=9.0) == drift
    )
    assert significant_part(drift) == drift
    assert significant_part(Ipc(), **{"couplings[0].share": 1.0}) == Ipc()


def test_parameters_are_moved_by_their_errors_and_what_is_zero_stays() -> None:
    drift = BiasDrift(jitter_rms=2.0, ramp_e_h=3000.0, walk_e_h=0.0, settle_e=0.0, settle_s=60.0)
    known = Estimate(drift, {"jitter_rms": 0.1, "ramp_e_h": 500.0, "walk_e_h": 9.0}, 5.0, "")
    moved = [known.scattered(drift, seed) for seed in range(400)]
    assert known.scattered(drift, 7) == moved[7]
    assert all(m.walk_e_h == 0 and m.settle_s == 60 for m in moved if isinstance(m, BiasDrift))
    for name, value, error in (("jitter_rms", 2.0, 0.1), ("ramp_e_h", 3000.0, 500.0)):
        values = np.array([getattr(m, name) for m in moved])
        assert abs(values.mean() - value) < 4 * error / 20
        assert values.std() == pytest.approx(error, rel=0.15)
    half = drift.scaled(0.5)
    apart = [known.scattered(half, seed).jitter_rms - 1 for seed in range(400)]
    assert np.std(apart) == pytest.approx(0.1, rel=0.15)


def test_parts_of_vectors_and_lists_are_moved_too() -> None:
    light = Straylight(share=0.05, slope_per_px=(1e-5, 0.0))
    errors = {"slope_per_px[0]": 1e-6, "slope_per_px[1]": 1e-6}
    moved = Estimate(light, errors, 5.0, "").scattered(light, 3)
    assert isinstance(moved, Straylight)
    assert moved.slope_per_px[0] != 1e-5
    assert moved.slope_per_px[1] == 0
    assert moved.share == 0.05
    coupled = Ipc()
    found = Estimate(coupled, {"couplings[1].share": 1e-4}, 5.0, "").scattered(coupled, 3)
    assert isinstance(found, Ipc)
    assert found.couplings[0] == coupled.couplings[0]
    assert 0 < abs(found.couplings[1].share - coupled.couplings[1].share) < 5e-4


def test_what_would_leave_its_range_is_not_moved() -> None:
    drift = BiasDrift(jitter_rms=0.1, ramp_e_h=0.0, walk_e_h=0.0, settle_e=0.0)
    known = Estimate(drift, {"jitter_rms": 10.0}, 5.0, "")
    moved = [known.scattered(drift, seed) for seed in range(40)]
    assert any(m == drift for m in moved)
    assert all(m.jitter_rms > 0 for m in moved)


def test_parameters_whose_errors_hang_together_are_moved_together() -> None:
    drift = BiasDrift(jitter_rms=2.0, ramp_e_h=3000.0, walk_e_h=0.0, settle_e=0.0, settle_s=60.0)
    steps = {"jitter_rms": 0.1, "ramp_e_h": -500.0}
    known = Estimate(drift, {"jitter_rms": 0.1, "ramp_e_h": 500.0}, 5.0, "", (steps,))
    for seed in range(10):
        moved = known.scattered(drift, seed)
        assert isinstance(moved, BiasDrift)
        assert (moved.jitter_rms - 2) / 0.1 == pytest.approx((moved.ramp_e_h - 3000) / -500)
        assert moved.jitter_rms != 2
