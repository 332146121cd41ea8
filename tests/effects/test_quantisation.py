"""The converter: codes as published packages make them; steps and widths are found again."""

from collections.abc import Callable

import galsim
import numpy as np
import pytest
from numpy.typing import NDArray

from pixcal.effects.quantisation import Quantisation, _uneven
from pixcal.estimators.detector.bit_weights import FITS, NEAREST, NEAREST_OF_ALL, Law, level_errors
from pixcal.estimators.detector.code_density import CodeWidths, code_widths
from pixcal.estimators.detector.code_histogram import histogram, step_of
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.significance import sigmas_of_chi2

TOP = 65535.0


def ramp(first: float, last: float, per_code: int = 400) -> NDArray[np.float32]:
    return np.arange(first, last, 1 / per_code, dtype=np.float32)


@pytest.mark.parametrize("step", [4.0, 1.5, 64.0])
def test_even_codes_are_those_of_galsim(step: float) -> None:
    adu = np.random.default_rng(2).uniform(0, 60000, (50, 70)).astype(np.float32)
    image = galsim.Image(adu.copy() / np.float32(step))
    image.quantize()
    ours = Quantisation(step - 1, 0.0, 0.0).converted(adu, 0, TOP)
    # Halves go up here, to even numbers there.
    clear = np.abs(adu / step % 1 - 0.5) > 1e-3
    assert clear.mean() > 0.99
    np.testing.assert_allclose(ours[clear], image.array[clear] * step, atol=1e-2)


def test_codes_are_as_wide_as_their_thresholds_are_apart() -> None:
    effect = Quantisation(0.0, 0.2, 0.1, 5.0, 0.7)
    codes = effect.converted(ramp(100, 200), 9, TOP).astype(int)
    counts = np.bincount(codes)[110:190] / 400
    begins = effect.thresholds(9, 300)
    np.testing.assert_allclose(counts, np.diff(begins)[110:190], atol=0.01)
    even = Quantisation(0.0, 0.0, 0.2, 8.0, 0.3).thresholds(0, 100)
    number = np.arange(99)
    np.testing.assert_allclose(np.diff(even), 1 + 0.2 * np.cos(2 * np.pi * number / 8 + 0.3))


def test_widths_scatter_as_given_and_leave_the_response_straight() -> None:
    begins = Quantisation(0.0, 0.3, 0.0).thresholds(4, 60000)
    assert np.diff(begins).std() == pytest.approx(0.3, rel=0.02)
    assert np.abs(begins - np.arange(60000) + 0.5).max() < 1


def test_a_threshold_beyond_the_next_leaves_a_code_out() -> None:
    effect = Quantisation(0.0, 1.0, 0.0)
    begins = effect.thresholds(1, 2000)
    codes = np.unique(effect.converted(ramp(100, 1900, 100), 1, TOP).astype(int))
    assert np.all(np.diff(begins)[codes[1:-1]] > -2)
    # As many codes as thresholds are passed, whatever their order.
    for sample in (500.3, 777.7, 1000.0):
        code = effect.converted(np.array([[sample]], np.float32), 1, TOP)[0, 0]
        assert code == np.count_nonzero(begins[1:] <= np.float32(sample))
    missing = np.diff(begins)[codes[0] : codes[-1]] < 0
    assert missing.sum() > 50
    assert len(codes) < codes[-1] - codes[0]


def test_rounding_adds_a_twelfth_of_the_steps_square() -> None:
    rng = np.random.default_rng(5)
    adu = (20000 + 30 * rng.standard_normal((300, 400))).astype(np.float32)
    error = Quantisation(15.0, 0.0, 0.0).converted(adu, 0, TOP) - adu
    assert error.std() == pytest.approx(16 / np.sqrt(12), rel=0.01)
    assert error.mean() == pytest.approx(0, abs=4 * 16 / np.sqrt(12 * adu.size))


