"""Rolling shutter: rows hold the next frame's light by their time; its times are found again."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from all_frames import frames_of
from joint_fit import fit_jointly

from pixcal.effects.rolling_shutter import RollingShutter
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.row_sums import profile
from pixcal.kernels.scene import frame_states
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.simulation.effect import FringeMaps
from pixcal.simulation.exposure import Camera
from pixcal.simulation.fringe_maps import FittedFrames
from pixcal.simulation.recording import recordings

RINGING = tuple(0.015 * np.exp(-r / 0.9) * np.cos(12 * r) for r in np.linspace(0, 1, 25))
LATE = 120_000.0
"""us: the frame's period less its exposure."""


@pytest.mark.parametrize(("delay", "way"), [(100.0, 1), (LATE + 100.0, -1)])
def test_rows_are_mixed_with_the_next_or_the_last_frame(
    make_effect_bench: Callable[..., Bench], delay: float, way: int
) -> None:
    bench = make_effect_bench({"detector.shape": [40, 30], "frames.fringes.0.count": 6})
    bench = replace(bench, shot_noise=False, detector=replace(bench.detector, read_noise_e=0.0))
    fringes = next(r for r in recordings(bench) if r.kind == "fringes")
    plain = frames_of(bench, fringes).astype(float)
    on = frames_of(bench, fringes, [RollingShutter(20.0, delay)]).astype(float)
    row = np.arange(40)
    share = np.maximum(20.0 * row - 100, 0) if way > 0 else np.maximum(100 - 20.0 * row, 0)
    share = share[:, None] * 1e-6 / 0.02
    for frame in (1, 2, 4):
        mixed = (1 - share) * plain[frame] + share * plain[frame + way]
        np.testing.assert_allclose(on[frame], mixed, atol=2.0)
    still = 5 if way > 0 else 0
    np.testing.assert_array_equal(on[still], plain[still])


def test_calibration_frames_are_left_alone(make_effect_bench: Callable[..., Bench]) -> None:
    bench = make_effect_bench({"detector.shape": [40, 30]})
    flat = next(r for r in recordings(bench) if r.kind == "flat")
    np.testing.assert_array_equal(
        frames_of(bench, flat), frames_of(bench, flat, [RollingShutter(50.0)])
    )


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("line", "delay"), [(0.1, 0.0), (1.2, 0.0), (5.0, 100.0), (5.0, LATE + 100.0)]
)
def test_its_times_are_found(acquired: Callable[..., Evidence], line: float, delay: float) -> None:
    on = {"rolling_shutter": {"line_time_us": line, "delay_us": delay}}
    found = RollingShutter.estimate(acquired(None, on))
    assert found is not None
    assert isinstance(found.effect, RollingShutter)
    error = found.errors["line_time_us"]
    assert abs(found.effect.line_time_us - line) < 4 * error < 0.25 * line
    assert abs(found.effect.delay_us - delay) < 4 * found.errors["delay_us"]
    assert found.significance > 10


@pytest.mark.quick(1)
@pytest.mark.parametrize("other", ["lag", "fringe_jitter", "intensity_noise"])
def test_others_are_not_taken_for_it(acquired: Callable[..., Evidence], other: str) -> None:
    found = RollingShutter.estimate(acquired(None, {other: {}}))
    assert found is not None
    assert found.significance < 4


def test_phases_in_equal_steps_tell_nothing(acquired: Callable[..., Evidence]) -> None:
    ramp = {f"frames.fringes.{n}.phase_law": "ramp" for n in (0, 1)}
    ramp |= {f"frames.fringes.{n}.phase_step_rad": 0.3 for n in (0, 1)}
    found = RollingShutter.estimate(acquired(ramp, {"rolling_shutter": {"line_time_us": 26.0}}))
    assert found is not None
    assert found.significance < 4


@pytest.mark.parametrize("times", [{"line_time_us": 3000.0}, {"delay_us": 2e5}])
def test_times_longer_than_a_frame_are_refused(
    make_effect_bench: Callable[..., Bench], times: dict[str, float]
) -> None:
    with pytest.raises(InputError, match=rf"^{next(iter(times))}: .*period_s"):
        RollingShutter(**times).check(make_effect_bench())


