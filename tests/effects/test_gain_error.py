"""Gain error: the noise of light changes and its mean does not; found again, and told apart."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.gain_error import GainError
from pixcal.estimators.detector.flat_noise import shot_share_of_flats
from pixcal.estimators.diagnosis.evidence import Evidence, Stack
from pixcal.model.bench import Bench
from pixcal.simulation.recording import recordings

SHAPE = {"detector.shape": [41, 53]}


@pytest.mark.quick(1)
@pytest.mark.parametrize("relative", [-0.4, 0.15, 2.0])
def test_without_shot_noise_all_frames_stay(
    make_effect_bench: Callable[..., Bench], relative: float
) -> None:
    bench = replace(make_effect_bench(SHAPE), shot_noise=False)
    for recording in recordings(bench):
        plain, on = (
            frames_of(bench, recording, e).astype(int) for e in ((), (GainError(relative),))
        )
        # But for what is rounded the other way, now and then.
        assert np.abs(on - plain).max() <= 1
        assert np.mean(on != plain) < 0.02


@pytest.mark.parametrize("relative", [-0.4, 0.15, 2.0])
def test_shot_noise_is_that_of_the_true_electrons(
    make_effect_bench: Callable[..., Bench], relative: float
) -> None:
    bench = make_effect_bench(SHAPE)
    flat = [r for r in recordings(bench) if r.kind == "flat"][-1]
    dark = next(r for r in recordings(bench) if r.kind == "bias")
    variance = [
        frames_of(bench, r, e).astype(float).var(axis=0, ddof=1).mean()
        for r in (flat, dark)
        for e in ((), (GainError(relative),))
    ]
    freedom = 19 * 41 * 53
    assert (variance[1] - variance[3]) / (variance[0] - variance[2]) == pytest.approx(
        1 / (1 + relative), rel=5 * np.sqrt(4 / freedom)
    )
    assert variance[3] == variance[2]


def parts(evidence: Evidence) -> dict[str, Evidence]:
    return {
        "both": evidence,
        "flats": replace(evidence, fringes={}),
        "fringes": replace(evidence, stacks=evidence.of_kind("bias")),
    }


@pytest.mark.quick(1)
@pytest.mark.parametrize("relative", [-0.1, 0.03, 0.15])
def test_its_size_is_found(acquired: Callable[..., Evidence], relative: float) -> None:
    errors = {}
    for name, evidence in parts(acquired(None, {"gain_error": {"relative": relative}})).items():
        found = GainError.estimate(evidence)
        assert found is not None
        assert isinstance(found.effect, GainError)
        errors[name] = found.errors["relative"]
        assert abs(found.effect.relative - relative) < 3 * errors[name]
        assert (found.significance > 4) or name == "flats"
    assert errors["both"] < errors["fringes"] < 0.009
    assert errors["flats"] < 0.016


def test_nothing_is_found_where_the_gain_is_right(acquired: Callable[..., Evidence]) -> None:
    for evidence in parts(acquired()).values():
        found = GainError.estimate(evidence)
        assert found is not None
        assert found.significance < 3


@pytest.mark.quick(1)
@pytest.mark.parametrize("other", ["brighter_fatter", "ipc", "row_noise", "nonlinearity"])
def test_others_are_not_taken_for_it(acquired: Callable[..., Evidence], other: str) -> None:
    found = GainError.estimate(acquired(None, {other: {}}))
    assert found is not None
    assert found.significance < 4


@pytest.mark.long
def test_crosstalk_does_not_hide_it(acquired: Callable[..., Evidence]) -> None:
    evidence = acquired(None, {"ipc": {}, "gain_error": {"relative": 0.05}})
    found = GainError.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, GainError)
    assert abs(found.effect.relative - 0.05) < 4 * found.errors["relative"] < 0.03


def test_without_light_nothing_is_said(acquired: Callable[..., Evidence]) -> None:
    evidence = acquired()
    bare = replace(evidence, fringes={}, stacks=evidence.of_kind("bias"))
    assert GainError.estimate(bare) is None


def test_levels_of_a_lamp_that_was_changed_do_not_bend_the_gain(
    acquired: Callable[..., Evidence],
) -> None:
    whole = replace(acquired(), fringes={})
    rng, one = np.random.default_rng(8), whole.of_kind("flat")[0]
    flats = []
    for n, off in enumerate((3, -4, 2, -3, 4, -2, 3, -4, 2), start=1):
        light = whole.flat * 4000.0 * n
        electrons = rng.normal(light, np.sqrt(light + whole.read_noise**2), (2, *light.shape))
        # A lamp brighter by a quarter at the top, and set anew for each level.
        time = 0.01 * n * (1 - 0.25 * n / 9 + 0.01 * off)
        adu = (electrons / whole.gain + whole.bias).astype(np.float32)
        two = replace(one, frame=one.frame[:2], time_s=one.time_s[:2])
        flats.append(replace(two, adu=adu, exptime_s=time))
    stacks = (*(s for s in whole.stacks if s.kind != "flat"), *flats)
    share, error = shot_share_of_flats(replace(whole, stacks=stacks)) or (0.0, 0.0)
    assert abs(share - 1) < 4 * error < 0.2


def test_a_lamp_whose_pattern_drifts_adds_no_noise(acquired: Callable[..., Evidence]) -> None:
    whole = replace(acquired(), fringes={})

    def drifting(stack: Stack) -> Stack:
        wave = np.cos(2 * np.pi * np.arange(stack.adu.shape[2]) / 30)
        course = 0.02 * np.linspace(-1, 1, len(stack.adu))
        return replace(stack, adu=stack.adu * (1 + course[:, None, None] * wave).astype(np.float32))

    stacks = tuple(drifting(s) if s.kind == "flat" else s for s in whole.stacks)
    share, error = shot_share_of_flats(replace(whole, stacks=stacks)) or (0.0, 0.0)
    assert abs(share - 1) < 3 * error < 0.05


@pytest.mark.parametrize("factor", [1.0, 20.0, 200.0])
def test_a_grossly_wrong_gain_is_measured_as_well(
    acquired: Callable[..., Evidence], factor: float
) -> None:
    """As that of the output of a camera that multiplies electrons before it."""
    right = replace(acquired(), fringes={})
    noise = factor * right.read_noise
    wrong = replace(right, gain=factor * right.gain, read_noise=noise)
    (share, _), (more, error) = (shot_share_of_flats(one) or (0.0, 0.0) for one in (right, wrong))
    assert abs(more / factor - share) < error / factor < 0.02
