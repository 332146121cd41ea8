"""Effects whose noise is part of the measured read noise tell how much of it is theirs."""

from collections.abc import Callable

import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.output_jitter import OutputJitter
from pixcal.effects.pickup import Pickup
from pixcal.effects.row_noise import RowNoise
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Effect
from pixcal.simulation.recording import recordings


@pytest.mark.parametrize(
    "effect",
    [
        RowNoise(30.0, 0.0, 0.0, 0.0),
        RowNoise(0.0, 20.0, 0.0, 0.0),
        RowNoise(0.0, 0.0, 30.0, 10.0),
        RowNoise(0.0, 0.0, 0.0, 0.0, alternate_rms=30.0),
        OutputJitter(30.0, 0.0, (20,), (32,)),
        OutputJitter(30.0, 0.0, (), (8,)),
        Pickup((20.0, 10.0), (0.21, 0.4), (-0.13, 0.3)),
    ],
    ids=repr,
)
def test_noise_about_the_mean_of_frames(
    effect: Effect, make_effect_bench: Callable[..., Bench]
) -> None:
    bench = make_effect_bench()
    bias = next(r for r in recordings(bench) if r.kind == "bias")
    change = frames_of(bench, bias, [effect]).astype(float) - frames_of(bench, bias)
    change *= bench.detector.gain_e_per_adu
    each = change.var(axis=(1, 2))
    error = each.std(ddof=1) / np.sqrt(len(each))
    expected = effect.read_variance(bench.detector)
    # Of few rows, each has a part in the mean of the frame.
    assert each.mean() == pytest.approx(expected, abs=4 * error + 0.03 * expected)
    assert error < 0.2 * expected
