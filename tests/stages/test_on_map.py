"""What a cause does to the map of offsets, and what a reader is told of it."""

import numpy as np
import pytest

from pixcal.effects.brighter_fatter import BrighterFatter
from pixcal.effects.ipc import Ipc
from pixcal.effects.lag import Lag
from pixcal.effects.nonlinearity import Nonlinearity
from pixcal.estimators.detector.lag_by_level import FittedLoss
from pixcal.simulation.effect import FringeMaps
from pixcal.stages.advice import NOTHING, _correction_clause, limit, moved_by, size_of, unexplained
from pixcal.stages.diagnose.fitted_set import FittedSet
from pixcal.stages.diagnose.stage import on_map

K = (0.03, 2 * np.pi / 9)
UNFITTED = "auto", {}


def fitted(effect=None, shape=(48, 52)):
    """Maps of straight fringes, with an effect that acts on maps."""
    y, x = np.indices(shape, float)
    psi = K[0] * x + K[1] * y
    theta = np.stack([np.full(shape, 2e4), 1.8e4 * np.sin(psi), 1.8e4 * np.cos(psi)])
    maps = FringeMaps(theta, K)
    maps = maps if effect is None else effect.predict(maps)
    return FittedSet(maps.theta, np.zeros(shape), np.full(shape, 1e-4), K, (0, 0))


def test_crosstalk_that_repeats_moves_rows_by_its_share():
    """A share k from the row above turns the phase by k sin K in one row of two."""
    share = 0.02
    effect = Ipc.of_rows([np.array([[0, 0, 0], [0, 0, 0], [0, share, 0]]), np.zeros((3, 3))])
    found = on_map(effect, [fitted(effect)], UNFITTED)
    expected = share * np.sin(K[1]) / np.hypot(*K) / 2
    assert found["action"] == "corrected"
    assert found["rms_px"] == pytest.approx(expected, rel=0.1)
    assert found["max_px"] >= found["rms_px"]


def test_the_same_crosstalk_everywhere_is_a_shift_that_no_map_holds():
    effect = Ipc.nearest(0.01)
    inside = fitted(effect)
    inside.theta[:, [0, -1]] = inside.theta[:, :, [0, -1]] = np.nan
    # What the first row does not get reaches the second, with the square of the share.
    assert on_map(effect, [inside], UNFITTED)["rms_px"] < 0.01 * 0.01


def test_what_the_fit_takes_up_moves_nothing():
    found = on_map(Lag(), [fitted()], UNFITTED)
    assert found == {"rms_px": 0.0, "max_px": 0.0, "action": "unaffected"}


@pytest.mark.parametrize("effect", [Nonlinearity(), BrighterFatter()])
def test_what_acts_on_samples_moves_offsets_in_proportion(effect):
    one, double = (on_map(effect.scaled(f), [fitted()], UNFITTED)["rms_px"] for f in (1, 2))
    assert one > 0
    assert double == pytest.approx(2 * one, rel=0.15)


def size(*strengths):
    return {"units": dict.fromkeys(strengths, ""), "strengths": list(strengths)}


