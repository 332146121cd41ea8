"""Cameras of the second bench are what they say."""

import numpy as np
import pytest

from second_bench.sensors import KINDS, make

SHAPE = (48, 64)


def halved_variance(pair: np.ndarray) -> float:
    one, other = pair[:2].astype(float)
    return float(np.var(one - other) / 2)


@pytest.mark.parametrize("seed", range(3))
def test_photon_transfer_of_a_plain_camera_has_its_gain(seed: int) -> None:
    sensor, truth = make("plain", seed, (200, 200), "lamp")
    stacks = list(sensor.frames())
    bias = next(cube for one, cube in stacks if one.kind == "bias")
    flat = [cube for one, cube in stacks if one.kind == "flat"][-1]
    noise = halved_variance(flat) - halved_variance(bias)
    gain = (flat.mean() - bias.mean()) / noise
    assert gain == pytest.approx(truth["gain"], rel=5 * np.sqrt(2 / 200**2))


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_makes_the_same_frames_again(kind: str) -> None:
    one, other = (make(kind, 5, SHAPE)[0].frames() for _ in range(2))
    for (series, a), (_, b) in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b, err_msg=series.kind)
