"""Lag: no charge is lost, noise stays white, frames are as published; its share is found again."""

from collections.abc import Callable
from dataclasses import replace

import galsim
import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.lag import Lag
from pixcal.estimators.detector.first_flats import lag_of_flats
from pixcal.estimators.detector.flat_ladder import warming
from pixcal.estimators.detector.frame_lag import LagNonuniformity
from pixcal.estimators.diagnosis.central_crop import central_crop
from pixcal.estimators.diagnosis.evidence import Evidence, Stack
from pixcal.kernels.charge_release import without_lag
from pixcal.kernels.normals import Key, pixel_normals
from pixcal.kernels.scene import Rows
from pixcal.model.arrays import F32
from pixcal.model.bench import Bench
from pixcal.simulation import exposure
from pixcal.simulation.exposure import Camera
from pixcal.simulation.recording import Recording, recordings

SMALL = {"detector.shape": [23, 19], "frames.fringes.0.count": 40}
FLATS = {"detector.shape": [64, 61], "frames.flats": [{"exptime_s": 0.02, "count": 40}]}


def of_kind(bench: Bench, kind: str) -> Recording:
    return next(r for r in recordings(bench) if r.kind == kind)


def quiet(bench: Bench) -> Bench:
    return replace(bench, shot_noise=False, detector=replace(bench.detector, read_noise_e=0.0))


@pytest.mark.parametrize("decay", [0.0, 1.2])
def test_frames_are_those_of_published_persistence(
    make_effect_bench: Callable[..., Bench], decay: float
) -> None:
    bench, lag = quiet(make_effect_bench(SMALL)), Lag(0.03, decay, 0.0)
    fringes = of_kind(bench, "fringes")
    plain = frames_of(bench, fringes) - bench.detector.bias_adu
    bias = frames_of(bench, replace(of_kind(bench, "bias"), count=1))[0].astype(float)
    made = frames_of(bench, fringes, [lag])
    plain = frames_of(bench, fringes) - bias
    for n in (0, 1, 25):
        image = galsim.Image((0.97 * plain[n]).copy())
        before = [galsim.Image(plain[k]) for k in range(n - 1, -1, -1)][: lag.frames_back]
        image.applyPersistence(before, list(0.03 * lag.releases[: len(before)]))
        np.testing.assert_allclose(made[n] - bias, image.array, atol=1.6)
    assert lag.releases.sum() == pytest.approx(1)
    if decay:
        ratio = lag.releases[1:] / lag.releases[:-1]
        np.testing.assert_allclose(ratio, np.exp(-1 / decay))


def test_noise_stays_white_and_poisson(make_effect_bench: Callable[..., Bench]) -> None:
    bench = make_effect_bench({**FLATS, "detector.read_noise_e": 0.0, "detector.prnu_rms": 0.0})
    flat = of_kind(bench, "flat")
    frames = frames_of(bench, flat, [Lag(0.2, 0.0, 0.0)])[2:].astype(float)
    noise = frames - frames.mean(axis=(0))
    n = noise.size
    kept = 1 - 1 / len(noise)
    assert noise.var() / kept == pytest.approx(flat.electrons, rel=4 * np.sqrt(2 / n))
    neighbours = (noise[1:] * noise[:-1]).mean() / noise.var()
    assert neighbours == pytest.approx(-1 / len(noise), abs=4 / np.sqrt(n))


def test_the_first_frame_lacks_what_stays(make_effect_bench: Callable[..., Bench]) -> None:
    bench = quiet(make_effect_bench({**FLATS, "detector.dark_e_s": 0.0}))
    flat = of_kind(bench, "flat")
    plain = frames_of(bench, flat).astype(float) - 500
    made = frames_of(bench, flat, [Lag(0.05, 0.0, 0.0)]).astype(float) - 500
    assert made[0].mean() / plain[0].mean() == pytest.approx(0.95, abs=2e-3)
    np.testing.assert_allclose(made[1:], plain[1:], atol=1.1)


def test_pixels_differ_by_the_spread(make_effect_bench: Callable[..., Bench]) -> None:
    bench = quiet(make_effect_bench({**FLATS, "detector.dark_e_s": 0.0}))
    flat = of_kind(bench, "flat")
    plain = frames_of(bench, flat)[0].astype(float) - 500
    made = frames_of(bench, flat, [Lag(0.1, 0.0, 0.3)])[0].astype(float) - 500
    shares = 1 - made / plain
    assert shares.mean() == pytest.approx(0.1, abs=4 * 0.03 / np.sqrt(shares.size))
    assert shares.std() == pytest.approx(0.03, rel=4 / np.sqrt(2 * shares.size))


