"""Brighter-fatter: charge moves as published, flats get its covariance, its size is found again."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.brighter_fatter import BrighterFatter
from pixcal.estimators.crosstalk.boundaries import shared_charge
from pixcal.estimators.detector.response import FALLOFFS_PX
from pixcal.estimators.diagnosis.central_crop import central_crop
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.boundaries import (
    REACH,
    boundary_shifts,
    mean_boundary_shifts,
    moved_charge,
    shared_noise,
)
from pixcal.model.bench import Bench
from pixcal.simulation.recording import recordings

RNG = np.random.default_rng(12)
SCENE = (20_000 + 15_000 * np.sin(1.3 * np.arange(15) + np.arange(13)[:, None])).astype(np.float32)
STRONG = 1e-6


def moved_by_definition(charge: np.ndarray, falloff: float) -> np.ndarray:
    """Guyonnet et al. 2015: flux over each boundary, boundary after boundary."""
    ny, nx = charge.shape
    out = np.zeros((ny, nx))
    for along in (0, 1):
        step = (1, 0) if along == 0 else (0, 1)
        for y in range(ny - step[0]):
            for x in range(nx - step[1]):
                shift = 0.0
                for v in range(y - REACH, y + REACH + 2):
                    for u in range(x - REACH, x + REACH + 2):
                        gap = (y + step[0] / 2 - v, x + step[1] / 2 - u)
                        if abs(gap[along]) > REACH or abs(gap[1 - along]) > REACH:
                            continue
                        r = np.hypot(*gap)
                        there = charge[min(max(v, 0), ny - 1), min(max(u, 0), nx - 1)]
                        shift -= (
                            0.5 * STRONG * np.exp(-(r - 0.5) / falloff) * gap[along] / r * there
                        )
                flux = shift * (charge[y, x] + charge[y + step[0], x + step[1]]) / 2
                out[y, x] += flux
                out[y + step[0], x + step[1]] -= flux
    return out


def test_charge_moves_over_the_boundaries_as_defined() -> None:
    moved = moved_charge(SCENE, STRONG * boundary_shifts(0.7))
    np.testing.assert_allclose(moved, moved_by_definition(SCENE, 0.7), atol=0.05)
    assert np.abs(moved).max() > 200
    assert abs(moved.sum(dtype=float)) < 1e-4 * np.abs(moved).sum()
    # Bright pixels lose what dark ones gain.
    assert np.corrcoef(moved.ravel(), SCENE.ravel())[0, 1] < -0.8


def area_changes(falloff_px: float) -> np.ndarray:
    """Area that a pixel gains by a charge in its neighbour: a_ij of Astier et al. 2019.

    In flats the covariance of two pixels is this, times the shift by an electron, times the mean
    charge squared. Of charges at rows and columns ``-REACH`` to ``REACH``, in units of the shift by
    an electron in px; of those at the rim only the nearer boundaries count.
    """
    right = np.pad(boundary_shifts(falloff_px), ((0, 0), (1, 0)))
    left = right[:, ::-1]
    across = right + left
    return across + across.T


def test_nothing_moves_in_an_even_scene() -> None:
    even = np.full((9, 11), 30_000, np.float32)
    assert np.abs(moved_charge(even, STRONG * boundary_shifts(0.5))).max() < 0.02
    assert area_changes(0.5).sum() == pytest.approx(0, abs=1e-12)
    assert area_changes(0.5)[REACH, REACH] == pytest.approx(-4)


def test_the_covariance_of_flats_is_that_of_the_area_changes() -> None:
    mean, size, shift = 20_000.0, 64, 5e-7
    sums = np.zeros(3)
    frames = 300
    for _ in range(frames):
        charge = RNG.poisson(mean, (size, size)).astype(np.float32)
        noise = (charge + moved_charge(charge, shift * boundary_shifts(0.5)))[4:-4, 4:-4] - mean
        sums += (
            (noise**2).mean(),
            (noise[1:] * noise[:-1]).mean() / 2 + (noise[:, 1:] * noise[:, :-1]).mean() / 2,
            (noise[1:, 1:] * noise[:-1, :-1]).mean(),
        )
    found, a = sums / frames, shift * area_changes(0.5)[REACH:, REACH:]
    error = mean / np.sqrt(frames * (size - 8) ** 2)
    assert found[0] == pytest.approx(mean + a[0, 0] * mean**2, abs=6 * error + 0.02 * mean * 0.04)
    assert found[1] == pytest.approx(a[0, 1] * mean**2, abs=4 * error)
    assert found[2] == pytest.approx(a[1, 1] * mean**2, abs=4 * error)
    assert a[0, 1] * mean**2 > 5 * error


def test_shared_noise_is_the_jacobian_of_the_moved_charge() -> None:
    shifts = STRONG * boundary_shifts(0.5)
    pushes = mean_boundary_shifts(SCENE[None], shifts)
    y, x, by = 6, 7, np.float32(500)
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2)):

        def slope(of: tuple[int, int], to: tuple[int, int]) -> float:
            up, down = SCENE.copy(), SCENE.copy()
            up[to] += by
            down[to] -= by
            change = moved_charge(up, shifts) - moved_charge(down, shifts)
            return float(change[of] / (2 * by))

        here, there = (y, x), (y + dy, x + dx)
        expected = slope(here, there) * SCENE[there] + slope(there, here) * SCENE[here]
        found = shared_noise(SCENE[None], pushes, shifts, (dy, dx))[0]
        assert found[here] == pytest.approx(expected, rel=0.01, abs=1)
        assert found[1].max() == found[:, -2].max() == 0


def test_what_moved_is_brought_back() -> None:
    effect = BrighterFatter(STRONG)
    charge = (SCENE * RNG.uniform(0.9, 1.1, SCENE.shape)).astype(np.float32)
    changed = charge + moved_charge(charge, STRONG * boundary_shifts(effect.falloff_px))
    assert np.abs(changed - charge).max() > 200
    np.testing.assert_allclose(effect.undo_samples(changed), charge, atol=0.1)


def test_charge_moves_over_the_edges_of_a_window(make_effect_bench: Callable[..., Bench]) -> None:
    """A window of a larger sensor comes out as it is within a larger window, edges included."""
    quiet = {
        "detector.chip": [60, 64],
        "detector.hot_fraction": 0.0,
        "detector.delta_rms_px": 0.0,
        "detector.prnu_rms": 0.0,
        "detector.bias_pixel_rms_adu": 0.0,
        "frames.fringes.0.count": 7,
        "detector.read_noise_e": 0.0,
    }
    effect = BrighterFatter(STRONG)

    def moved(shape: list[int]) -> np.ndarray:
        bench = make_effect_bench({**quiet, "detector.shape": shape})
        bench = replace(bench, shot_noise=False)
        fringes = next(r for r in recordings(bench) if r.kind == "fringes")
        plain, made = frames_of(bench, fringes), frames_of(bench, fringes, [effect])
        return made.astype(float) - plain

    inner, outer = moved([19, 23])[:, :, :], moved([29, 33])[:, 5:-5, 5:-5]
    # The peak of the window sets the power of the light.
    scale = np.vdot(outer, inner) / np.vdot(outer, outer)
    assert scale == pytest.approx(1, abs=0.02)
    assert np.abs(inner).max() > 100
    for edge in (np.s_[:, 0], np.s_[:, -1], np.s_[:, :, 0], np.s_[:, :, -1]):
        assert np.abs(inner[edge]).max() > 30
        np.testing.assert_allclose(inner[edge], scale * outer[edge], atol=6)


def test_frames_lose_contrast_with_their_level(make_effect_bench: Callable[..., Bench]) -> None:
    losses = []
    for peak in (10_000, 40_000):
        bench = replace(
            make_effect_bench(
                {
                    "frames.fringes.0.peak_e": peak,
                    "frames.fringes.0.count": 12,
                    "detector.read_noise_e": 0.0,
                }
            ),
            shot_noise=False,
        )
        fringes = next(r for r in recordings(bench) if r.kind == "fringes")
        plain = frames_of(bench, fringes).astype(float)
        changed = frames_of(bench, fringes, [BrighterFatter()])
        losses.append(1 - changed[:, 5:-5, 5:-5].std() / plain[:, 5:-5, 5:-5].std())
    assert losses[0] > 1e-4
    assert losses[1] / losses[0] == pytest.approx(4, rel=0.1)


def of_noise(evidence: Evidence) -> tuple[float, float]:
    """The shift by the noise that neighbours share, and its error."""
    noise = shared_charge(central_crop(evidence), boundary_shifts(0.5))
    assert noise is not None
    return noise.size, noise.variance**0.5


@pytest.mark.long
@pytest.mark.parametrize("size", [2.0e-7, 2.0e-8])
def test_its_size_is_found(acquired: Callable[..., Evidence], size: float) -> None:
    evidence = acquired(None, {"brighter_fatter": {"shift_px_per_e": size}})
    found = BrighterFatter.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, BrighterFatter)
    # Falloff and ratio are found too: a ratio of 1 within 0.2 leaves 0.4 of the size open.
    assert abs(found.effect.shift_px_per_e - size) < 4 * found.errors["shift_px_per_e"]
    assert found.errors["shift_px_per_e"] < 0.4 * size
    own = found.together[0]["shift_px_per_e"] if found.together else found.errors["shift_px_per_e"]
    assert own < 2.5e-9
    assert found.significance > 8
    value, error = of_noise(evidence)
    assert abs(value - size) < 4 * error


@pytest.mark.long
def test_noise_alone_tells_it_when_it_is_large(acquired: Callable[..., Evidence]) -> None:
    evidence = acquired(None, {"brighter_fatter": {"shift_px_per_e": 1e-6}})
    value, error = of_noise(evidence)
    assert abs(value - 1e-6) < 4 * error < 4e-7
    flats = BrighterFatter.estimate(replace(evidence, fringes={}))
    assert flats is not None
    assert isinstance(flats.effect, BrighterFatter)
    assert abs(flats.effect.shift_px_per_e - 1e-6) < 4 * flats.errors["shift_px_per_e"]
    assert flats.alike == ("ipc",)  # shares that grow with the level
    assert BrighterFatter.estimate(replace(evidence, fringes={}, stacks=())) is None


@pytest.mark.long
@pytest.mark.parametrize("other", ["nonlinearity", "ipc"])
def test_what_looks_like_it_is_not_taken_for_it(
    acquired: Callable[..., Evidence], other: str
) -> None:
    found = BrighterFatter.estimate(acquired(None, {other: {}}))
    assert found is not None
    assert found.significance < 4


@pytest.mark.long
@pytest.mark.parametrize("falloff", [0.35, 1.0])
def test_by_itself_its_falloff_is_found_with_its_size(
    acquired: Callable[..., Evidence], falloff: float
) -> None:
    changes = {"shift_px_per_e": 2e-7, "falloff_px": falloff}
    found = BrighterFatter.estimate(acquired(None, {"brighter_fatter": changes}))
    assert found is not None
    assert isinstance(found.effect, BrighterFatter)
    assert abs(found.effect.falloff_px - falloff) < 4 * found.errors["falloff_px"] < 0.8 * falloff
    assert abs(found.effect.shift_px_per_e - 2e-7) < 4 * found.errors["shift_px_per_e"] < 1e-7
    # A longer reach does with a smaller shift.
    own, _, both = found.together
    assert both["shift_px_per_e"] * both["falloff_px"] < 0
    assert found.errors["shift_px_per_e"] == pytest.approx(
        np.hypot(own["shift_px_per_e"], both["shift_px_per_e"])
    )


@pytest.mark.long
def test_beside_a_bent_response_it_is_not_taken_to_be_alone(
    acquired: Callable[..., Evidence],
) -> None:
    both = {"brighter_fatter": {"shift_px_per_e": 2e-7}, "nonlinearity": {}}
    found = BrighterFatter.estimate(acquired(None, both))
    assert found is not None
    assert isinstance(found.effect, BrighterFatter)
    assert found.effect.falloff_px == 0.5
    assert "falloff_px" not in found.errors
    assert abs(found.effect.shift_px_per_e - 2e-7) < 4 * found.errors["shift_px_per_e"]


OTHERWISE_BETWEEN_ROWS = {"shift_px_per_e": 3e-7, "falloff_px": 0.7, "along_y": 0.8}


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 6, 12, 101])
def test_boundaries_that_move_otherwise_between_rows_are_found(
    acquired: Callable[..., Evidence], seed: int
) -> None:
    """With two periods along an axis, which show the falloff whatever the ratio."""
    given = OTHERWISE_BETWEEN_ROWS
    sets = [
        {"name": f"set{n}", "baseline_mm": mm, "count": 300, "peak_e": 45000}
        for n, mm in enumerate(([11.5, 0.0], [0.0, 11.0], [6.0, 0.0]))
    ]
    changes = {"seed": seed, "detector.seed": 4600 + seed, "frames.fringes": sets}
    found = BrighterFatter.estimate(acquired(changes, {"brighter_fatter": given}))
    assert found is not None
    for name, value in given.items():
        assert abs(getattr(found.effect, name) - value) < 3 * found.errors[name] < value / 2
    # The ratio hangs on the falloff; given that it is known far better.
    assert min(part["along_y"] for part in found.together if "along_y" in part) < 0.003


@pytest.mark.long
def test_with_one_period_along_each_axis_fringes_get_what_they_showed(
    acquired: Callable[..., Evidence],
) -> None:
    """Falloff and ratio are hardly told apart, and their errors say so; what moves is known."""
    evidence = acquired(None, {"brighter_fatter": OTHERWISE_BETWEEN_ROWS})
    found = BrighterFatter.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, BrighterFatter)
    for name, value in OTHERWISE_BETWEEN_ROWS.items():
        assert abs(getattr(found.effect, name) - value) < 3 * found.errors[name] < value / 2
    y, x = np.mgrid[:40, :50]
    for fringes in evidence.fringes.values():
        light = (2e4 * (1 + 0.9 * np.cos(fringes.k[0] * x + fringes.k[1] * y))).astype(np.float32)
        made, true = (
            moved_charge(light, e.shift_px_per_e * boundary_shifts(e.falloff_px), e.along_y)
            for e in (found.effect, BrighterFatter(**OTHERWISE_BETWEEN_ROWS))
        )
        inside = np.s_[REACH:-REACH, REACH:-REACH]
        assert np.abs(made - true)[inside].max() < 0.03 * np.abs(true[inside]).max()


@pytest.mark.long
def test_boundaries_that_move_alike_have_no_ratio(acquired: Callable[..., Evidence]) -> None:
    found = BrighterFatter.estimate(acquired(None, {"brighter_fatter": {"shift_px_per_e": 3e-7}}))
    assert found is not None
    assert isinstance(found.effect, BrighterFatter)
    assert abs(found.effect.along_y - 1) <= 4 * found.errors.get("along_y", 0.0)


@pytest.mark.parametrize("period", [4.0, 6.0, 9.0, 14.0])
@pytest.mark.parametrize("falloff", [0.5, 1.0])
def test_charge_beyond_the_reach_hardly_moves_boundaries_of_plane_fringes(
    falloff: float, period: float
) -> None:
    """The shift under a sine is that of an endless sum over all charges."""

    def amplitude(reach: int) -> float:
        y, x = np.arange(-reach, reach + 1)[:, None], 0.5 - np.arange(1 - reach, reach + 1)
        r = np.hypot(y, x)
        return float(np.sum(np.exp(-(r - 0.5) / falloff) * x / r * np.sin(2 * np.pi * x / period)))

    x = 0.5 - np.arange(1 - REACH, REACH + 1)
    within = -float(np.sum(boundary_shifts(falloff) * np.sin(2 * np.pi * x / period)))
    assert within == pytest.approx(amplitude(60), rel=0.08)


@pytest.mark.parametrize("falloff", [0.3, 0.6, 1.7])
def test_shifts_of_any_falloff_are_a_sum_of_those_that_are_fitted(falloff: float) -> None:
    """To 10⁻⁵ of the shift by the pixel's own charge."""
    fitted = np.stack([boundary_shifts(f).ravel() for f in FALLOFFS_PX], axis=1)
    wanted = boundary_shifts(falloff).ravel()
    shares = np.linalg.lstsq(fitted, wanted, rcond=None)[0]
    np.testing.assert_allclose(fitted @ shares, wanted, atol=1e-5)


@pytest.mark.long
def test_noise_that_would_contradict_another_falloff_does_not_hide_it(
    acquired: Callable[..., Evidence],
) -> None:
    """The falloff is that of the harmonics: a weak effect of a wide one is seen all the same."""
    on = {"brighter_fatter": {"shift_px_per_e": 5e-8, "falloff_px": 1.2}}
    found = BrighterFatter.estimate(acquired(None, on))
    assert found is not None
    assert found.significance > 5
    assert isinstance(found.effect, BrighterFatter)
    assert found.effect.falloff_px == pytest.approx(1.2, rel=0.2)
