"""Row noise: rows and columns have what is given in common, and it is told from all else."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from all_frames import frames_of
from dark_frames import in_the_dark
from numpy.typing import NDArray

from pixcal.effects.bias_drift import BiasDrift
from pixcal.effects.row_noise import LineSpectrum, RowNoise, group_power, line_spectrum
from pixcal.effects.telegraph_noise import TelegraphNoise
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.processes import flicker, flicker_power
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Effect
from pixcal.simulation.recording import recordings

NAMES = RowNoise.strengths


@pytest.mark.parametrize("count", [61, 64])
def test_flicker_has_the_power_that_is_foreseen(count: int) -> None:
    rng = np.random.default_rng(3)
    lines = np.array([flicker(rng, count) for _ in range(4000)])
    np.testing.assert_allclose(lines.mean(axis=1), 0, atol=1e-12)
    seen = np.abs(np.fft.rfft(lines, norm="ortho")) ** 2
    ratio = seen.mean(axis=0)[1:] / flicker_power(count)[1:]
    np.testing.assert_allclose(ratio, 1, atol=5 * np.sqrt(2 / 4000))


def test_every_octave_of_flicker_has_the_same_variance() -> None:
    count = 4096
    power = flicker_power(count)
    octaves = [2 * power[m : 2 * m].sum() / count for m in (16, 64, 256)]
    np.testing.assert_allclose(octaves, 1, rtol=0.05)


def test_rows_and_columns_move_as_a_whole(make_effect_bench: Callable[..., Bench]) -> None:
    bench = make_effect_bench()
    bias = next(r for r in recordings(bench) if r.kind == "bias")
    effect = RowNoise(6.0, 0.0, 4.0, 3.0)
    change = frames_of(bench, bias, [effect]).astype(float) - frames_of(bench, bias)
    rows, columns = change.mean(axis=2), change.mean(axis=1)
    plane = rows[:, :, None] + columns[:, None] - change.mean(axis=(1, 2))[:, None, None]
    # What is left is rounding, twice.
    assert (change - plane).std() == pytest.approx(np.sqrt(1 / 6), rel=0.1)
    assert columns.std() == pytest.approx(3.0, rel=0.05)
    steps = np.diff(rows, axis=1)
    even, odd = steps[:, ::2].mean(axis=1), steps[:, 1::2].mean(axis=1)
    apart = (odd - even) / 4
    assert apart.std() == pytest.approx(np.hypot(4.0, 6.0 / np.sqrt(61)), rel=4 / np.sqrt(120))


@pytest.mark.parametrize(
    ("given", "errors"),
    [
        ((1.6, 0.5, 0.5, 0.8, 0.0), (0.2, 0.06, 0.1, 0.1, 0.4)),
        ((0.6, 0.0, 0.0, 0.6, 0.0), (0.3, 0.2, 0.2, 0.2, 0.5)),
        ((0.0, 1.0, 1.0, 0.0, 0.0), (0.5, 0.06, 0.15, 0.4, 0.6)),
        ((8.0, 3.0, 5.0, 4.0, 0.0), (0.6, 0.3, 0.8, 0.2, 2.0)),
        ((0.0, 0.0, 0.0, 0.0, 3.0), (0.5, 0.25, 0.2, 0.4, 0.2)),
    ],
)
def test_sizes_are_found(
    acquired: Callable[..., Evidence],
    make_effect_bench: Callable[..., Bench],
    given: tuple[float, ...],
    errors: tuple[float, ...],
) -> None:
    found = RowNoise.estimate(in_the_dark(acquired(), make_effect_bench(), RowNoise(*given)))
    assert found is not None
    assert found.significance > 5
    # Groups of rows are only there where they are needed.
    assert isinstance(found.effect, RowNoise)
    assert found.effect.group_rms == 0
    for name, value, error in zip(NAMES[:5], given, errors, strict=True):
        assert found.errors[name] < error, name
        # Of variances the errors are alike on both sides; of their roots the longer side is given.
        size, longer = getattr(found.effect, name), found.errors[name]
        error = longer * (2 * size - longer if longer < size else 2 * size + longer)
        assert abs(size**2 - value**2) < 4 * error, name


@pytest.mark.parametrize(
    "other",
    [BiasDrift(20.0, 100.0, 50.0, 30.0, 5.0), TelegraphNoise().scaled(3.0)],
    ids=lambda e: e.name,
)
def test_other_noise_is_not_taken_for_it(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench], other: Effect
) -> None:
    found = RowNoise.estimate(in_the_dark(acquired(), make_effect_bench(), other))
    assert found is not None
    assert found.significance < 4


@pytest.mark.parametrize("odd", [0.0, 2.0])
def test_levels_of_even_and_odd_columns_are_found(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench], odd: float
) -> None:
    effect = RowNoise(1.6, 0.0, 0.0, 0.8, odd_column_rms=odd)
    found = RowNoise.estimate(in_the_dark(acquired(), make_effect_bench(), effect))
    assert found is not None
    assert isinstance(found.effect, RowNoise)
    for name, value in (("column_rms", 0.8), ("odd_column_rms", odd)):
        assert abs(getattr(found.effect, name) - value) < 4 * found.errors[name] < 1.2, name


def test_crosstalk_is_not_taken_for_it(acquired: Callable[..., Evidence]) -> None:
    # Of noise before the pixels are coupled; here a share of the left neighbour's read noise.
    evidence = acquired()
    stacks = tuple(
        replace(s, adu=s.adu + np.float32(0.2) * np.roll(s.adu, 1, axis=2))
        for s in evidence.stacks
        if s.kind == "bias"
    )
    found = RowNoise.estimate(replace(evidence, stacks=stacks))
    assert found is not None
    assert found.significance < 4


def test_significance_is_that_of_chance() -> None:
    rng = np.random.default_rng(8)
    good = rng.random((41, 50)) > 0.02
    pulls = []
    for _ in range(60):
        noise = rng.standard_normal((30, 41, 50)).astype(np.float32)
        spectrum = line_spectrum(noise - noise.mean(axis=0), good)
        assert spectrum is not None
        pulls += list(spectrum.power / np.sqrt(spectrum.variance(np.zeros(len(spectrum.power)))))
    assert np.mean(pulls) == pytest.approx(0, abs=4 / np.sqrt(len(pulls)))
    assert np.std(pulls) == pytest.approx(1, abs=0.1)


def test_without_frames_in_the_dark_fringes_tell(acquired: Callable[..., Evidence]) -> None:
    def with_rows(rms: float) -> Evidence:
        rng = np.random.default_rng(6)
        fringes = {}
        for name, f in acquired().fringes.items():
            rows: NDArray[np.float32] = rng.standard_normal((len(f.g), f.good.shape[0], 1)).astype(
                np.float32
            )
            fringes[name] = replace(f, electrons=f.electrons + np.float32(rms) * rows)
        return replace(acquired(), stacks=(), fringes=fringes)

    found = RowNoise.estimate(with_rows(20.0))
    assert found is not None
    assert isinstance(found.effect, RowNoise)
    assert found.effect.row_rms == pytest.approx(20.0, abs=4 * found.errors["row_rms"])
    assert found.errors["row_rms"] < 2.0
    assert found.significance > 5
    nothing = RowNoise.estimate(with_rows(0.0))
    assert nothing is not None
    assert nothing.significance < 4


def test_without_frames_nothing_is_said(acquired: Callable[..., Evidence]) -> None:
    assert RowNoise.estimate(replace(acquired(), stacks=(), fringes={})) is None


def test_every_second_row_shares_half() -> None:
    rng = np.random.default_rng(4)
    effect = RowNoise(0.0, 0.0, 0.0, 0.0, 3.0)
    rows = np.array([effect.offsets((64, 3), rng)[0] for _ in range(4000)])
    product = [float((rows[:, n:] * rows[:, : 64 - n]).mean()) / 9 for n in range(5)]
    np.testing.assert_allclose(product, [1, 0, 0.5, 0, 0], atol=0.02)


@pytest.mark.parametrize("rows", [2, 4])
def test_rows_read_together_share_an_offset_and_are_found(
    rows: int, acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench]
) -> None:
    given = RowNoise(2.0, 0.0, 0.0, 0.0, 0.0, 4.0, rows)
    alone = replace(given, row_rms=0.0).offsets((61, 3), np.random.default_rng(4))[0]
    assert len(np.unique(alone)) == -(-61 // rows)
    np.testing.assert_array_equal(alone, np.repeat(alone[::rows], rows)[:61])
    found = RowNoise.estimate(in_the_dark(acquired(), make_effect_bench(), given))
    assert found is not None
    assert isinstance(found.effect, RowNoise)
    assert found.effect.group_rows == rows
    for name in ("row_rms", "group_rms"):
        size, error = getattr(found.effect, name), found.errors[name]
        assert error < 1.0
        assert size == pytest.approx(getattr(given, name), abs=4 * error), name


def test_groups_of_rows_have_the_power_that_is_foreseen() -> None:
    rng = np.random.default_rng(5)
    effect = RowNoise(0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 4)
    rows = np.array([effect.offsets((64, 3), rng)[0] for _ in range(4000)])
    power = (np.abs(np.fft.rfft(rows, norm="ortho")) ** 2).mean(axis=0)[1:]
    spectrum = LineSpectrum(64, power, np.ones(32), 0.0, 0.0)
    np.testing.assert_allclose(power, group_power(spectrum, 4), rtol=0.12, atol=1e-9)


@pytest.mark.parametrize("frames", [2, 3, 7])
def test_few_frames_of_many_rows_suffice(frames: int, acquired: Callable[..., Evidence]) -> None:
    """Each row of each frame is a sample of its noise."""
    evidence, rng = acquired(), np.random.default_rng(frames)
    good = np.ones((160, 200), bool)
    for rows in (0.0, 0.2):
        adu = rng.standard_normal((frames, *good.shape))
        adu += rows * rng.standard_normal((frames, len(good), 1))
        stack = replace(evidence.of_kind("bias")[0], adu=adu.astype(np.float32))
        found = RowNoise.estimate(replace(evidence, stacks=(stack,), good=good, gain=1.0))
        assert found is not None
        assert (found.significance > 10) == (rows > 0)
        size, error = found.effect.row_rms, found.errors["row_rms"]
        assert size**2 == pytest.approx(rows**2, abs=4 * error * (2 * size + error))
        assert rows == 0 or error < 0.15 * rows


def test_rows_that_move_alone_are_found(acquired: Callable[..., Evidence]) -> None:
    """Nothing else varies, so that the noise of single pixels is nothing beside that of rows."""
    evidence, rng = acquired(), np.random.default_rng(8)
    good = np.ones((64, 100), bool)
    adu = np.repeat(rng.normal(0, 5.0, (4, 64, 1)), 100, axis=2).astype(np.float32)
    stack = replace(evidence.of_kind("bias")[0], adu=adu)
    found = RowNoise.estimate(replace(evidence, stacks=(stack,), good=good, gain=1.0))
    assert found is not None
    assert found.significance > 10
    assert found.effect.row_rms == pytest.approx(5.0, rel=0.3)
    still = replace(stack, adu=0 * adu)
    assert RowNoise.estimate(replace(evidence, stacks=(still,), good=good)) is None