@pytest.mark.parametrize(
    "lag",
    [
        Lag(0.05, 1.2, 0.1, carried=0.7),
        Lag(0.05, 0.3, 0.1, quiet=0.4),
        Lag(0.05, later=(0.5, 0.3, 0.2), carried=1.0),
        Lag(0.05, 0.8, 0.2, capacity_e=300.0, carried=1.0),
        Lag(0.05, carried=1.0, decay_s=2.0),
        Lag(0.05, carried=1.0, decay_s=2.0, slow_part=0.4, slow_s=9.0),
    ],
)
def test_frames_depend_neither_on_their_order_nor_on_where_one_begins(
    make_effect_bench: Callable[..., Bench], lag: Lag
) -> None:
    bench = make_effect_bench(SMALL)
    flat, fringes = of_kind(bench, "flat"), of_kind(bench, "fringes")
    fringes = replace(fringes, before=replace(flat, count=9))
    whole = frames_of(bench, fringes, [lag])
    order = [31, 30, 39, 2, 35, 36, 3, 0, 12]
    for n, samples in Camera(bench, (5, 18), [lag]).expose(fringes, order):
        assert np.array_equal(samples, whole[n, 5:18])
    camera, again = Camera(bench, (0, 23), [lag]), []
    for recording in (fringes.before, fringes, fringes.before):
        again += [samples.copy() for _, samples in camera.expose(recording, range(9))]
    assert np.array_equal(again[9:18], whole[:9])
    assert np.array_equal(again[18:], again[:9])


def test_released_charge_is_lost_once_and_stays_white(
    make_effect_bench: Callable[..., Bench],
) -> None:
    """Frames in the dark share what a bright one left: in all, no more than that."""
    changes = {"detector.read_noise_e": 0.0, "detector.dark_e_s": 0.0, "detector.prnu_rms": 0.0}
    bench = make_effect_bench({**FLATS, **changes})
    flat, dark = of_kind(bench, "flat"), of_kind(bench, "dark")
    lag = Lag(0.1, 2.0, 0.0, carried=1.0)
    after = replace(dark, before=replace(flat, count=1), count=12)
    plain = frames_of(bench, after)
    late = frames_of(bench, after, [lag])[:, plain[0] == bench.detector.bias_adu].astype(float)
    late -= bench.detector.bias_adu  # without hot pixels
    n = late.shape[1]
    of_all = flat.electrons * 0.1 * (1 - np.exp(-12 / 2))
    assert late.sum(axis=0).mean() == pytest.approx(of_all, abs=5 * np.sqrt(of_all / n))
    # Released by chance, electron by electron: counts of different frames are independent.
    variance, mean = late.var(axis=1)[:5], late.mean(axis=1)[:5]
    np.testing.assert_allclose(variance, mean, rtol=5 * np.sqrt(2 / n))
    correlated = np.corrcoef(late[:5])[np.triu_indices(5, 1)]
    np.testing.assert_allclose(correlated, 0, atol=5 / np.sqrt(n))


