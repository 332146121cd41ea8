"""Photon transfer gives back the gain that Poisson light was made with, with an honest error."""

import numpy as np
import pytest
import scipy.ndimage
from numpy.typing import NDArray

from pixcal.kernels.gain_fit import LADDER, GainFit, fit_gain
from pixcal.kernels.photon_transfer import (
    BLOCK,
    LAGS,
    N_BINS,
    SHARED,
    add_neighbours,
    bin_pairs,
    pair_statistics,
)

F64 = NDArray[np.float64]
GAIN, READ_ADU, BIAS = 2.3, 5.0, 500.0


def frame(rng: np.random.Generator, electrons: F64) -> NDArray[np.float32]:
    """A frame in whole ADU, bias subtracted."""
    charge = rng.poisson(electrons) + rng.normal(0, READ_ADU * GAIN, electrons.shape)
    return (np.round(charge / GAIN + BIAS) - BIAS).astype(np.float32)


def pair(rng: np.random.Generator, electrons: F64) -> F64:
    first, second = frame(rng, electrons), frame(rng, electrons)
    return pair_statistics(first, second, gain=1.5, read_noise=3.0, quantum=1.0)


def measure(rng: np.random.Generator, scenes: list[F64]) -> GainFit:
    dof, _, square, *_ = bin_pairs(pair(rng, np.zeros_like(scenes[0]))).sum(axis=0)
    sums = sum(bin_pairs(pair(rng, scene)) for scene in scenes)
    variance = square / dof
    read = variance, variance * np.sqrt(2 / dof)
    fitted = fit_gain(np.asarray(sums), read, np.inf, straight=len(scenes) < LADDER)
    assert fitted is not None
    return fitted


def measure_shared(
    scenes: list[F64], share: F64, seed: int, rows: float = 0.0, *, neighbours: bool = True
) -> tuple[GainFit, dict[tuple[int, int], float]]:
    """Gain of flats whose charge is spread by the kernel `share`, with row noise in ADU."""
    rng = np.random.default_rng(seed)

    def one(electrons: F64) -> NDArray[np.float32]:
        spread = scipy.ndimage.convolve(rng.poisson(electrons).astype(float), share, mode="wrap")
        noise = rng.normal(0, READ_ADU, spread.shape) + rng.normal(0, rows, (len(spread), 1))
        return (np.round(spread / GAIN + noise + BIAS) - BIAS).astype(np.float32)

    def pairs(electrons: F64) -> F64:
        first, second = one(electrons), one(electrons)
        return bin_pairs(pair_statistics(first, second, gain=1.5, read_noise=3.0, quantum=1.0))

    dark = pairs(np.zeros_like(scenes[0]))
    variance = dark[:, 2].sum() / dark[:, 0].sum()
    lit = np.asarray(sum(pairs(scene) for scene in scenes))
    sums, lags, common = add_neighbours(lit, dark) if neighbours else (lit[:, :3], {}, 0.0)
    error = variance * np.sqrt(2 / dark[:, 0].sum())
    fitted = fit_gain(sums, (variance, error), np.inf, common=common)
    assert fitted is not None
    return fitted, lags


def flats(shape: tuple[int, int], levels: tuple[float, ...]) -> list[F64]:
    return [np.full(shape, level) for level in levels]


def test_the_gain_of_flats_is_right_to_half_a_percent() -> None:
    fitted = measure(np.random.default_rng(0), flats((701, 513), (2e3, 1e4, 4e4)))
    assert fitted.error < 0.002 * GAIN
    assert fitted.gain == pytest.approx(GAIN, abs=min(3 * fitted.error, 0.005 * GAIN))


