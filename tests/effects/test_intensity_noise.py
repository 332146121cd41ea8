"""Intensity noise: its size and correlation are those given, and are found again."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pixcal.effects.contrast_noise import ContrastNoise
from pixcal.effects.intensity_noise import IntensityNoise
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.light import ambient_shares
from pixcal.kernels.scene import frame_states
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Effect
from pixcal.simulation.exposure import states_of
from pixcal.simulation.recording import recordings


def recording(bench: Bench, count: int):  # type: ignore[no-untyped-def]
    fringes = next(r for r in recordings(bench) if r.kind == "fringes")
    scan = replace(bench.frames.fringes[0], count=count)
    frames = replace(bench.frames, fringes=(scan, *bench.frames.fringes[1:]))
    return replace(fringes, bench=replace(bench, frames=frames), count=count)


@pytest.mark.parametrize("correlation_s", [0.0, 1.4])
def test_the_factor_is_the_same_for_mean_and_fringe_and_has_the_size_given(
    make_effect_bench: Callable[..., Bench], correlation_s: float
) -> None:
    frames = recording(make_effect_bench(), 20_000)
    plain = states_of(frames, ())
    noisy = states_of(frames, (IntensityNoise(0.03, correlation_s),))
    factor = noisy.level / plain.level
    np.testing.assert_allclose(noisy.amplitude / plain.amplitude, factor)
    step = np.exp(-frames.period_s / correlation_s) if correlation_s else 0.0
    effective = len(factor) * (1 - step**2) / (1 + step**2)
    assert factor.std() == pytest.approx(0.03, rel=4 / np.sqrt(2 * effective))
    x = factor - factor.mean()
    assert (x[1:] @ x[:-1]) / (x @ x) == pytest.approx(step, abs=4 / np.sqrt(len(x)))


@pytest.mark.long
@pytest.mark.parametrize("rms", [0.002, 1e-4, 0.02])
def test_its_size_is_found(acquired: Callable[..., Evidence], rms: float) -> None:
    found = IntensityNoise.estimate(acquired(None, {"intensity_noise": {"rms": rms}}))
    assert found is not None
    assert isinstance(found.effect, IntensityNoise)
    assert abs(found.effect.rms - rms) < 4 * found.errors["rms"]
    assert found.errors["rms"] < max(0.05 * rms, 1e-5)
    assert found.significance > (20 if rms > 1e-3 else 4)


def test_a_line_is_the_mean_of_a_sine_over_the_exposure(
    make_effect_bench: Callable[..., Bench],
) -> None:
    frames = recording(make_effect_bench(), 5000)
    plain = states_of(frames, ())
    for hz, share in ((11.0, np.sinc(0.22)), (100.0, 0.0)):
        swung = states_of(frames, (IntensityNoise(0.0, 0.0, 0.01, hz),))
        assert (swung.level / plain.level).std() * np.sqrt(2) == pytest.approx(
            0.01 * share, rel=0.01, abs=1e-12
        )


@pytest.mark.long
def test_a_line_is_found_folded_below_half_the_frame_rate(
    acquired: Callable[..., Evidence],
) -> None:
    found = IntensityNoise.estimate(
        acquired(None, {"intensity_noise": {"rms": 0.0, "line": 1e-3, "line_hz": 11.0}})
    )
    assert found is not None
    assert isinstance(found.effect, IntensityNoise)
    folded = abs(11.0 - 2 / 0.14)
    assert abs(found.effect.line_hz - folded) < 4 * found.errors["line_hz"] < 0.01
    size = 1e-3 * np.sinc(0.22) / np.sinc(0.02 * folded)
    assert abs(found.effect.line - size) < 4 * found.errors["line"] < 1e-4
    assert found.significance > 20


@pytest.mark.long
def test_a_correlation_is_found(acquired: Callable[..., Evidence]) -> None:
    found = IntensityNoise.estimate(
        acquired(None, {"intensity_noise": {"rms": 0.01, "correlation_s": 1.4}})
    )
    assert found is not None
    assert isinstance(found.effect, IntensityNoise)
    assert abs(found.effect.correlation_s - 1.4) < 4 * found.errors["correlation_s"] < 2.0


def test_nothing_is_found_where_there_is_nothing(acquired: Callable[..., Evidence]) -> None:
    found = IntensityNoise.estimate(acquired())
    assert found is None or found.significance < 4


@pytest.mark.long
@pytest.mark.parametrize(
    "alike",
    [
        {"contrast_noise": {"vibration_rad": 0.2, "polarisation": 0.0}},
        {"bias_drift": {}},
        {"row_noise": {}},
        {"lag": {"share": 0.01}},
    ],
)
def test_what_looks_like_it_is_not_taken_for_it(
    acquired: Callable[..., Evidence], alike: dict[str, dict[str, float]]
) -> None:
    found = IntensityNoise.estimate(acquired(None, alike))
    assert found is not None
    assert found.significance < 4


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("kind", "on"),
    [
        (IntensityNoise, {"rms": 0.02, "line": 0.0}),
        (ContrastNoise, {"vibration_rad": 0.3, "polarisation": 0.0}),
    ],
)
def test_what_frames_did_is_replayed(
    acquired: Callable[..., Evidence],
    make_effect_bench: Callable[..., Bench],
    kind: type[Effect],
    on: dict[str, float],
) -> None:
    """Frame by frame: the states of the bench with the effect, from its tracks alone."""
    evidence = acquired(None, {kind.name: on})
    again = kind().replayed(evidence)
    assert again is not None
    bench = make_effect_bench()
    true = kind(**on)
    for recording in recordings(bench):
        if recording.kind == "fringes":
            plain = frame_states(bench, recording.number)
            one, other = (e.states(plain, recording) for e in (true, again))
            for name in ("level", "amplitude"):
                wanted, found = getattr(one, name), getattr(other, name)
                np.testing.assert_allclose(
                    found / np.median(found), wanted / np.median(wanted), atol=0.004
                )


@pytest.mark.long
@pytest.mark.parametrize("shares", [(0.0, 0.0), (0.05, 0.01)])
def test_ambient_light_is_told_from_a_change_of_contrast(
    acquired: Callable[..., Evidence], shares: tuple[float, float]
) -> None:
    on = {"rms": 0.02, "line": 0.0, "ambient": list(shares)}
    evidence = acquired(None, {"intensity_noise": on})
    for (value, error), true in zip(ambient_shares(evidence), shares, strict=True):
        assert abs(value - true) < 4 * error < 0.02
    found = IntensityNoise.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, IntensityNoise)
    assert any(found.effect.ambient) == any(shares)


@pytest.mark.long
@pytest.mark.parametrize(("separate", "recognised"), [(8e-4, True), (5e-3, False), (0.0, False)])
def test_fibres_that_change_separately_move_the_contrast_by_a_little(
    acquired: Callable[..., Evidence], separate: float, recognised: bool
) -> None:
    """Contrast that changes by up to a sixth of the intensity; more is an effect of its own."""
    on = {"rms": 0.01, "separate": separate}
    evidence = acquired(None, {"intensity_noise": on})
    found = IntensityNoise.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, IntensityNoise)
    assert found.effect.separate == (pytest.approx(separate, rel=0.2) if recognised else 0)
    replay = found.effect.replayed(evidence)
    assert replay is not None
    assert bool(replay.contrast_tracks) == recognised