SETTLING = tuple(0.02 * np.exp(-np.linspace(0, 1, 9) / 0.4) - 0.006)


def test_rows_are_turned_by_a_share_of_the_last_step(
    make_effect_bench: Callable[..., Bench],
) -> None:
    bench = make_effect_bench({"detector.shape": [40, 30], "frames.fringes.0.count": 6})
    bench = replace(bench, shot_noise=False, detector=replace(bench.detector, read_noise_e=0.0))
    fringes = next(r for r in recordings(bench) if r.kind == "fringes")
    shutter = RollingShutter(0.0, settling=(0.3, 0.2, 0.1, 0.0))
    plain = frames_of(bench, fringes).astype(float)
    on = frames_of(bench, fringes, [shutter]).astype(float)
    phi = frame_states(bench, 0).phi
    light = Camera(bench, (0, 40), []).light(fringes)
    for frame in (1, 4):
        step = np.angle(np.exp(1j * (phi[frame - 1] - phi[frame])))
        turn = step * np.linspace(0.3, 0.0, 40)[:, None]
        z = (light.alpha_cos + 1j * light.alpha_sin) * np.exp(1j * phi[frame])
        np.testing.assert_allclose(
            on[frame] - plain[frame], np.imag(z * np.exp(1j * turn)) - z.imag, atol=2.0
        )
    np.testing.assert_array_equal(on[0], plain[0])


@pytest.mark.long
@pytest.mark.parametrize("share", [SETTLING, tuple(np.linspace(0.01, -0.01, 9)), RINGING])
@pytest.mark.parametrize("origin", [None, 0.0])
def test_a_modulator_that_settles_is_found(
    acquired: Callable[..., Evidence], share: tuple[float, ...], origin: float | None
) -> None:
    """A straight profile too, which the fit's free fringe vectors take up."""
    on = {"line_time_us": 0.0, "settling": [float(v) for v in share], "origin_rad": origin}
    evidence = acquired(None, {"rolling_shutter": on})
    found = RollingShutter.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, RollingShutter)
    assert found.effect.of_step == "last"
    assert found.significance > 10
    assert found.again is not None
    again = found.again.detect(evidence)
    assert again == pytest.approx(found.significance, rel=0.05)  # one way was tried, not all
    at = np.linspace(0, 1, len(share))
    apart = profile(found.effect.settling, at) - (np.array(share) - np.mean(share))
    # But for the mean, which is the frames' own phase. One row tells of the spline's first end.
    assert np.std(apart[1:]) < 0.025 * np.ptp(share)
    assert 4 * found.errors["settling[0]"] < 0.4 * np.ptp(share)
    # The first end of a ringing profile comes out low: by 2 to 5 errors in eight draws.
    limit = 0.25 * np.ptp(share) if share == RINGING else 4 * found.errors["settling[0]"]
    assert abs(apart[0]) < limit