def test_the_size_of_an_effect_is_told_in_its_units():
    couplings = [{"share": 0.03}, {"share": -0.001}]
    cause = {"parameters": {"couplings": couplings}, **size("couplings")}
    assert size_of(cause) == "2 couplings, largest 3 %"
    wave = {"beat_rad_px": [0.7, 0.1], "static": [0.003, -0.004], "forward": [0.0, 0.001]}
    ghost = {"parameters": {"share": 0.0, "waves": [wave]}, **size("share", "waves")}
    assert size_of(ghost) == "1 wave, largest 0.5 %"
    points = [{"level_e": 0.0, "change_e": 0.0}, {"level_e": 5e3, "change_e": -100.0}]
    bent = {"strengths": ["bends"], "units": {"bends": ""}, "parameters": {"bends": points}}
    assert size_of(bent) == "2 bends, largest 2 %"
    told = {"value": -0.02, "error": 0.001, "unit": "", "of": "off a line at 900 e-"}
    assert size_of(bent | {"size": told}) == "−2.00 ± 0.10 % off a line at 900 e⁻"
    glow = {"parameters": {"rate": 118.0, "reach_px": 15.0}, "uncertainty": {"rate": 2.0}}
    own = glow | {"units": {"rate": "e-/s", "reach_px": "px"}, "strengths": ["rate"]}
    assert size_of(own) == "rate 118.0 ± 2.0 e⁻/s"
    assert size_of({"parameters": {"share": 0.0}, **size("share")}) == "-"
    units = {"coarse_adu": "ADU", "dnl_rms": "codes"}
    both = {"units": units, "strengths": list(units), "uncertainty": {"dnl_rms": 0.0047}}
    steps = both | {"parameters": {"coarse_adu": 3.0, "dnl_rms": 0.006}}
    assert size_of(steps) == "coarse 3.00 ADU"
    alone = both | {"parameters": {"coarse_adu": 0.0, "dnl_rms": 0.006}}
    assert size_of(alone) == "dnl rms 0.0060 ± 0.0047 codes"
    moved = {"parameters": {"tracks": [{"value": [59, 61]}, {"value": [-1, 1]}]}}
    drift = moved | {"strengths": ["tracks"], "units": {"tracks": "e-"}}
    assert size_of(drift) == "1.00 e⁻ rms, frame by frame, about a mean of 60.0 e⁻"


def test_what_no_cause_explains_has_a_size():
    tone = {"title": "tone", "place": "0.24", "unit": "σ", "measured": 128.0, "after": 0.0}
    shared = {"title": "correlation", "place": "x+2", "unit": "", "measured": -0.28, "after": 4e-5}
    drift = {"title": "level", "place": "all", "unit": "e-", "measured": 5.02, "after": 5.01}
    where = [tone | {"z_after": 30.0}, drift | {"z_after": 4.0}, shared | {"z_after": -9.0}]
    found = {"verdict": "unexplained", "gap": {"where": where}, "more_would_tell": ["darks"]}
    ((name, size, sigmas, _, action),) = unexplained(found)
    assert (name, sigmas) == ("unexplained", "30 σ")
    assert size.endswith("128 σ (simulated: 0); correlation, x+2: −28.0 % (simulated: 0)")
    assert action.endswith("recommended frames: darks")
    found["gap"]["where"] = where[1:2]
    assert unexplained(found)[0][1] == "level, all: 5.020 e⁻ (simulated: 5.010)"
    found["gap"]["where"] = [shared | {"measured": 6.34, "after": 3.97, "z_after": 5.0}]
    assert unexplained(found)[0][1] == "correlation, x+2: 6.34 (simulated: 3.97)"
    assert unexplained(found | {"verdict": "explained"}) == unexplained(NOTHING) == ()


def test_what_nothing_is_known_of_is_not_said_to_do_nothing():
    """An effect of one's own without `predict` or `undo` may bias the maps."""
    sigma = {"vertical": 1e-3}
    on_map_of = {
        "unaffected": (0.0, "none"),
        "fix the bench": (0.0, "not known"),
        "corrected": (2e-3, "0.0020 px rms (2.0 σ), 0.0040 px maximum"),
    }
    for action, (rms, said) in on_map_of.items():
        moved = {"rms_px": rms, "max_px": 2 * rms, "action": action}
        cause = {"effect": "glow", "on_map": moved}
        assert moved_by(cause, sigma) == said
        limited = limit(sigma, {"causes": [cause], "verdict": "explained"}, NOTHING)
        assert ("glow may bias" in limited) == (said == "not known")


@pytest.mark.parametrize("verdict", ["no gap", "explained", "partly explained", "unexplained"])
def test_maps_with_an_unexplained_gap_are_not_said_to_need_no_correction(verdict):
    diagnosis = {"causes": [], "verdict": verdict}
    clause = _correction_clause(diagnosis, NOTHING, "They need")
    biased = "may be biased" in limit({"vertical": 1e-3}, diagnosis, NOTHING)
    assert clause.startswith(" as fitted")
    assert ("no correction" in clause) == (not biased) == (verdict in ("no gap", "explained"))


def test_a_parameter_that_the_frames_do_not_tell_has_an_error_as_large_as_itself():
    found = FittedLoss(np.array([0.01, 4e3]), np.diag([1e-8, 1.6e-29]), 1.0)
    assert found.errors == pytest.approx([1e-4, 4e3])