def test_a_frame_of_long_lag_is_computed_once(
    make_effect_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the order of time, each frame is one step, over all recordings."""
    bench, lag = make_effect_bench(SMALL), Lag(0.05, carried=1.0, decay_s=20.0)
    flat, fringes = of_kind(bench, "flat"), of_kind(bench, "fringes")
    fringes, made = replace(fringes, before=flat), []
    counted = Lag.carry
    monkeypatch.setattr(
        Lag, "carry", lambda self, *args: (made.append(args[2].frame), counted(self, *args))[1]
    )
    camera = Camera(bench, (0, 23), [lag])
    for recording in (flat, fringes):
        for _ in camera.expose(recording, range(recording.count)):
            pass
    assert len(made) == flat.count + fringes.count


def test_noise_is_drawn_once_for_a_frame_wherever_one_begins(
    make_effect_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, lag = make_effect_bench(SMALL), Lag(0.05, 1.5, 0.1)
    fringes = of_kind(bench, "fringes")
    drawn: list[tuple[Key, int]] = []

    def counted(key: Key, frame: int, rows: Rows, columns: int) -> F32:
        drawn.append((key, frame))
        return pixel_normals(key, frame, rows, columns)

    monkeypatch.setattr(exposure, "pixel_normals", counted)
    for _ in Camera(bench, (5, 18), [lag]).expose(fringes, range(33, 38)):
        pass
    own = sorted(frame for key, frame in drawn if key == fringes.effect_key(lag.name))
    assert lag.memory.block == 32
    assert own == list(range(32 - lag.frames_back, 38))


FULL = Lag(0.03, 0.0, 0.0, (2.0, 1.2, 0.8, 0.3), 40_000.0, (0.6, 0.3, 0.1))
TRAPS = Lag(0.03, 1.5, 0.0, capacity_e=900.0)


@pytest.mark.parametrize("lag", [Lag(0.02, 0.0, 0.0), Lag(0.05, 1.5, 0.0), FULL, TRAPS])
def test_frames_are_restored(make_effect_bench: Callable[..., Bench], lag: Lag) -> None:
    bench = quiet(make_effect_bench(SMALL))
    fringes = of_kind(bench, "fringes")
    bias = frames_of(bench, replace(of_kind(bench, "bias"), count=1))[0].astype(np.float32)
    plain = frames_of(bench, fringes) - bias
    made = frames_of(bench, fringes, [lag]) - bias
    assert np.abs(made - plain).max() > 200
    found = made
    for _ in range(4):
        found = made + lag.lost(found)[0]
    np.testing.assert_allclose(found, plain, atol=3)
    if not lag.bands and not lag.capacity_e:
        keep = np.exp(-1 / lag.decay_frames) if lag.decay_frames else 0.0
        np.testing.assert_allclose(without_lag(made, lag.share, keep), plain, atol=3)


@pytest.mark.long
@pytest.mark.parametrize(
    "truth",
    [Lag(), Lag(2e-4, 0.0, 0.1), Lag(0.005, 1.5, 0.1), Lag(0.03, 0.0, 0.1), Lag(0.05, 2.0, 0.2)],
)
def test_its_share_is_found(acquired: Callable[..., Evidence], truth: Lag) -> None:
    parameters = {"share": truth.share, "decay_frames": truth.decay_frames, "spread": truth.spread}
    found = Lag.estimate(acquired(None, {"lag": parameters}))
    assert found is not None
    assert isinstance(found.effect, Lag)
    for name in parameters:
        off = getattr(found.effect, name) - getattr(truth, name)
        assert abs(off) < 4 * found.errors[name], name
    assert found.errors["share"] < 0.03 * truth.share
    assert found.significance > 20
    # Pixels that differ in their share do not pass for a share that depends on the level.
    assert found.effect.bands == ()
    assert not found.effect.capacity_e


@pytest.mark.long
@pytest.mark.parametrize("quiet", [0.0, 1.0])
def test_whether_what_comes_out_has_noise_shows_in_the_residuals(
    acquired: Callable[..., Evidence], quiet: float
) -> None:
    found = Lag.estimate(acquired(None, {"lag": {"share": 0.03, "spread": 0.0, "quiet": quiet}}))
    assert found is not None
    effect, error = found.effect, found.errors["quiet"]
    assert isinstance(effect, Lag)
    assert error < 0.25
    assert abs(effect.quiet - quiet) < 4 * error


@pytest.mark.long
def test_pixels_that_differ_tell_where_the_contrast_is_noisy(
    acquired: Callable[..., Evidence],
) -> None:
    noisy = {"optics.visibility": 0.9}
    white = {"vibration_rad": 0.0, "polarisation": 0.03, "polarisation_s": 0.0}
    effects = {"contrast_noise": white, "lag": {"share": 0.004, "spread": 0.2}}
    evidence = acquired(noisy, effects)
    found = Lag.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, Lag)
    assert 1e-3 < found.errors["share"] < 4e-3
    assert abs(found.effect.share - 0.004) < 4 * found.errors["share"]
    assert LagNonuniformity.of(central_crop(evidence).fringes.values()).sigmas > 10
    assert found.significance > 10
    nothing = Lag.estimate(acquired(noisy, {"contrast_noise": white}))
    assert nothing is not None
    assert nothing.significance < 4


@pytest.mark.long
def test_flats_tell_where_there_are_no_fringes(acquired: Callable[..., Evidence]) -> None:
    found = Lag.estimate(replace(acquired(None, {"lag": {}}), fringes={}))
    assert found is not None
    assert isinstance(found.effect, Lag)
    assert abs(found.effect.share - Lag().share) < 4 * found.errors["share"] < 4e-4
    assert found.significance > 8
    nothing = Lag.estimate(replace(acquired(), fringes={}))
    assert nothing is not None
    assert nothing.significance < 4
    assert Lag.estimate(replace(acquired(), fringes={}, stacks=())) is None


def test_what_the_frame_before_left_comes_out_in_the_first(
    make_effect_bench: Callable[..., Bench],
) -> None:
    two = [{"exptime_s": 0.02, "count": 3}, {"exptime_s": 0.04, "count": 3}]
    bench = quiet(make_effect_bench({**FLATS, "frames.flats": two, "detector.dark_e_s": 0.0}))
    dim, bright = (r for r in recordings(bench) if r.kind == "flat")
    plain = [frames_of(bench, r)[0].astype(float) - 500 for r in (dim, bright)]
    for carried in (0.0, 0.6, 1.0):
        lag = Lag(0.05, 0.0, 0.0, carried=carried)
        made = frames_of(bench, replace(bright, before=dim), [lag])[0].astype(float) - 500
        expected = 0.95 * plain[1] + 0.05 * carried * plain[0]
        np.testing.assert_allclose(made, expected, atol=1.6)


def first_flats_of(frames: int, share: float, carried: float, rise: float) -> Evidence:
    """Flats of rising levels, with lag and a lamp that gets brighter from frame to frame."""
    rng, flicker, shape = np.random.default_rng(5), 1e-3, (24, 24)
    stacks = [
        Stack("bias", 0.0, np.arange(20), np.arange(20.0), rng.normal(100, 5, (20, *shape)), 0.0)
    ]
    before, number = 0.0, np.arange(frames)
    for n, level in enumerate(np.linspace(1000, 20_000, 12)):
        light = level * (1 + rise * number + flicker * rng.standard_normal(frames))
        light[0] -= share * (level - carried * before)
        adu = rng.normal(100 + light[:, None, None], np.sqrt(level), (frames, *shape))
        stacks.append(Stack("flat", 0.1 * (n + 1), number, 1.0 * number, adu, 100.0 + 10 * n))
        before = level
    maps = {"bias": np.full(shape, 100.0), "dark_rate": np.zeros(shape), "flat": np.ones(shape)}
    return Evidence(
        {},
        tuple(stacks),
        1.0,
        5.0,
        5.0,
        **maps,
        good=np.ones(shape, np.bool_),
        saturation_adu=65535,
        pitch_um=5.0,
        wavelength_nm=600.0,
        distance_mm=400.0,
    )


@pytest.mark.parametrize("carried", [0.0, 1.0])
@pytest.mark.parametrize(("frames", "rise"), [(2, 0.0), (4, 0.0), (4, 0.006)])
def test_flats_of_rising_levels_tell_whether_the_detector_was_cleared(
    frames: int, rise: float, carried: float
) -> None:
    found = lag_of_flats(first_flats_of(frames, 0.01, carried, rise))
    assert found is not None
    share, error, added = found
    assert added == carried
    assert abs(share - 0.01) < 4 * error < 0.005


def test_a_lamp_that_warms_up_in_each_level_is_not_taken_for_it() -> None:
    evidence = first_flats_of(4, 0.0, 0.0, 0.006)
    found = Lag.estimate(evidence)
    assert found is not None
    assert abs(found.significance) < 4
    rise, error = warming(evidence)
    assert abs(rise - 0.006) < 4 * error < 0.002


def test_first_flats_as_faint_after_any_frame_are_not_known_to_be_lag() -> None:
    """A shutter or lamp does the same; charge that the next frame gets, neither gives."""
    found = Lag.estimate(first_flats_of(2, 0.01, 0.0, 0.0))
    assert found is not None
    assert "three flats per level" in found.refused
    found = Lag.estimate(first_flats_of(4, 0.01, 0.0, 0.0))
    assert found is not None
    assert "three flats per level" not in found.refused
    assert "take darks at once after flats" in found.refused
    found = Lag.estimate(first_flats_of(4, 0.01, 1.0, 0.0))
    assert found is not None
    assert not found.refused
    found = Lag.estimate(first_flats_of(4, 0.0, 0.0, 0.0))
    assert found is not None
    assert not found.refused


def test_equal_steps_of_the_phase_tell_nothing(acquired: Callable[..., Evidence]) -> None:
    evidence = acquired()
    name, one = next(iter(evidence.fringes.items()))
    step = 0.7 * np.arange(len(one.free))
    free = one.free.copy()
    free[:, 1], free[:, 2] = 0.9 * np.cos(step), 0.9 * np.sin(step)
    assert Lag.estimate(replace(evidence, fringes={name: replace(one, free=free)})) is None


def test_a_bent_response_is_not_taken_for_it(acquired: Callable[..., Evidence]) -> None:
    evidence = acquired(None, {"nonlinearity": {}})
    for sets in (evidence.fringes, dict([*evidence.fringes.items()][:1])):
        found = Lag.estimate(replace(evidence, fringes=sets))
        assert found is not None
        assert found.significance < 4


@pytest.mark.long
def test_traps_that_fill_up_are_measured_without_their_law(
    acquired: Callable[..., Evidence],
) -> None:
    parts, later = (2.5, 1.8, 1.1, 0.4), (0.6, 0.2, 0.1, 0.06, 0.04)
    given = {
        "share": 0.01,
        "spread": 0.0,
        "bands": list(parts),
        "level_e": 45_000.0,
        "later": list(later),
    }
    found = Lag.estimate(acquired(None, {"lag": given}))
    assert found is not None
    lag = found.effect
    assert isinstance(lag, Lag)
    assert lag.releases[:5] == pytest.approx(later, abs=0.03)
    charge = np.array([3e3, 1e4, 2e4, 4e4], np.float32)
    truth = Lag(0.01, 0.0, 0.0, parts, 45_000.0, later)
    np.testing.assert_allclose(
        lag._left(charge, np.float32(lag.share)), truth._left(charge, np.float32(0.01)), rtol=0.05
    )
    even = Lag.estimate(acquired(None, {"lag": {"share": 0.01}}))
    assert even is not None
    assert isinstance(even.effect, Lag)
    assert even.effect.bands == even.effect.later == ()


def test_traps_take_no_more_than_they_have_room_for(
    make_effect_bench: Callable[..., Bench],
) -> None:
    """Under steady light full traps take what they gave back; after it all comes out."""
    lag = Lag(0.03, 1.5, 0.0, capacity_e=500.0)
    charge = np.zeros((40, 1, 1), np.float32)
    charge[:20] = 40_000
    lost, released = lag.lost(charge)
    assert lost[0, 0, 0] == pytest.approx(500)
    np.testing.assert_allclose(lost[1:20], 0, atol=1e-3)
    np.testing.assert_allclose(released[1:20], 500 * (1 - np.exp(-1 / 1.5)), rtol=1e-5)
    assert lost.sum() == pytest.approx(0, abs=0.1)
    # Faint light never fills them.
    faint = np.full((40, 1, 1), 1000, np.float32)
    unlimited = replace(lag, capacity_e=1e7)
    np.testing.assert_allclose(lag.lost(faint)[0], unlimited.lost(faint)[0], rtol=1e-5)


@pytest.mark.long
def test_traps_that_have_a_capacity_are_found(acquired: Callable[..., Evidence]) -> None:
    truth = Lag(0.01, 1.5, 0.0, capacity_e=250.0)
    given = {"share": 0.01, "decay_frames": 1.5, "spread": 0.0, "capacity_e": 250.0}
    found = Lag.estimate(acquired(None, {"lag": given}))
    assert found is not None
    lag = found.effect
    assert isinstance(lag, Lag)
    assert lag.bands == ()
    assert lag.quiet == 0
    for name in ("share", "decay_frames", "capacity_e"):
        assert abs(getattr(lag, name) - getattr(truth, name)) < 4 * found.errors[name], name
    assert found.errors["capacity_e"] < 0.02 * truth.capacity_e
    rng = np.random.default_rng(5)
    charge = rng.uniform(0, 45e3, (30, 200, 1)).astype(np.float32)
    wanted, got = truth.lost(charge)[0], lag.lost(charge)[0]
    assert np.sqrt(np.mean((got - wanted) ** 2)) < 0.05 * np.sqrt(np.mean(wanted**2))


@pytest.mark.long
def test_a_bent_response_makes_no_share_depend_on_the_level(
    acquired: Callable[..., Evidence],
) -> None:
    found = Lag.estimate(acquired(None, {"nonlinearity": {}, "lag": {"share": 0.05}}))
    assert found is not None
    assert isinstance(found.effect, Lag)
    assert found.effect.bands == ()
    assert not found.effect.capacity_e