@pytest.mark.parametrize(
    "share",
    [
        [[0, 0, 0], [0.01, 0.955, 0.025], [0, 0.01, 0]],
        [[0.001, 0.02, 0.001], [0.02, 0.916, 0.02], [0.001, 0.02, 0.001]],
        [[0, 0.03, 0], [0, 0, 0], [0, 0.94, 0], [0, 0, 0], [0, 0.03, 0]],
    ],
    ids=["asymmetric", "symmetric", "two rows away"],
)
def test_charge_that_neighbours_share_does_not_bias_the_gain(share: list[list[float]]) -> None:
    scenes = flats((701, 513), (2e3, 1e4, 4e4))
    fitted, added = measure_shared(scenes, np.array(share), 10)
    clear = {lag for lag, sigmas in added.items() if sigmas > SHARED}
    reach = np.abs(np.argwhere(np.array(share)) - np.array(np.shape(share)) // 2).sum(axis=1).max()
    assert clear
    assert all(abs(y) + abs(x) <= reach for y, x in clear)
    assert fitted.gain == pytest.approx(GAIN, abs=2.5 * fitted.error)
    assert fitted.error < 0.01 * GAIN
    biased = measure_shared(scenes, np.array(share), 10, neighbours=False)[0]
    assert biased.gain > 1.05 * GAIN


@pytest.mark.parametrize("coupling", [0.0, 0.01])
def test_points_scatter_about_the_curve_by_their_noise(coupling: float) -> None:
    """What is not known of the noise that neighbours share is common to all points."""
    share = coupling * np.array([[0, 1, 0], [1, -4, 1], [0, 1, 0]]) + np.pad([[1]], 1)
    uneven = np.broadcast_to(np.linspace(5e3, 4e4, 813), (701, 813))
    fitted, _ = measure_shared([uneven, uneven], share, 12)
    assert 0.5 < fitted.chi2_reduced < 1.6


def deflected(rng: np.random.Generator, level: float, push: F64, shape: tuple[int, int]) -> F64:
    """Charge (y, x) that arrives in steps, and in each by what is there moves the borders."""
    charge, steps = np.zeros(shape), 12
    for _ in range(steps):
        area = 1 + scipy.ndimage.convolve(charge, push, mode="wrap")
        light = level / steps * area
        charge += light + np.sqrt(light) * rng.standard_normal(shape)
    return charge


FALLING = np.hypot(*np.mgrid[-2:3, -2:3])
PUSH = np.where(FALLING > 0, 1 / np.maximum(FALLING, 1) ** 3, 0.0)
PUSH[2, 2] = -PUSH.sum()


@pytest.mark.long
@pytest.mark.parametrize(
    ("push", "coupling", "worst"),
    [(0.0, 0.0, 0.005), (1e-7, 0.0, 0.015), (3e-7, 0.0, 0.015), (0.0, 0.01, 0.01)],
)
def test_noise_shared_below_notice_is_in_the_gain_or_in_its_error(
    push: float, coupling: float, worst: float
) -> None:
    share = coupling * np.array([[0, 1, 0], [1, -4, 1], [0, 1, 0]]) + np.pad([[1]], 1)
    rng, off, pulls = np.random.default_rng([18, round(1e8 * push)]), [], []

    def one(level: float) -> NDArray[np.float32]:
        charge = deflected(rng, level, push * PUSH, (384, 384))
        charge = scipy.ndimage.convolve(charge, share, mode="wrap")
        return np.asarray(charge / GAIN + READ_ADU * rng.standard_normal(charge.shape), np.float32)

    def pairs(level: float) -> F64:
        first, second = one(level), one(level)
        return bin_pairs(pair_statistics(first, second, gain=1.5, read_noise=3.0, quantum=1.0))

    for _ in range(12):
        sums, _, common = add_neighbours(pairs(3e4) + pairs(3e4), pairs(0.0))
        fitted = fit_gain(sums, (READ_ADU**2, 0.1), np.inf, common=common)
        assert fitted is not None
        off.append(fitted.gain / GAIN - 1)
        pulls.append((fitted.gain - GAIN) / fitted.error)
    assert np.median(np.abs(off)) < worst
    assert np.count_nonzero(np.abs(pulls) < 2) > 0.7 * len(pulls)


def test_a_lamp_that_flickers_by_rows_is_no_charge_that_neighbours_share() -> None:
    """Bands of light move from frame to frame; what pixels share of it does not fall off."""
    rng = np.random.default_rng(16)

    def one(electrons: float) -> NDArray[np.float32]:
        phase = np.arange(512)[:, None] / 90 + rng.random()
        return frame(rng, electrons * (1 + 0.01 * np.sin(2 * np.pi * phase)) * np.ones((1, 400)))

    def pairs(electrons: float) -> F64:
        return bin_pairs(
            pair_statistics(one(electrons), one(electrons), gain=1.5, read_noise=3.0, quantum=1.0)
        )

    lit = np.asarray(sum(pairs(level) for level in (1e4, 2e4, 4e4)))
    sums, lags, _ = add_neighbours(lit, pairs(0.0))
    assert list(lags) == [(0, 0)]
    assert (sums == lit[:, :3]).all()


@pytest.mark.parametrize("rows", [0.0, 3.0])
def test_noise_that_neighbours_share_without_light_is_not_counted(rows: float) -> None:
    scenes = flats((701, 513), (2e3, 1e4, 4e4))
    fitted, added = measure_shared(scenes, np.ones((1, 1)), 11, rows)
    assert not added
    assert fitted.gain == pytest.approx(GAIN, abs=3 * fitted.error)


def test_covariances_of_neighbours_are_those_of_the_noise() -> None:
    rng = np.random.default_rng(12)
    white = rng.standard_normal((2, 640, 517))
    noise = white + 0.3 * np.roll(white, 1, axis=2) + 0.2 * np.roll(white, (2, 1), axis=(1, 2))
    blocks = pair_statistics(
        noise[0].astype(np.float32),
        noise[1].astype(np.float32),
        gain=1.0,
        read_noise=1.0,
        quantum=0.0,
    )
    dof = blocks[:, 0]
    found = dict(zip(map(tuple, LAGS.tolist()), dof @ blocks[:, 3:] / dof.sum(), strict=True))
    expected = {(0, 1): 0.3, (2, 1): 0.2, (2, 0): 0.06}
    for lag, value in found.items():
        assert value == pytest.approx(expected.get(lag, 0.0), abs=0.01), lag


def test_structured_light_does_not_bias_the_gain() -> None:
    y, x = np.mgrid[:640, :640]
    scene = 12_000 * (1 + 0.95 * np.sin(2 * np.pi * (x + 0.3 * y) / 9.6))
    fitted = measure(np.random.default_rng(1), [scene])
    assert fitted.error < 0.005 * GAIN
    assert fitted.gain == pytest.approx(GAIN, abs=3 * fitted.error)


def test_a_dark_edge_within_blocks_does_not_bias_the_gain() -> None:
    scene = np.full((512, 512), 2e4)
    scene.reshape(512, -1, BLOCK)[..., :10] = 0
    fitted = measure(np.random.default_rng(2), [scene])
    assert fitted.gain == pytest.approx(GAIN, abs=3 * fitted.error)


def test_outliers_do_not_bias_the_gain() -> None:
    rng = np.random.default_rng(3)
    electrons = np.full((512, 512), 1e4)
    first, second = frame(rng, electrons), frame(rng, electrons)
    first.reshape(-1)[rng.choice(first.size, 1000)] += 3000
    second.reshape(-1)[rng.choice(first.size, 1000)] = 0
    first[100], second[:, 50] = np.nan, np.nan
    sums = bin_pairs(pair_statistics(first, second, gain=1.5, read_noise=3.0, quantum=1.0))
    fitted = fit_gain(sums, (READ_ADU**2, 0.1), np.inf)
    assert fitted is not None
    assert fitted.gain == pytest.approx(GAIN, abs=3 * fitted.error)


def test_the_error_of_the_gain_is_honest() -> None:
    rng = np.random.default_rng(4)
    pulls = []
    for _ in range(60):
        fitted = measure(rng, flats((64, 96), (500, 5e3, 3e4)))
        pulls.append((fitted.gain - GAIN) / fitted.error)
    assert abs(np.mean(pulls)) < 4 / np.sqrt(60)
    assert 0.7 < np.std(pulls) < 1.3


def test_levels_above_the_highest_are_not_used() -> None:
    rng = np.random.default_rng(5)
    low, high = (bin_pairs(pair(rng, np.full((256, 256), n))) for n in (1e4, 8e4))
    high[:, 2] *= 0.3  # saturation takes the noise away
    fitted = fit_gain(low + high, (READ_ADU**2, 0.1), 2e4 / GAIN)
    assert fitted is not None
    assert fitted.gain == pytest.approx(GAIN, abs=3 * fitted.error)
    assert fitted.levels[1] < 2e4 / GAIN


@pytest.mark.parametrize("dark", [0.1, 0.94, 1.0, 1.06, 3.0])
def test_dark_frames_of_another_noise_do_not_bias_the_gain(dark: float) -> None:
    """As of a camera that clips black; the noise at level zero is then that of the flats."""
    rng = np.random.default_rng(6)
    sums = sum(bin_pairs(pair(rng, np.full((320, 320), n))) for n in np.linspace(100, 2e4, 9))
    zero = READ_ADU**2 + 1 / 12
    fitted = fit_gain(np.asarray(sums), (dark * zero, 0.03), np.inf)
    assert fitted is not None
    assert fitted.without_dark == (dark != 1.0)
    assert fitted.gain == pytest.approx(GAIN, abs=3 * fitted.error)
    assert fitted.error < 0.01 * GAIN
    value, error = fitted.read_variance
    assert value == pytest.approx(zero, abs=4 * error)
    # Where more frames told it, it is not asked again.
    for known in (False, True):
        again = fit_gain(np.asarray(sums), (dark * zero, 0.03), np.inf, without_dark=known)
        assert again is not None
        assert again.without_dark == known
        assert not known or again.gain == pytest.approx(GAIN, abs=3 * again.error)


def test_two_amplifiers_leave_the_gain_as_the_flats_tell_it() -> None:
    """Dark pixels are read with another amplifier, all flats with a noisier one.

    A curve that is tied to the noise without light would fit the flats too, with a wrong gain.
    """
    rng = np.random.default_rng(20)
    electrons, dof, noisier = np.geomspace(1.2e3, 2.2e4, 24), 1e5, (0.4 * READ_ADU) ** 2 * 100
    variance = electrons / GAIN**2 + noisier
    pulls = []
    for _ in range(40):
        seen = variance * rng.chisquare(dof, len(variance)) / dof
        sums = dof * np.stack([np.ones_like(seen), electrons / GAIN, seen], axis=1)
        fitted = fit_gain(sums, (READ_ADU**2, 0.02), np.inf)
        assert fitted is not None
        assert fitted.without_dark
        assert not fitted.curved
        pulls.append((fitted.gain - GAIN) / fitted.error)
        assert fitted.error < 0.01 * GAIN
    assert abs(np.mean(pulls)) < 4 / np.sqrt(40)
    # Smaller than one, as the curve might bend.
    assert np.std(pulls) < 1.3


def test_points_off_the_line_widen_the_error() -> None:
    rng = np.random.default_rng(6)
    low, high = (bin_pairs(pair(rng, np.full((256, 256), n))) for n in (1e4, 4e4))
    straight = fit_gain(low + high, (READ_ADU**2, 0.1), np.inf)
    high[:, 2] *= 1.2
    bent = fit_gain(low + high, (READ_ADU**2, 0.1), np.inf)
    assert straight is not None
    assert bent is not None
    assert bent.chi2_reduced > 10 > straight.chi2_reduced
    assert bent.error > 3 * straight.error


@pytest.mark.parametrize("power", [1, 2, 3])
@pytest.mark.parametrize("size", [0.01, 0.04, 0.12])
def test_a_response_that_bends_leaves_the_gain_at_level_zero(size: float, power: int) -> None:
    rng = np.random.default_rng(9)
    electrons = np.linspace(1e3, 4e4, 10)
    share = size * (electrons / 4e4) ** power
    bent, slope = electrons * (1 - share) / GAIN, 1 - (power + 1) * share
    variance = electrons * slope**2 / GAIN**2 + READ_ADU**2
    dof = np.full(10, 65_000.0)
    gains, curved, pulls = [], [], []
    for _ in range(20):
        seen = variance * (1 + rng.standard_normal(10) * np.sqrt(2 / dof))
        fitted = fit_gain(np.stack([dof, dof * bent, dof * seen], 1), (READ_ADU**2, 0.02), np.inf)
        assert fitted is not None
        assert fitted.gain == pytest.approx(GAIN, abs=5 * fitted.error)
        curved.append(fitted.curved)
        gains.append(fitted.gain)
        pulls.append((fitted.gain - GAIN) / fitted.error)
    assert np.mean(curved) < -size
    assert np.mean(gains) == pytest.approx(GAIN, rel=0.005)
    assert np.sqrt(np.mean(np.square(pulls))) < 1.5


def test_bright_flats_alone_bend_as_well_between_them_and_the_dark() -> None:
    """The noise without light is on their curve, although levels differ by less than twofold."""
    rng = np.random.default_rng(19)
    electrons = np.linspace(2.2e4, 4e4, 6)
    share = 0.12 * electrons / 4e4
    bent, slope = electrons * (1 - share) / GAIN, 1 - 2 * share
    variance = electrons * slope**2 / GAIN**2 + READ_ADU**2
    dof = np.full(6, 65_000.0)
    for _ in range(10):
        seen = variance * (1 + rng.standard_normal(6) * np.sqrt(2 / dof))
        fitted = fit_gain(np.stack([dof, dof * bent, dof * seen], 1), (READ_ADU**2, 0.02), np.inf)
        assert fitted is not None
        assert not fitted.without_dark
        assert fitted.gain == pytest.approx(GAIN, abs=3.5 * fitted.error)


@pytest.mark.parametrize("count", [5, 6])
def test_few_levels_do_not_take_a_bend_for_another_gain(count: int) -> None:
    rng = np.random.default_rng(21)
    electrons = np.linspace(2e3, 4e4, count)
    bent, slope = electrons * (1 - 1.5e-6 * electrons) / GAIN, 1 - 3e-6 * electrons
    variance = electrons * slope**2 / GAIN**2 + READ_ADU**2
    dof, pulls = np.full(count, 70_000.0), []
    for _ in range(20):
        seen = variance * (1 + rng.standard_normal(count) * np.sqrt(2 / dof))
        fitted = fit_gain(np.stack([dof, dof * bent, dof * seen], 1), (READ_ADU**2, 0.02), np.inf)
        assert fitted is not None
        assert fitted.error < 0.03 * GAIN
        pulls.append((fitted.gain - GAIN) / fitted.error)
    assert np.abs(pulls).max() < 4
    assert np.sqrt(np.mean(np.square(pulls))) < 1.6


def test_a_bias_that_wanders_does_not_bias_the_gain() -> None:
    rng = np.random.default_rng(14)
    level, dof = np.linspace(100, 8000, 10), np.full(10, 65_000.0)
    off = {0.0: [], 3.0: []}  # type: dict[float, list[float]]
    for _ in range(20):
        seen = (level / GAIN + READ_ADU**2) * (1 + rng.standard_normal(10) * np.sqrt(2 / dof))
        sums = np.stack([dof, dof * (level + 4.0), dof * seen], 1)
        for error, gains in off.items():
            fitted = fit_gain(sums, (READ_ADU**2, 0.02), np.inf, level_error=error)
            assert fitted is not None
            gains.append(fitted.gain / GAIN - 1)
    assert np.mean(off[0.0]) > 0.005
    assert np.sqrt(np.mean(np.square(off[3.0]))) < 0.004


def test_levels_tell_the_noise_without_light() -> None:
    """Where it is hardly known, the curve that meets level zero there does, within its error."""
    rng = np.random.default_rng(15)
    level, dof = np.linspace(5, 200, 12), np.full(12, 65_000.0)
    pulls = []
    for _ in range(30):
        seen = (level / GAIN + READ_ADU**2) * (1 + rng.standard_normal(12) * np.sqrt(2 / dof))
        sums = np.stack([dof, dof * level, dof * seen], 1)
        fitted = fit_gain(sums, (0.7 * READ_ADU**2, READ_ADU**2), np.inf)
        assert fitted is not None
        value, error = fitted.read_variance
        assert error < 0.1 * READ_ADU**2
        pulls.append((value - READ_ADU**2) / error)
    assert np.sqrt(np.mean(np.square(pulls))) < 1.5


def test_without_light_there_is_no_gain() -> None:
    rng = np.random.default_rng(7)
    assert fit_gain(np.zeros((N_BINS, 3)), (25.0, 0.1), np.inf) is None
    dark = bin_pairs(pair(rng, np.zeros((64, 64))))
    fitted = fit_gain(dark, (READ_ADU**2 + 1 / 12, 0.1), np.inf)
    assert fitted is None or fitted.error > 0.2 * fitted.gain


def test_bins_hold_all_blocks_and_may_be_added() -> None:
    rng = np.random.default_rng(8)
    a, b = (pair(rng, np.full((50, 37), n)) for n in (0.0, 3e4))
    both = bin_pairs(np.concatenate([a, b]))
    np.testing.assert_allclose(both, bin_pairs(a) + bin_pairs(b))
    assert both[:, 0].sum() == a[:, 0].sum() + b[:, 0].sum()
    assert both[:, 1].sum() == pytest.approx((a[:, 0] * a[:, 1]).sum() + (b[:, 0] * b[:, 1]).sum())


def test_partial_blocks_are_blocks_if_they_are_large_enough() -> None:
    blocks = pair(np.random.default_rng(9), np.full((17, 35), 1e4))
    # 16 and 1 rows, 16, 16 and 3 columns; all pixels but one are degrees of freedom.
    np.testing.assert_array_equal(blocks[:, 0], [255, 255, 47, 0, 0, 0])


@pytest.mark.parametrize("spread", [0.1, 0.3])
def test_pixels_of_unequal_noise_are_no_outliers(spread: float) -> None:
    """As in scientific CMOS cameras; hits by particles are."""
    rng = np.random.default_rng(12)
    noise = 5 * rng.lognormal(0, spread, (640, 640))
    first, second = (noise * rng.standard_normal(noise.shape) for _ in range(2))
    first[::40, ::40] += 500
    blocks = pair_statistics(first, second, gain=1.0, read_noise=5.0, quantum=1.0)
    variance = np.average(blocks[:, 2], weights=blocks[:, 0])
    assert variance == pytest.approx(np.mean(noise**2), rel=0.01)


@pytest.mark.quick(1)
@pytest.mark.parametrize("above", [500.0, 700.0, 3e3, 1e4])  # from one level below it on
@pytest.mark.parametrize("levels", [11, 16])
def test_a_second_amplifier_for_bright_pixels_leaves_the_gain(above: float, levels: int) -> None:
    rng, pixels = np.random.default_rng(levels), 2e5
    level = np.geomspace(400, 4e4, levels)
    pulls = []
    for _ in range(20):
        variance = READ_ADU**2 + level / GAIN + np.where(level > above, 30.0**2, 0.0)
        variance = variance * rng.chisquare(pixels, levels) / pixels
        sums = np.zeros((N_BINS, 3))
        sums[:levels] = pixels * np.stack([np.ones(levels), level, variance], axis=1)
        fitted = fit_gain(sums, (READ_ADU**2, 0.1), np.inf)
        assert fitted is not None
        assert fitted.step
        assert fitted.levels[1] < above
        assert fitted.error < 0.01 * GAIN
        pulls.append((fitted.gain - GAIN) / fitted.error)
    assert np.std(pulls) < 1.3
    assert abs(np.mean(pulls)) < 4 / np.sqrt(len(pulls))


@pytest.mark.parametrize("seed", [21, 22, 23])
def test_amplifiers_of_different_gain_are_in_the_error_of_the_gain(seed: int) -> None:
    """Their points lie on two curves; the gain is that between them."""
    rng = np.random.default_rng(seed)
    apart = np.repeat([0.97, 1.03], 256).astype(np.float32)
    sums = np.zeros((N_BINS, 3))
    for level in np.linspace(500, 40_000, 9):
        first, second = (apart * frame(rng, np.full((512, 512), level)) for _ in range(2))
        blocks = pair_statistics(first, second, gain=1.5, read_noise=3.0, quantum=1.0)
        sums += bin_pairs(blocks)[:, :3]
    variance = READ_ADU**2 + 1 / 12
    fitted = fit_gain(sums, (variance, 0.01 * variance), np.inf)
    assert fitted is not None
    assert fitted.chi2_reduced > 10
    assert fitted.gain == pytest.approx(GAIN, abs=3 * fitted.error)
    assert fitted.error < 0.02 * GAIN


def test_flats_alone_tell_the_gain_below_a_step() -> None:
    """Where the darks are known to be off the curve, they are so for every range of levels."""
    rng = np.random.default_rng(6)
    low = sum(bin_pairs(pair(rng, np.full((320, 320), n))) for n in np.linspace(100, 6e3, 9))
    high = sum(bin_pairs(pair(rng, np.full((320, 320), n))) for n in np.linspace(7e3, 2e4, 9))
    sums = np.asarray(low + high * np.array([1.0, 1.0, 1.4] + [1.0] * (high.shape[1] - 3)))
    dark = 1.3 * (READ_ADU**2 + 1 / 12), 0.01
    fitted = fit_gain(sums, dark, np.inf, without_dark=True)
    assert fitted is not None
    assert fitted.step
    assert fitted.without_dark
    assert fitted.gain == pytest.approx(GAIN, abs=3 * fitted.error)
    assert fitted.error < 0.03 * GAIN
