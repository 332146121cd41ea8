"""Differences of flats hold the noise of the detector, and nothing of how the light lies."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.test_statistics import DETECTOR, measure
from pixcal.estimators.test_statistics.frame_differences import differences


def with_sky(evidence: Evidence, slope: float) -> Evidence:
    """Flats whose light has a gradient that turns from frame to frame."""
    ny, nx = evidence.good.shape
    y, x = np.linspace(-0.5, 0.5, ny)[:, None], np.linspace(-0.5, 0.5, nx)
    stacks = []
    for stack in evidence.stacks:
        turn = 0.7 * np.arange(len(stack.adu))[:, None, None]
        sky = slope * (x * np.cos(turn) + y * np.sin(turn)) if stack.kind == "flat" else 0.0
        light = (stack.adu - evidence.bias) * sky
        stacks.append(replace(stack, adu=(stack.adu + light).astype(np.float32)))
    return replace(evidence, stacks=tuple(stacks))


def test_a_gradient_of_the_light_that_turns_is_no_noise_of_lines(
    acquired: Callable[..., Evidence],
) -> None:
    usual, sky = (
        measure(replace(with_sky(acquired(), slope), fringes={}))["flat_line_repeats", DETECTOR]
        for slope in (0.0, 0.03)
    )
    frames = sum(len(s.adu) // 2 for s in acquired().ladder)
    ny, nx = acquired().good.shape
    # Products of neighbouring lines: as many as there are lines in all differences.
    assert np.abs(sky.value - usual.value).max() < 4 / np.sqrt(frames * min(ny, nx))
    assert np.abs(sky.value).max() < 8 / np.sqrt(frames * min(ny, nx))


def test_noise_of_rows_stays(acquired: Callable[..., Evidence]) -> None:
    evidence, rng = acquired(), np.random.default_rng(3)
    rows = [40 * rng.standard_normal((*s.adu.shape[:2], 1)) for s in evidence.stacks]
    stacks = tuple(
        replace(s, adu=(s.adu + own).astype(np.float32))
        for s, own in zip(evidence.stacks, rows, strict=True)
    )
    noisy = replace(evidence, stacks=stacks)
    plain, found = (
        differences(one, one.of_kind("flat")[-1]).mean(axis=2).std() for one in (evidence, noisy)
    )
    assert found > 1.3 * plain


def test_frames_that_do_not_differ_have_no_statistics_of_noise(
    acquired: Callable[..., Evidence],
) -> None:
    """Copies of one frame, or frames that an effect drives below the converter's zero."""
    evidence = replace(acquired(), fringes={})
    stacks = evidence.stacks
    same = tuple(replace(s, adu=s.adu * (s.kind != "bias")) for s in stacks)
    usual, without = (measure(replace(evidence, stacks=s)) for s in (stacks, same))
    lost = {name for name, _ in usual.keys() - without.keys()}
    assert {"bias_smooth_patterns", "bias_tone", "bias_line_repeats"} <= lost
    assert all(name.startswith("bias") for name in lost)
