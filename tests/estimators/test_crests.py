"""Crests and valleys: where they are, how well, and the fibres that they give."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pixcal.estimators.fringe_fit.shapes.hyperbolic import prior_errors
from pixcal.kernels.optics import Geometry, paraxial_vector, phase
from pixcal.model.errors import InputError
from pixcal.stages.crests.crest_fit import (
    CrestFit,
    cost_map,
    falls_then_rises,
    fit_crests,
    relative_phase,
    valley,
)
from pixcal.stages.crests.crests import SEED_PIXELS, CrestPaths, find_crests, seed_vector
from pixcal.stages.crests.windows import N_SUMS, CrestCarrier, Windows, tile_sums

F64 = NDArray[np.float64]
WIDE_PITCH = 40e-3
"""mm: a window of a few hundred such pixels spans the angles of a whole large detector."""


@dataclass(frozen=True)
class ArrayFrames:
    """Frames in memory, as an `Accumulate`."""

    frames: NDArray[Any]  # (t, y, x) electrons; not finite: no sample
    good: NDArray[np.bool_]  # (y, x)

    def __call__(self, frame: int, windows: Windows, carrier: CrestCarrier) -> F64:
        sums = np.zeros((*windows.shape, N_SUMS))
        signal = self.frames[frame]
        for y in range(0, signal.shape[0], 512):
            band = signal[y : y + 512]
            good = self.good[y : y + 512] & np.isfinite(band)
            (i, j), part = tile_sums(band, good, (y, 0), windows, carrier)
            sums[i : i + part.shape[0], j : j + part.shape[1]] += part
        return sums


NO_PRIOR = np.full(6, np.inf)


def fit_freely(paths: CrestPaths, start: Geometry) -> CrestFit:
    return fit_crests(paths, start, NO_PRIOR)


def crests_of_frames(
    frames: NDArray[Any],
    nominal: tuple[float, float],
    good: NDArray[np.bool_] | None = None,
    segment: int | None = None,
) -> CrestPaths:
    """Crests and valleys of a frame (y, x), or of several (t, y, x) of the same fringes."""
    frames = frames if frames.ndim == 3 else frames[None]
    shape = (frames.shape[1], frames.shape[2])
    good = np.ones(shape, bool) if good is None else good
    y, x = (slice(max(0, (n - SEED_PIXELS) // 2), (n + SEED_PIXELS) // 2) for n in shape)
    k = seed_vector(frames[0, y, x], good[y, x] & np.isfinite(frames[0, y, x]), nominal)
    return find_crests(ArrayFrames(frames, good), len(frames), shape, k, segment)


def fibres(
    shape: tuple[int, int],
    interfringe: float,
    angle: float = 0.0,
    pitch: float = 4.4e-3,
    offset: tuple[float, float] = (0.0, 0.0),
    tilt: float = 0.0,
) -> Geometry:
    ny, nx = shape
    length = 632.8e-6 * 400.0 / (pitch * interfringe)
    return Geometry(
        632.8e-6,
        pitch,
        (nx - 1) / 2 * pitch + offset[0],
        (ny - 1) / 2 * pitch + offset[1],
        400.0,
        length * np.cos(angle),
        length * np.sin(angle),
        tilt,
    )


def exposed(
    shape: tuple[int, int],
    geometry: Geometry,
    rng: np.random.Generator | None = None,
    phi: float = 0.7,
    beam: float | None = None,
    peak: float = 50e3,
) -> F64:
    """Electrons of a frame: 50 ke- at the peak and, with a generator, shot and 16 e- read noise."""
    ny, nx = shape
    y, x = np.ogrid[:ny, :nx]
    light: Any = peak / 1.95
    if beam is not None:
        light = light * np.exp(-(((x - 0.3 * nx) ** 2 + (y - 0.6 * ny) ** 2) / beam**2))
    frame = np.asarray(light * (1 + 0.95 * np.cos(phase(x, y, geometry) + phi)))
    return frame if rng is None else rng.poisson(frame) + rng.normal(0, 16.0, frame.shape)


def misplaced(geometry: Geometry, distance: float, offset: float, share: float) -> Geometry:
    """A start so far wrong: mm of distance, mm of the centre, share of the baseline."""
    away = [0.8 * offset, -0.6 * offset, distance]
    away += [share * geometry.baseline_x, share * geometry.baseline_y, -geometry.baseline_z]
    return geometry.with_vector(geometry.vector() + away)


def errors(paths: CrestPaths, geometry: Geometry) -> F64:
    """Phase errors of the points, rad, less one constant; a wrong number is an error of pi."""
    off = relative_phase(paths, geometry) - paths.k * np.pi
    return np.asarray(off - np.average(off, weights=paths.sigma**-2.0))


@pytest.mark.long
def test_without_noise_the_fibres_are_found_to_numerical_precision() -> None:
    shape = (1181, 1303)
    truth = fibres(shape, 9.6, offset=(5.0, -3.0), tilt=0.01)
    paths = crests_of_frames(exposed(shape, truth), paraxial_vector(truth))
    assert np.abs(errors(paths, truth)).max() < 1e-9
    fit = fit_freely(paths, misplaced(truth, 10.0, 18.0, 0.05))
    # A nanometre in 40 cm; the worst known combination is that of distance, length and centre.
    assert np.abs(fit.geometry.vector() - truth.vector()) == pytest.approx(0, abs=1e-5)
    assert fit.cost < 1e-15


@pytest.mark.long
def test_a_beam_that_is_not_even_moves_no_crest() -> None:
    shape = (420, 510)
    truth = fibres(shape, 11.0, 1.1, offset=(2.0, 1.0))
    paths = crests_of_frames(exposed(shape, truth, beam=600.0), paraxial_vector(truth))
    # The brightest samples of the crests themselves lie 1e-2 rad off.
    assert np.abs(errors(paths, truth)).max() < 1e-5


@pytest.mark.parametrize("angle", [0.0, np.pi / 2, 0.35, -2.2])
@pytest.mark.parametrize(
    ("interfringe", "shape"), [(2.5, (101, 113)), (9.6, (149, 163)), (60.0, (400, 431))]
)
def test_fringes_of_any_width_and_direction(
    angle: float, interfringe: float, shape: tuple[int, int]
) -> None:
    truth = fibres(shape, interfringe, angle, offset=(3.0, -2.0))
    rng = np.random.default_rng(round(10 * interfringe + angle))
    paths = crests_of_frames(exposed(shape, truth, rng), paraxial_vector(truth))
    assert paths.interfringe == pytest.approx(interfringe, rel=1e-3)
    assert len(paths) >= 12
    pull = errors(paths, truth) / paths.sigma
    assert np.abs(pull).max() < 6
    assert 0.6 < pull.std() < 1.5
    # Points spread over the frame use its photons: the bound of even light, as far as windows go.
    bound = np.sqrt(2 / np.prod(shape)) / np.sqrt(25e3) * np.sqrt(1.1)
    assert 1 / np.sqrt((paths.sigma**-2.0).sum()) < 2.2 * bound


def test_crests_are_bright_and_valleys_dark() -> None:
    shape = (160, 180)
    truth = fibres(shape, 12.0, 0.2)
    frame = exposed(shape, truth, np.random.default_rng(2), phi=2.0)
    paths = crests_of_frames(frame, paraxial_vector(truth))
    light = frame[np.rint(paths.y).astype(int), np.rint(paths.x).astype(int)]
    even = paths.k % 2 == 0
    assert 0.2 < even.mean() < 0.8
    assert light[even].min() > 4 * light[~even].max()
    across = paths.x * np.cos(0.2) + paths.y * np.sin(0.2)
    assert np.corrcoef(paths.k, across)[0, 1] > 0.999


@pytest.mark.long
@pytest.mark.quick(1)
@pytest.mark.parametrize("pitch", [WIDE_PITCH, 4.4e-3])
def test_errors_are_honest(pitch: float) -> None:
    """Pulls over 36 frames: with a wide window all is free, else the truth is drawn from the
    prior."""
    shape, seeds = (130, 150), 36
    rng = np.random.default_rng(5)
    points, pulls = [], []
    for _ in range(seeds):
        truth = nominal = fibres(shape, 6.0, 0.3, pitch)
        prior = NO_PRIOR
        if pitch == 4.4e-3:
            prior = prior_errors(nominal)
            truth = nominal.with_vector(nominal.vector() + prior * rng.normal(size=6))
        frame = exposed(shape, truth, rng, phi=rng.uniform(0, 6), beam=400.0)
        paths = crests_of_frames(frame, paraxial_vector(truth))
        fit = fit_crests(paths, nominal, prior)
        points.append(errors(paths, truth) / paths.sigma)
        pulls.append((fit.geometry.vector() - truth.vector()) / fit.sigma)
    assert 0.95 < np.concatenate(points).std() < 1.05
    spread = np.std(pulls, axis=0)
    assert np.all((spread > 0.7) & (spread < 1.35)), spread
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 3.5 / np.sqrt(seeds))


def test_more_light_and_more_frames_give_smaller_errors() -> None:
    shape = (130, 150)
    truth = fibres(shape, 7.0)
    rng = np.random.default_rng(3)
    k = paraxial_vector(truth)

    def sigma(peak: float, frames: int) -> float:
        stack = np.stack([exposed(shape, truth, rng, phi, None, peak) for phi in range(frames)])
        return float(np.median(crests_of_frames(stack, k).sigma))

    one = sigma(50e3, 1)
    assert sigma(2e3, 1) / one == pytest.approx(np.sqrt(25 * (1 + 256 / 1e3)), rel=0.15)
    assert one / sigma(50e3, 9) == pytest.approx(3, rel=0.1)


def test_frames_keep_their_own_phase() -> None:
    shape = (130, 150)
    truth = fibres(shape, 7.0, 2.0, WIDE_PITCH)
    rng = np.random.default_rng(4)
    phi = np.array([0.3, 2.9, -1.0, 5.0])
    stack = np.stack([exposed(shape, truth, rng, p) for p in phi])
    stack[2] = 25e3  # without fringes: left out
    paths = crests_of_frames(stack, paraxial_vector(truth))
    assert np.isnan(paths.phi[2])
    away = np.angle(np.exp(1j * (paths.phi - (phi - phi[0]))))[[0, 1, 3]]
    assert np.abs(away).max() < 5 * paths.sigma.min()
    assert 0.8 < (errors(paths, truth) / paths.sigma).std() < 1.2


def test_bad_pixels_and_holes_do_no_harm() -> None:
    shape = (260, 290)
    truth = fibres(shape, 8.0, 0.5, WIDE_PITCH, (6.0, -4.0))
    rng = np.random.default_rng(6)
    frame = exposed(shape, truth, rng)
    bad = rng.random(shape) < 0.03
    bad[100:160, 90:190] = True
    frame[bad] = rng.choice([0.0, 9e5, np.nan], bad.sum())
    good = ~bad | (rng.random(shape) < 0.3) & np.isnan(frame)
    paths = crests_of_frames(frame, paraxial_vector(truth), good)
    pull = errors(paths, truth) / paths.sigma
    assert 0.8 < pull.std() < 1.2
    inside = (paths.y > 112) & (paths.y < 148) & (paths.x > 102) & (paths.x < 178)
    assert not inside.any()


@pytest.fixture(scope="module")
def seen() -> tuple[CrestPaths, Geometry]:
    """Points of a noisy frame that spans 2 degrees."""
    shape = (220, 250)
    truth = fibres(shape, 7.0, 0.3, WIDE_PITCH, (5.0, -3.0))
    frame = exposed(shape, truth, np.random.default_rng(8))
    return crests_of_frames(frame, paraxial_vector(truth)), truth


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("distance", [-10.0, 10.0])
@pytest.mark.parametrize("share", [-0.05, 0.05])
def test_every_start_ends_at_the_same_minimum(
    seen: tuple[CrestPaths, Geometry], sign: int, distance: float, share: float
) -> None:
    paths, truth = seen
    best = fit_freely(paths, truth)
    found = fit_freely(paths, misplaced(truth, distance, 18.0 * sign, share))
    assert np.abs(found.geometry.vector() - best.geometry.vector()).max() < 1e-4 * best.sigma.max()
    assert found.evaluations < 40


@pytest.mark.long
def test_the_cost_has_one_minimum(seen: tuple[CrestPaths, Geometry]) -> None:
    paths, truth = seen
    fit = fit_freely(paths, truth)
    length = float(np.hypot(fit.geometry.baseline_x, fit.geometry.baseline_y))
    steps = np.linspace(-1, 1, 9)
    distance = fit.geometry.distance + 12 * steps
    ratio, cost = valley(paths, fit, distance)
    assert falls_then_rises(cost)
    assert np.argmin(cost) == 4
    assert ratio[4] == pytest.approx(length / fit.geometry.distance, rel=1e-6)
    ratios = ratio[4] + 2 * np.ptp(ratio) * steps
    for refit in (False, True):
        flat = cost_map(paths, fit, distance, length * (1 + 0.05 * steps), ratio=False, refit=refit)
        turned = cost_map(paths, fit, distance, ratios, ratio=True, refit=refit)
        for found in (flat, turned):
            assert falls_then_rises(found)
            assert np.unravel_index(np.argmin(found), (9, 9)) == (4, 4)
            assert found.min() == pytest.approx(fit.used.sum(), rel=0.2)
    # What is fitted again can only lower the cost; at the minimum, not even that.
    held = cost_map(paths, fit, distance, ratios, ratio=True, refit=False)
    assert np.all(turned <= held * (1 + 1e-6))


def test_the_curvature_of_the_cost_is_the_error_of_the_distance() -> None:
    """Few points, so that the map is computed with all of them."""
    shape = (150, 170)
    truth = fibres(shape, 8.0, 0.3, WIDE_PITCH, (5.0, -3.0))
    paths = crests_of_frames(
        exposed(shape, truth, np.random.default_rng(9)), paraxial_vector(truth)
    )
    fit = fit_freely(paths, truth)
    away = 0.1 * fit.sigma[2] * np.array([-1.0, 0.0, 1.0])
    _, cost = valley(paths, fit, fit.geometry.distance + away)
    assert cost[[0, 2]].mean() - cost[1] == pytest.approx(0.1**2, rel=0.02)


@pytest.mark.parametrize(
    ("curve", "one"),
    [
        ([3, 2, 1, 2], True),
        ([1, 2, 3], True),
        ([3, 1, 2, 1, 3], False),
        ([[3, 1, 2], [2, 3, 1]], False),
        ([1.0, 1.0 + 1e-9, 1.0, 2.0], True),
    ],
)
def test_one_minimum_or_more(curve: Any, one: bool) -> None:
    assert falls_then_rises(np.array(curve, float)) is one


def test_outliers_are_left_out(seen: tuple[CrestPaths, Geometry]) -> None:
    paths, truth = seen
    wrong = np.arange(0, len(paths), 23)
    paths.k[wrong] += 2
    try:
        fit = fit_freely(paths, misplaced(truth, 3.0, 5.0, 0.01))
    finally:
        paths.k[wrong] -= 2
    assert np.array_equal(np.flatnonzero(~fit.used), wrong)
    assert np.abs((fit.geometry.vector() - truth.vector()) / fit.sigma).max() < 4


def test_what_is_held_stays_and_what_is_known_pulls(seen: tuple[CrestPaths, Geometry]) -> None:
    paths, truth = seen
    free = fit_freely(paths, truth)

    def with_sigma(sigma: list[float]) -> CrestFit:
        return fit_crests(paths, truth, np.array(sigma))

    inf = np.inf
    held = with_sigma([inf, inf, 0.0, inf, inf, 0.0])
    assert held.geometry.distance == truth.distance
    assert held.geometry.baseline_z == truth.baseline_z
    assert held.sigma[2] == held.sigma[5] == 0
    assert np.all(held.sigma[[0, 3, 4]] < free.sigma[[0, 3, 4]])
    known = with_sigma([inf, inf, free.sigma[2], inf, inf, inf])
    assert known.sigma[2] == pytest.approx(free.sigma[2] / np.sqrt(2), rel=0.05)


def test_the_outermost_paths_alone(seen: tuple[CrestPaths, Geometry]) -> None:
    paths, truth = seen
    few = paths.outermost(3)
    assert len(np.unique(few.k)) == 6
    assert few.k.min() == paths.k.min()
    assert few.k.max() == paths.k.max()
    fit = fit_crests(few, truth, prior_errors(truth))
    every = fit_crests(paths, truth, prior_errors(truth))
    assert np.all(fit.sigma >= every.sigma)
    assert np.abs((fit.geometry.vector() - truth.vector()) / fit.sigma).max() < 4


@pytest.mark.parametrize("tile", [(31, 37), (64, 64), (200, 7)])
def test_sums_do_not_depend_on_the_tiling(tile: tuple[int, int]) -> None:
    shape = (97, 131)
    truth = fibres(shape, 5.0, 0.6)
    frame = exposed(shape, truth, np.random.default_rng(1))
    good = np.ones(shape, bool)
    windows = Windows.lay(shape, paraxial_vector(truth))
    carrier = CrestCarrier.straight(paraxial_vector(truth), shape)
    sums = np.zeros((*windows.shape, N_SUMS))
    for y in range(0, shape[0], tile[0]):
        for x in range(0, shape[1], tile[1]):
            part = (slice(y, y + tile[0]), slice(x, x + tile[1]))
            (i, j), piece = tile_sums(frame[part], good[part], (y, x), windows, carrier)
            sums[i : i + piece.shape[0], j : j + piece.shape[1]] += piece
    whole = ArrayFrames(frame[None], good)(0, windows, carrier)
    assert sums[..., -1].sum() == frame.size
    assert sums == pytest.approx(whole, rel=1e-12, abs=1e-6)


@pytest.mark.parametrize(
    ("make", "names"),
    [
        (lambda s, g, r: r.poisson(25e3, s) + 0.0, "no fringes"),
        (lambda s, g, r: np.zeros(s), "dark"),
        (lambda s, g, r: np.full(s, np.nan), "too few good samples"),
        # Fringes only where the vector is sought: a fifth of the frame, and noise elsewhere.
        (
            lambda s, g, r: np.where(
                np.abs(np.arange(s[1]) - 70) < 14, exposed(s, g, r), r.normal(25e3, 1e5, s)
            ),
            "fringes found in only 1 of 48 windows",
        ),
    ],
)
def test_frames_without_fringes_are_refused(
    make: Callable[[tuple[int, int], Geometry, np.random.Generator], F64], names: str
) -> None:
    shape = (120, 140)
    truth = fibres(shape, 9.0)
    with pytest.raises(InputError, match=names) as caught:
        crests_of_frames(make(shape, truth, np.random.default_rng(7)), paraxial_vector(truth))
    assert "\n" not in str(caught.value)


def test_too_few_fringes_are_counted() -> None:
    shape = (120, 140)
    truth = fibres(shape, 40.0)
    with pytest.raises(InputError, match=r"too few fringes: 3\.5 across 140 x 120 px"):
        crests_of_frames(exposed(shape, truth), paraxial_vector(truth))


def test_too_few_paths_for_the_geometry(seen: tuple[CrestPaths, Geometry]) -> None:
    paths, truth = seen
    with pytest.raises(InputError, match=r"too few fringes: .* on 1 crests"):
        fit_freely(paths.take(paths.k == paths.k[0]), truth)