def test_phases_that_stand_still_settle_nothing(acquired: Callable[..., Evidence]) -> None:
    found = RollingShutter.estimate(acquired())
    assert found is not None
    assert found.significance < 4


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "shutter",
    [
        RollingShutter(0.0, settling=RINGING),
        RollingShutter(25.0, 100.0),
        RollingShutter(25.0, LATE + 700.0),
    ],
)
def test_what_the_rows_leave_in_the_maps_is_undone(shutter: RollingShutter) -> None:
    """Random phases: what no fit of the frames can follow becomes a pattern of the pixels."""
    rng = np.random.default_rng(8)
    ny, nx, count, exptime = 31, 37, 80, 0.02
    y, x = np.indices((ny, nx), float)
    psi = 2 * np.pi / 7.3 * x + 0.05 * y
    theta = np.stack([np.full(psi.shape, 2e4), 1.8e4 * np.sin(psi), 1.8e4 * np.cos(psi)])
    phi = rng.uniform(0, 2 * np.pi, count)
    g = np.stack([np.ones(count), np.cos(phi), np.sin(phi)], axis=1)
    samples = np.einsum("ti,iyx->tyx", g, theta)
    plain = samples.copy()
    if any(shutter.settling):
        step = np.angle(np.exp(1j * (phi - np.roll(phi, 1))))
        step[0] = 0.0
        turn = -step[:, None] * profile(shutter.settling, np.linspace(0, 1, ny))
        at = psi + phi[:, None, None] + turn[:, :, None]
        samples = theta[0] + 1.8e4 * np.sin(at)
    else:
        after, before = shutter.shares(np.arange(ny, dtype=float), exptime, 0.14)
        samples[:-1] += after[:, None] * (plain[1:] - plain[:-1])
        samples[1:] += before[:, None] * (plain[:-1] - plain[1:])
    fitted, g = fit_jointly(samples, theta, g)
    frames = FittedFrames(g, (0, ny), 0.0, exptime, 0.14, vectors_free=False)
    undone = shutter.undo(FringeMaps(fitted, (2 * np.pi / 7.3, 0.05), frames=frames))
    assert undone is not None

    def moved(maps: np.ndarray) -> float:
        """Of the phases, but for their mean and the two harmonics that a fit leaves free."""
        change = np.angle((maps[2] + 1j * maps[1]) / (theta[2] + 1j * theta[1])).ravel()
        p = psi.ravel()
        free = np.stack([p * 0 + 1, np.cos(p), np.sin(p), np.cos(2 * p), np.sin(2 * p)], axis=1)
        return float((change - free @ np.linalg.lstsq(free, change, rcond=None)[0]).std())

    assert moved(fitted) > 2e-4
    assert moved(undone.theta) < 0.12 * moved(fitted)


@pytest.mark.parametrize("first", [0, 700])
def test_a_piece_is_undone_as_the_whole(first: int) -> None:
    """Also where it goes on beyond the window, or the window is simulated by itself."""
    ny, nx, halo = 29, 41, 8
    y, x = np.indices((ny + 2 * halo, nx), float)
    psi = 0.8 * x + 0.05 * y
    theta = np.stack([np.full(psi.shape, 2e4), 1.8e4 * np.sin(psi), 1.8e4 * np.cos(psi)])
    phi = np.random.default_rng(3).uniform(0, 2 * np.pi, 30)
    g = np.stack([np.ones(30), np.cos(phi), np.sin(phi)], axis=1)
    frames = FittedFrames(g, (first, ny), 16.0, 0.02, 0.14, vectors_free=True)
    shutter = RollingShutter(0.0, settling=RINGING)

    def change(rows: slice, origin: int) -> np.ndarray:
        maps = FringeMaps(theta[:, rows], (0.8, 0.05), (first + origin, 0), frames=frames)
        undone = shutter.undo(maps)
        assert undone is not None
        return undone.theta - maps.theta

    whole = change(slice(halo, ny + halo), 0)
    assert np.abs(whole).max() > 10
    beyond = change(slice(None), -halo)
    np.testing.assert_allclose(beyond[:, halo:-halo], whole, atol=0.01)
    np.testing.assert_allclose(change(slice(halo + 5, halo + 19), 5), whole[:, 5:19], atol=0.01)


def test_frames_that_are_not_known_undo_nothing() -> None:
    maps = FringeMaps(np.ones((3, 4, 5)), (0.7, 0.0))
    assert RollingShutter(0.0, settling=RINGING).undo(maps) is None


def test_an_unknown_exposure_time_is_an_instant() -> None:
    """Rows that start after the step hold the next frame whole; without a line time none does."""
    rows = np.arange(5.0)
    for shutter, after in (
        (RollingShutter(0.0), [0.0] * 5),
        (RollingShutter(2.0, 3.0), [0, 0, 1, 1, 1]),
    ):
        following, last = shutter.shares(rows, 0.0, 0.14)
        np.testing.assert_array_equal(following, after)
        np.testing.assert_array_equal(last, 0.0)