def test_ever_weaker_it_becomes_plain_rounding() -> None:
    adu = np.random.default_rng(6).uniform(0, 500, (100, 100)).astype(np.float32)
    plain = np.floor(adu + np.float32(0.5))
    away = []
    for factor in (1.0, 0.1, 1e-2, 1e-6):
        codes = Quantisation().scaled(factor).converted(adu, 3, TOP)
        written = np.floor(codes + np.float32(0.5))
        away.append(float(np.mean(np.abs(written - plain))))
    assert away[0] > away[1] > away[2] > away[3]
    assert away[3] < 5e-3


@pytest.mark.parametrize("step", [2.0, 1.5, 3.1, 16.0])
def test_steps_are_found_from_gaps(step: float) -> None:
    rng = np.random.default_rng(8)
    adu = rng.normal(6000, 900, (100, 50, 60)).astype(np.float32)
    codes = Quantisation(step - 1, 0.1, 0.0).converted(adu, 2, TOP)
    counts = histogram([np.floor(codes + 0.5).astype(np.uint16)], np.ones((50, 60), bool))
    assert counts is not None
    found, error = step_of(counts)
    assert abs(found - step) < 2 * error < 2e-3 * step


def test_codes_that_are_uneven_for_bright_samples_alone_are_those_of_another_gain() -> None:
    rng, good = np.random.default_rng(2), np.ones(1_500_000, bool)
    faint, bright = (rng.normal(m, s, good.size).astype(int) for m, s in ((900, 90), (3000, 300)))
    missing, low = rng.random(12_000) < 0.25, rng.random(good.size) < 0.3
    dual = np.where(low, bright, bright // 4 * 4)  # pixels differ in offset
    for codes, expected in (
        ((faint, bright), False),
        ((faint, dual), True),
        ((faint + missing[faint], bright + missing[bright]), False),
    ):
        counts = histogram([np.stack(codes).astype(np.uint16)], good)
        assert counts is not None
        widths = code_widths(counts, 10.0)
        assert widths is not None
        assert widths.uneven_above == expected


def test_codes_beside_saturation_are_not_wide() -> None:
    rng = np.random.default_rng(9)
    samples = np.minimum(np.rint(rng.normal(3900, 150, (40, 100, 100))), 4000).astype(np.uint16)
    counts = histogram([samples], np.ones((100, 100), bool))
    assert counts is not None
    seen = [code_widths(counts, 3.0, last=last) for last in (np.inf, 4000.0)]
    clipped, whole = (max(_uneven(widths)[2]) for widths in seen if widths is not None)
    assert whole < 4 < clipped


@pytest.mark.long
@pytest.mark.parametrize(
    "given",
    [
        {"coarse_adu": 3.0, "dnl_rms": 0.3, "ripple": 0.1},
        {"coarse_adu": 0.0, "dnl_rms": 0.05, "ripple": 0.02},
        {"coarse_adu": 0.37, "dnl_rms": 0.1, "ripple": 0.08, "ripple_codes": 3.7},
    ],
)
def test_step_and_widths_are_found(
    acquired: Callable[..., Evidence], given: dict[str, float]
) -> None:
    found = Quantisation.estimate(acquired(None, {"quantisation": given}))
    assert found is not None
    assert found.significance > 10
    for name in ("coarse_adu", "dnl_rms", "ripple"):
        value, error = getattr(found.effect, name), found.errors[name]
        assert abs(value - given[name]) < 4 * error, name
        assert error < 0.12 * max(given[name], 0.05), name
    if given["ripple"]:
        assert isinstance(found.effect, Quantisation)
        assert found.effect.ripple_codes == pytest.approx(given.get("ripple_codes", 2), rel=1e-3)


Bits = tuple[float, ...]
BITS = (0.07, 0.1, 0.1, -0.2, -0.14, 0.2, -0.1, 0.6, 0.3, -0.1, -1.3, 1.1)


# Levels overlap by a dozen codes where bits 9 and 11 turn over.
OVERLAPPING = (0.0, 0.0, 0.1, 0.1, 0.2, 0.0, 1.0, 0.7, 1.5, -8.2, -0.8, -15.0)


def levels(bits: Bits) -> NDArray[np.float64]:
    weights = 2.0 ** np.arange(len(bits)) + np.array(bits)
    return np.array((np.arange(2 ** len(bits))[:, None] >> np.arange(len(bits)) & 1) @ weights)


def by_successive_approximation(samples: NDArray[np.float64], bits: Bits) -> NDArray[np.int64]:
    left, codes = samples + 0.5, np.zeros(samples.size, np.int64)
    for bit in reversed(range(len(bits))):
        weight = 2**bit + bits[bit]
        taken = left >= weight
        left = left - weight * taken
        codes += taken << bit
    return codes


def between_neighbours(samples: NDArray[np.float64], bits: Bits) -> NDArray[np.int64]:
    level = levels(bits)
    edges = np.minimum.accumulate((level[1:] + level[:-1])[::-1] / 2)[::-1]
    return np.searchsorted(edges, samples, "right")


def nearest_of_all(samples: NDArray[np.float64], bits: Bits) -> NDArray[np.int64]:
    level = levels(bits)
    order = np.argsort(level, kind="stable")
    level = level[order]
    return order[np.searchsorted((level[1:] + level[:-1]) / 2, samples)]


Converter = Callable[[NDArray[np.float64], Bits], NDArray[np.int64]]
CONVERTERS: dict[Law, Converter] = {
    FITS: by_successive_approximation,
    NEAREST: between_neighbours,
    NEAREST_OF_ALL: nearest_of_all,
}
each_law = pytest.mark.parametrize(
    "law", CONVERTERS, ids=[one.__name__ for one in CONVERTERS.values()]
)


@each_law
@pytest.mark.parametrize("bits", [BITS, OVERLAPPING])
def test_wrong_bits_give_the_codes_of_each_converter(law: Law, bits: Bits) -> None:
    samples = ramp(300.0, 3900.0, 50)
    expected = CONVERTERS[law](samples.astype(float), bits)
    effect = Quantisation(0.0, 0.0, 0.0, bits=bits, **law._asdict())
    assert np.mean(effect.converted(samples, 0, TOP) != expected) < 1e-3


def test_the_nearest_of_levels_with_wrong_bits_is_taken() -> None:
    samples = ramp(300.0, 3900.0, 5)[::9]
    apart = np.abs(samples[:, None] - levels(OVERLAPPING))
    bits = {"bits": OVERLAPPING, **NEAREST_OF_ALL._asdict()}
    codes = Quantisation(0.0, 0.0, 0.0, **bits).converted(samples, 0, TOP)
    np.testing.assert_array_less(
        np.take_along_axis(apart, codes.astype(int)[:, None], 1)[:, 0], apart.min(axis=1) + 1e-3
    )


def test_codes_have_the_widths_that_were_measured() -> None:
    widths = np.zeros(3000)
    widths[[500, 1024, 2047]] = 2.5, -0.4, -1.0
    effect = Quantisation(0.0, 0.0, 0.0, widths=tuple(widths))
    counts = np.bincount(effect.converted(ramp(400, 2400, 50), 0, TOP).astype(int)) / 50
    np.testing.assert_allclose(counts[450:2300], 1 + widths[450:2300], atol=0.03)


def codes_of(begins: NDArray[np.float64], noise: float = 3.0) -> NDArray[np.float64]:
    """Counts of a converter whose codes begin there, of light spread evenly."""
    rng = np.random.default_rng(8)
    light = rng.normal(rng.uniform(500, 3500, 4_000_000), noise)
    return np.bincount(np.searchsorted(begins, light, "right") - 1, minlength=4096).astype(float)


def widths_of(law: Law, bits: Bits, noise: float = 3.0) -> CodeWidths:
    """Of light spread evenly."""
    rng = np.random.default_rng(8)
    codes = CONVERTERS[law](rng.normal(rng.uniform(500, 3500, 4_000_000), noise), bits)
    widths = code_widths(np.bincount(codes, minlength=4096).astype(float), noise)
    assert widths is not None
    return widths


@pytest.mark.parametrize("law", [FITS, NEAREST])
def test_it_is_told_which_level_a_converter_with_wrong_bits_takes(law: Law) -> None:
    off = np.zeros(12)
    off[[5, 7, 10]] = 0.3, -0.5, 1.5
    widths = widths_of(law, tuple(off))
    found = widths.wrong_bits(0.0)
    assert found.law == law
    for bit in (5, 7, 10):
        over = np.where(np.arange(12) == bit, 1.0, np.where(np.arange(12) < bit, -1.0, 0.0))
        error = np.sqrt(over @ found.covariance @ over)
        assert over @ (found.bits - off) == pytest.approx(0, abs=4 * error + 0.03)
    # A response without a slope of its own.
    moved = level_errors(widths.level(found.bits), 4096)[widths.number]
    assert abs(np.polyfit(widths.number, moved, 1)[0]) < 1e-9


@each_law
def test_the_law_is_told_where_levels_overlap_and_where_they_do_not(law: Law) -> None:
    """Where they do not, the nearest level is that of the code or of a neighbour."""
    apart, over = np.zeros(12), np.zeros(12)
    apart[[5, 7, 10]] = 0.3, -0.5, 0.5
    over[[5, 7, 10]] = 0.3, -1.6, -2.6
    for off, expected in ((apart, law._replace(any_code=False)), (over, law)):
        widths = widths_of(law, tuple(off))
        values, errors, _, _ = _uneven(widths, far=True)
        assert (values["below"], values["any_code"]) == expected
        away = np.abs(values["bits"] - widths.level(off))
        assert np.all(away < 4 * np.array([errors.get(f"bits[{n}]", 0) for n in range(12)]) + 0.05)
        assert values["dnl_rms"] < 0.02


def test_weights_are_found_where_levels_overlap_by_many_codes() -> None:
    widths = widths_of(NEAREST_OF_ALL, OVERLAPPING)
    true = widths.level(np.array(OVERLAPPING))
    values, near = _uneven(widths, far=True)[0], _uneven(widths)[0]
    assert values["any_code"]
    assert values["bits"] == pytest.approx(true, abs=0.4)
    assert np.abs(near["bits"] - true).max() > 2


def test_no_bit_is_told_to_be_off_by_more_than_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where the codes at hand leave the common factor of the weights open."""
    widths = widths_of(FITS, (*[0.0] * 7, -0.5, *[0.0] * 4))
    assert "bits" in _uneven(widths)[0]
    factor = -43.8 * 2.0 ** np.arange(12)
    monkeypatch.setattr(CodeWidths, "level", lambda _, bits: bits + factor * (np.ptp(bits) > 0))
    assert "bits" not in _uneven(widths)[0]


@pytest.mark.parametrize("seed", [1, 2])
def test_even_codes_of_many_levels_have_no_wrong_bits(seed: int) -> None:
    """Levels leave codes between them out, so that some weights are hardly constrained."""
    rng, counts = np.random.default_rng(seed), np.zeros(8192)
    for n in range(15):
        samples = np.rint(rng.normal(463 + 449.1 * n, 3.6 + 3.7 * n, 200_000)).astype(int)
        counts += np.bincount(samples, minlength=len(counts))
    widths = code_widths(counts, 1.4, 360.0)
    assert widths is not None
    fit = widths.wrong_bits(2 * widths.scatter()[0])
    assert fit.chi2 < np.sum(widths.width**2 / widths.variance)
    assert sigmas_of_chi2(fit.chi2, len(fit.bits)) < 3


def test_bits_that_do_not_turn_over_are_not_told() -> None:
    """Codes below 2048 say nothing of bit 11, whatever its weight."""
    rng = np.random.default_rng(4)
    light = rng.normal(rng.uniform(500, 1900, 2_000_000), 3.0)
    codes = nearest_of_all(light, OVERLAPPING)
    assert codes.max() < 2048
    widths = code_widths(np.bincount(codes, minlength=4096).astype(float), 3.0)
    assert widths is not None
    values = _uneven(widths, far=True)[0]
    true = widths.level(np.array((*OVERLAPPING[:11], 0.0))[: len(values["bits"])])
    assert values["any_code"]
    assert values["bits"][:11] == pytest.approx(true[:11], abs=0.4)


def test_single_wide_codes_are_measured_whatever_the_converter_does() -> None:
    """Coarse references that are off, each by itself: no error of bits."""
    rng = np.random.default_rng(3)
    begins = np.arange(4096) - 0.5 + np.repeat(rng.normal(0, 0.8, 4096 // 64), 64)
    true = np.diff(begins) - 1
    widths = code_widths(codes_of(np.minimum.accumulate(begins[::-1])[::-1]), 3.0)
    assert widths is not None
    measured = widths.measured
    steps = np.arange(639, 3400, 64)  # the last codes before a reference
    steps = steps[true[steps] > -0.9]  # neither left out nor over others
    assert np.abs(measured[steps] - true[steps]).max() < 0.15
    even = np.setdiff1d(np.arange(600, 3400), np.arange(639, 3400, 64)[:, None] + np.arange(-4, 5))
    assert np.abs(measured[even]).max() < 4.5 * (4_000_000 / 3000) ** -0.5  # chance of the counts


@pytest.mark.long
def test_widths_of_a_converter_of_sixteen_bits_are_measured() -> None:
    rng = np.random.default_rng(5)
    true = np.zeros(60_001)
    wide = rng.choice(np.arange(1000, 59_000, 17), 300, replace=False)
    true[wide] = 0.7
    light = rng.uniform(900, 59_500, 6_000_000) + rng.normal(0, 8, 6_000_000)
    begins = np.arange(60_001) - 0.5 + np.cumsum(true) - true
    counts = np.bincount(np.searchsorted(begins, light, "right") - 1).astype(float)
    widths = code_widths(counts, 8.0)
    assert widths is not None
    measured, chance = widths.measured, 100**-0.5
    wide = wide[wide < len(measured) - 100]
    assert np.abs(measured[wide] - 0.7).max() < 5.5 * chance * 1.7**0.5 + 0.05
    assert 0.63 < measured[wide].mean() < 0.71  # shrunk, by less than a tenth


def test_widths_of_displaced_thresholds_are_measured_and_do_not_wander() -> None:
    rng = np.random.default_rng(6)
    begins = np.sort(np.arange(4096) - 0.5 + rng.normal(0, 0.5, 4096))
    widths = code_widths(codes_of(begins), 3.0)
    assert widths is not None
    measured, true = widths.measured, np.diff(begins) - 1
    inner = slice(560, 3430)
    # The local fit divides by what uneven codes make of its mean, which leaves some scatter.
    assert np.std(measured[inner] - true[inner]) < 0.2 * np.std(true[inner])
    assert np.abs(np.cumsum(measured)[600:3400:100]).max() < 3


@pytest.mark.parametrize("share", [0.03, 0.09, 0.14])
def test_codes_that_are_left_out_do_not_displace_the_response(share: float) -> None:
    """Their samples have the next code there is, which begins earlier; all others stay."""
    there = np.flatnonzero(np.random.default_rng(11).random(4096) >= share)
    begins = np.zeros(4097)
    begins[there] = np.concatenate([[0], there[:-1] + 1]) - 0.5
    begins = np.minimum.accumulate(np.where(begins, begins, np.inf)[::-1])[::-1][:4080]
    widths = code_widths(codes_of(begins), 3.0)
    assert widths is not None
    inner = slice(600, 3400)
    measured, true = widths.measured, np.diff(begins) - 1
    assert measured[inner][true[inner] < -0.9].mean() < -0.95
    assert np.std(measured[inner] - true[inner]) < 0.25 * np.std(true[inner])
    # Where codes begin, without what a bias and a gain have.
    off = np.cumsum(measured)[inner] - np.cumsum(true)[inner]
    number = np.arange(len(off))
    off -= np.polyval(np.polyfit(number, off, 1), number)
    assert np.std(off) < 0.6 * np.std((begins - np.arange(4080))[inner])


@pytest.mark.parametrize("step", [0.8, -0.6, -1.3, -2.8, -3.5])
def test_where_a_bit_leaves_several_codes_out_its_weight_is_told(step: float) -> None:
    """Codes by successive approximation of noisy light; bit 10 turns over at 1024 and 3072."""
    off = np.zeros(12)
    off[[7, 10]] = 0.4, step
    widths = widths_of(FITS, tuple(off))
    found = widths.bits(0.0)
    bits, covariance = found.bits, found.covariance
    # A common factor of all weights does not show; what a bit adds over all lower ones does.
    for bit in (7, 10):
        over = np.where(np.arange(12) == bit, 1.0, np.where(np.arange(12) < bit, -1.0, 0.0))
        error = np.sqrt(over @ covariance @ over)
        assert error < 0.06
        assert over @ (bits - off) == pytest.approx(0, abs=4 * error + 0.03)


@pytest.mark.long
def test_wrong_bits_are_found_where_only_shot_noise_spans_a_step(
    acquired: Callable[..., Evidence],
) -> None:
    given = {"coarse_adu": 0.0, "dnl_rms": 0.0, "ripple": 0.0, "bits": list(BITS)}
    found = Quantisation.estimate(
        acquired({"detector.gain_e_per_adu": 40.0}, {"quantisation": given})
    )
    assert found is not None
    assert isinstance(found.effect, Quantisation)
    assert found.significance > 10
    # A common factor is the slope of the response, which the gain has; a code's width is not.
    off = np.array(found.effect.bits) - BITS[: len(found.effect.bits)]
    for bit in range(6):
        error = found.errors[f"bits[{bit}]"]
        assert abs(off[bit] - off[:bit].sum()) < max(4 * error, 0.02), bit
        assert error < 0.03
    # Bits hang together: moved within their errors, codes stay about as wide.
    moved = np.array([found.scattered(found.effect, seed).bits for seed in range(20)])
    wide = (moved - found.effect.bits)[:, 5] - (moved - found.effect.bits)[:, :5].sum(axis=1)
    assert 0 < np.std(wide) < 0.03
    even = Quantisation.estimate(acquired({"detector.gain_e_per_adu": 40.0}))
    assert even is not None
    assert even.significance < 4


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "other",
    [{"nonlinearity": {}}, {"row_noise": {"row_rms": 5.0}}, {"intensity_noise": {"rms": 0.02}}],
    ids=lambda e: next(iter(e)),
)
def test_other_effects_are_not_taken_for_it(
    acquired: Callable[..., Evidence], other: dict[str, dict[str, float]]
) -> None:
    found = Quantisation.estimate(acquired(None, other))
    assert found is not None
    assert found.significance < 4


def test_samples_that_are_no_codes_say_nothing() -> None:
    frames = np.random.default_rng(1).normal(500, 9, (5, 8, 8)).astype(np.float32)
    assert histogram([frames], np.ones((8, 8), bool)) is None


def test_uneven_codes_are_as_uneven_where_float32_is_coarse() -> None:
    """At 45 000 ADU samples lie 0.004 apart, and displaced thresholds as far from their places."""
    ripple = Quantisation(coarse_adu=0.0, dnl_rms=0.0, ripple=0.007)
    rng = np.random.default_rng(5)
    size = (1000, 1000)
    found = []
    for level in (33e3, 40e3, 47e3, 55e3):
        adu = (level + 20 * rng.standard_normal(size)).astype(np.float32)
        normals = rng.standard_normal(size).astype(np.float32)
        codes = ripple.converted(adu, 1, 65535.0, normals).astype(int)
        found.append(2 * np.mean(codes % 2 == 0) - 1)
    assert np.mean(found) == pytest.approx(0.007, abs=4 / 2e3)


@pytest.mark.long
def test_bits_that_leave_codes_out_are_no_coarse_step(acquired: Callable[..., Evidence]) -> None:
    """A code in 256 that never comes is a wrong bit, though a step of 1 + 1/256 makes such too."""
    bits = (0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.4, -1.4, -1.5, 0.1, 3.9)
    on = {"coarse_adu": 0.0, "dnl_rms": 0.0, "ripple": 0.0, "bits": list(bits)}
    evidence = acquired({"detector.gain_e_per_adu": 25.0}, {"quantisation": on})
    found = Quantisation.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, Quantisation)
    assert found.effect.coarse_adu == 0
    assert found.effect.bits[8] < -0.5
    assert found.significance > 6
