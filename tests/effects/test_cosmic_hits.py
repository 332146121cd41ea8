"""Cosmic hits: rate, tracks and charge are those given, one frame each, and are found again."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from all_frames import frames_of
from scipy import stats
from scipy.special import erf

from pixcal.effects.cosmic_hits import CosmicHits
from pixcal.estimators.detector.hits import hit_rates
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.tracks import GRAZING, add_tracks, draw_tracks
from pixcal.model.bench import Bench
from pixcal.simulation.recording import recordings

RNG = np.random.default_rng(3)


def test_tracks_have_the_length_of_an_even_flux_and_the_charge_of_moyal() -> None:
    n, depth = 20_000, 2.0
    tracks = draw_tracks(RNG, n, (50, 70), 5, depth, 300.0, 0.15)
    length = np.hypot(np.hypot(tracks[:, 2], tracks[:, 3]), depth)
    # Through a plane the chance of a cosine c is 2 c: lengths above l have a share (depth / l)².
    for longer in (1.5, 3.0, 10.0):
        share = longer**-2
        error = np.sqrt(share * (1 - share) / n)
        assert np.mean(length > longer * depth) == pytest.approx(share, abs=4 * error)
    assert length.max() <= depth / GRAZING * 1.0001
    deviates = (tracks[:, 4] / (300 * length) - 1) / 0.15
    assert stats.kstest(deviates[deviates > -6], stats.moyal.cdf).pvalue > 1e-3
    for column, size in ((0, 50), (1, 70)):
        assert stats.kstest(tracks[:, column], stats.uniform(-5.5, size + 10).cdf).pvalue > 1e-3


def test_a_track_lays_its_charge_along_its_way() -> None:
    frame = np.zeros((31, 41), np.float32)
    sigma = 0.4
    add_tracks(frame, np.array([[15.0, 20.0, 0.0, 0.0, 1000.0]]), sigma, 0)
    assert frame.sum() == pytest.approx(1000, rel=1e-3)
    inside = erf(0.5 / (np.sqrt(2) * sigma))
    assert frame[15, 20] == pytest.approx(1000 * inside**2, rel=1e-3)
    frame[:] = 0
    add_tracks(frame, np.array([[5.0, 5.0, 0.0, 20.0, 8000.0]]), sigma, 0)
    assert frame.sum() == pytest.approx(8000, rel=1e-3)
    np.testing.assert_allclose(frame[:, 8:22].sum(axis=0), 400, rtol=0.02)
    assert np.argmax(frame.sum(axis=1)) == 5
    part = np.zeros((10, 41), np.float32)
    add_tracks(part, np.array([[5.0, 5.0, 0.0, 20.0, 8000.0]]), sigma, 2)
    assert np.array_equal(part, frame[2:12])


def test_the_rate_is_that_of_area_and_time(make_effect_bench: Callable[..., Bench]) -> None:
    rate = 4000.0
    bench = make_effect_bench(
        {"detector.shape": [64, 61], "frames.darks": [{"exptime_s": 0.5, "count": 150}]}
    )
    by_kind = {r.kind: r for r in recordings(bench)}
    hits = CosmicHits(rate)
    bias = by_kind["bias"]
    assert np.array_equal(frames_of(bench, bias, [hits]), frames_of(bench, bias))
    dark = by_kind["dark"]
    added = frames_of(bench, dark, [hits]).astype(float) - frames_of(bench, dark)
    assert added.min() >= 0
    area = 64 * 61 * (4.4e-4) ** 2
    expected = rate * area * 0.5 * dark.count
    # Charge of a track: 70 e-/um times 2 x 8 um of mean length, times the mean of Moyal's factor.
    mean_length = 2 * 8.0 * (1 - GRAZING / 2)
    mean = 70 * mean_length * (1 + 0.15 * stats.moyal.mean())
    assert added.sum() / mean == pytest.approx(expected, abs=5 * 1.7 * np.sqrt(expected))
    frames_hit = np.count_nonzero(added.max(axis=(1, 2)) > 100)
    chance = 1 - np.exp(-expected / dark.count)
    error = np.sqrt(dark.count * chance * (1 - chance))
    assert frames_hit == pytest.approx(dark.count * chance, abs=4.5 * error)


def test_charge_stops_at_the_full_well(make_effect_bench: Callable[..., Bench]) -> None:
    bench = make_effect_bench({"detector.full_well_e": 900.0, "detector.read_noise_e": 0.0})
    dark = next(r for r in recordings(bench) if r.kind == "dark")
    frames = frames_of(bench, dark, [CosmicHits(3e5)]).astype(float)
    assert np.sort((frames - frames.min(axis=0)).ravel())[-1] <= 905
    assert np.count_nonzero(frames > 1380) > 20


@pytest.mark.parametrize("readout", [0.0, 40.0])
@pytest.mark.parametrize("rate", [0.0, 12.0])
def test_hits_while_frames_are_read_out_are_told_from_those_of_the_exposure(
    rate: float, readout: float
) -> None:
    seconds, area = np.array([0.0, 1.0, 5.0]), np.array([3.0, 2.0, 2.0])
    exposures, chances = np.stack([area * seconds, area]), np.full(3, 0.01)
    pulls = []
    for _ in range(40):
        counts = RNG.poisson(rate * exposures[0] + readout * exposures[1]).astype(float)
        values, errors = hit_rates(counts, chances, exposures)
        assert len(errors) == 1 + (readout > 0)
        pulls += [(v - t) / e for v, t, e in zip(values, (rate, readout), errors, strict=False)]
    assert np.abs(pulls).max() < 4.5
    assert rate == 0 or 0.6 < np.std(pulls) < 1.4


def test_frames_are_hit_while_they_are_read_out(make_effect_bench: Callable[..., Bench]) -> None:
    bench = make_effect_bench({"detector.shape": [64, 61]})
    bias = next(r for r in recordings(bench) if r.kind == "bias")
    added = frames_of(bench, bias, [CosmicHits(0.0, 3e4)]).astype(float) - frames_of(bench, bias)
    expected = 3e4 * 64 * 61 * (4.4e-4) ** 2 * bias.count
    mean = 70 * 2 * 8.0 * (1 - GRAZING / 2) * (1 + 0.15 * stats.moyal.mean())
    assert added.sum() / mean == pytest.approx(expected, abs=5 * 1.7 * np.sqrt(expected))


@pytest.mark.long
@pytest.mark.parametrize(
    ("rate", "charge", "darks"),
    [(2_000.0, 70.0, True), (20_000.0, 120.0, True), (30_000.0, 160.0, False)],
)
def test_rate_and_charge_are_found(
    acquired: Callable[..., Evidence], rate: float, charge: float, darks: bool
) -> None:
    """In darks by the brightest pixel of each; without any, in the fringe frames."""
    effects = {"cosmic_hits": {"rate_cm2_s": rate, "electrons_per_um": charge}}
    found = CosmicHits.estimate(acquired(None if darks else {"frames.darks": []}, effects))
    assert found is not None
    assert isinstance(found.effect, CosmicHits)
    assert abs(found.effect.rate_cm2_s - rate) < 4 * found.errors["rate_cm2_s"]
    off = found.effect.electrons_per_um - charge
    assert abs(off) < 4 * found.errors["electrons_per_um"] < 0.5 * charge
    assert found.errors["rate_cm2_s"] < 0.35 * rate
    assert found.significance > 10
    assert not found.refused


@pytest.mark.long
def test_tracks_of_another_law_are_described(acquired: Callable[..., Evidence]) -> None:
    """Of any length and charge, each even along its way: their charge is found, and its spread."""
    evidence = acquired({"frames.darks": []})
    (name, fringes), *_ = evidence.fringes.items()
    rng, electrons = np.random.default_rng(8), fringes.electrons.copy()
    charge = np.zeros_like(electrons[0])
    brightest = []
    for frame in electrons:
        for _ in range(rng.poisson(1.5)):
            length, turn = 2 + rng.exponential(6), 2 * np.pi * rng.random()
            per_px = 300 + rng.exponential(600)
            y, x = rng.random(2) * frame.shape
            charge[:] = 0
            track = [y, x, length * np.sin(turn), length * np.cos(turn), per_px * length]
            add_tracks(charge, np.array([track]), 0.15, 0)
            frame += charge
            brightest.append(charge.max())
    hit = replace(fringes, electrons=electrons)
    found = CosmicHits.estimate(replace(evidence, fringes={name: hit}, stacks=()))
    assert found is not None
    assert isinstance(found.effect, CosmicHits)
    assert found.effect.spread > 0
    pitch, shape = evidence.pitch_um, charge.shape
    drawn = []
    for track in found.effect.tracks(rng, 2000, pitch, shape, 0):
        charge[:] = 0
        add_tracks(charge, track[None], found.effect.diffusion_um / pitch, 0)
        drawn.append(charge.max())
    bright = [np.array(peaks) for peaks in (brightest, drawn)]
    per_frame = found.effect.rate_cm2_s * hit.exptime_s * np.prod(shape) * (pitch * 1e-4) ** 2
    for least in (600, 1000, 1500):
        true, own = (np.mean(b > least) for b in bright)
        assert own * per_frame == pytest.approx(true * 1.5, rel=0.25)


@pytest.mark.parametrize("count", [3, 12])
def test_one_hit_is_no_claim_and_two_are(acquired: Callable[..., Evidence], count: int) -> None:
    evidence = acquired()
    (dark,) = evidence.of_kind("dark")
    few = slice(count)
    dark = replace(dark, adu=dark.adu[few], frame=dark.frame[few], time_s=dark.time_s[few])
    rates = []
    for hits in (1, 2):
        adu = dark.adu.copy()
        y, x = np.argwhere(evidence.good)[[500, 2500][:hits]].T
        adu[np.arange(hits) + count - 2, y, x] += 800
        stacks = tuple(s for s in evidence.stacks if s.kind != "dark")
        found = CosmicHits.estimate(replace(evidence, stacks=(*stacks, replace(dark, adu=adu))))
        assert found is not None
        assert isinstance(found.effect, CosmicHits)
        rates.append(found.effect.rate_cm2_s)
        assert (found.significance > 4) == (hits > 1)
    assert rates[1] == pytest.approx(2 * rates[0], rel=0.2)


def test_what_comes_again_in_a_pixel_is_no_hit(acquired: Callable[..., Evidence]) -> None:
    effects = {"telegraph_noise": {"amplitude_e": 100.0, "switching_s": 3.0}}
    found = CosmicHits.estimate(acquired(None, effects))
    assert found is not None
    assert found.significance < 4


@pytest.mark.quick(1)
@pytest.mark.parametrize("places", [12, 400])
def test_hits_that_come_back_to_the_same_pixels_are_none(
    acquired: Callable[..., Evidence], places: int
) -> None:
    """As of pixels that are rarely in the upper of two levels, unlike many that are hit once."""
    evidence, rng = acquired(), np.random.default_rng(4)
    fringes = {}
    pixels = rng.permutation(np.argwhere(evidence.good))[:places]
    for name, one in evidence.fringes.items():
        electrons = one.electrons.copy()
        for y, x in pixels[rng.integers(0, places, 16)]:
            electrons[rng.integers(len(electrons)), y, x] += 3000
        fringes[name] = replace(one, electrons=electrons)
    found = CosmicHits.estimate(replace(evidence, fringes=fringes, stacks=()))
    assert found is not None
    assert found.significance > 4
    assert bool(found.refused) == (places == 12)


def test_without_darks_and_fringes_nothing_is_said(acquired: Callable[..., Evidence]) -> None:
    assert CosmicHits.estimate(replace(acquired(), fringes={}, stacks=())) is None


@pytest.mark.long
def test_without_an_exposure_time_frames_last_as_long_as_they_are_apart(
    acquired: Callable[..., Evidence],
) -> None:
    given = acquired(None, {"cosmic_hits": {"rate_cm2_s": 20_000.0}})
    unknown = {name: replace(fringes, exptime_s=np.nan) for name, fringes in given.fringes.items()}
    known, found = (
        CosmicHits.estimate(replace(given, fringes=fringes, stacks=()))
        for fringes in (given.fringes, unknown)
    )
    assert known is not None
    assert found is not None
    rates = [e.effect.rate_cm2_s for e in (known, found) if isinstance(e.effect, CosmicHits)]
    assert rates[1] == pytest.approx(rates[0] * 0.02 / 0.14, rel=1e-6)
