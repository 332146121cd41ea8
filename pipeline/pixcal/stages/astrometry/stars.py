"""The telescope and its stars, each observed and fitted at several dithered positions."""

import math
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.star_centroids import Star
from pixcal.kernels.psf import Psf, diffraction_psf
from pixcal.model.acquisition import Detector as Declared
from pixcal.model.arrays import F64
from pixcal.model.errors import InputError
from pixcal.stages.astrometry.detector import PixelPositions, generator

FULL_WELL_E = 50_000.0  # where the acquisition declares none (paper, table 1)
WINDOW = 4.0  # half of the default window, in lambda / D: three dark rings
SAMPLINGS = (0.4, 40.0)  # pixels in lambda / D that the table of the pattern is made for
BATCH = 16  # stars of a task
# a place is not used where masked pixels would tell more than so much of the position
MAX_LOST = 0.1
# errors of a star at a place: pixels taken for a perfect grid, or where the maps say; without and
# with photon noise; and the first two as `centroids.Star.weights` predicts them
KINDS = ("perfect", "measured", "perfect_photons", "measured_photons", "linear", "linear_measured")


@dataclass(frozen=True)
class Telescope:
    """A telescope and its detector's pixels."""

    diameter_m: float
    focal_length_m: float
    wavelength_nm: float
    obscuration: float
    pitch_um: float

    def __post_init__(self) -> None:
        low, high = SAMPLINGS
        if not low <= self.sampling <= high:
            raise InputError(
                f"--focal-length, --wavelength, --diameter: {self.sampling:.3g} px per "
                f"lambda/D, not from {low:g} to {high:g}; change one of them"
            )

    @property
    def sampling(self) -> float:
        """Pixels in lambda / D; Nyquist's limit is 2."""
        image = self.wavelength_nm * 1e-3 * self.focal_length_m / self.diameter_m
        return image / self.pitch_um

    @property
    def uas_per_px(self) -> float:
        """Plate scale, µas."""
        return self.pitch_um * 1e-6 / self.focal_length_m * 180 / np.pi * 3600e6

    def psf(self, window: int | None) -> tuple[Psf, int]:
        """The pattern in its pixels, and half of the window's side, px."""
        half = max(2, math.ceil(WINDOW * self.sampling)) if window is None else window // 2
        return diffraction_psf(self.sampling, self.obscuration, half), half

    def facts(self) -> dict[str, float]:
        """For the JSON."""
        return asdict(self) | {"uas_per_px": self.uas_per_px, "px_per_lambda_over_d": self.sampling}


def exposures(psf: Psf, electrons: float, detector: Declared) -> int:
    """Number of exposures of a star such that no pixel saturates."""
    return max(1, math.ceil(electrons * psf.peak / (detector.full_well_e or FULL_WELL_E)))


def star(psf: Psf, half: int, electrons: float, background: float, detector: Declared) -> Star:
    """A star with the given electrons over all exposures, each with its read noise."""
    read_variance = exposures(psf, electrons, detector) * detector.read_noise_e**2
    return Star(psf, half, electrons, background, read_variance)


@dataclass(frozen=True)
class Observation:
    """What is observed."""

    star: Star
    stars: int
    positions: int  # places of each star
    dither: float  # they lie within so many px of the first, along x and y


def observe(detector: PixelPositions, plan: Observation, runtime: Runtime) -> F64:
    """Observe and fit stars all over the detector: errors (star, position, kind, component), px.

    NaN at places that are not used, and where a fit has failed.
    """
    batches = [range(n, min(n + BATCH, plan.stars)) for n in range(0, plan.stars, BATCH)]
    core = core_weights(plan.star, detector.axes)
    task = partial(_batch, detector, plan, core)
    return np.concatenate(run_tasks(task, batches, runtime, label="stars"))


def core_weights(star: Star, axes: F64) -> F64:
    """Weight of each pixel in the centroid of a centred star, (component, y, x), sum 1."""
    weights = -star.weights(np.zeros(2))
    return np.asarray(np.einsum("ka,abyx,kb->kyx", axes, weights, axes))


def _batch(detector: PixelPositions, plan: Observation, core: F64, stars: range) -> F64:
    return np.stack([observe_star(detector, plan, core, n) for n in stars])


def observe_star(detector: PixelPositions, plan: Observation, core: F64, number: int) -> F64:
    """Errors (position, kind, component) of one star, px; ``core`` is that of `core_weights`."""
    star, half, axes = plan.star, plan.star.half, detector.axes
    rng = generator(detector.seed, 2, number)
    # The whole window lies on the detector.
    first = np.full(2, half - 0.5)
    last = np.array(detector.shape[::-1]) - half - 0.5
    middle = rng.uniform(first, last)
    low, high = np.maximum(first, middle - plan.dither), np.minimum(last, middle + plan.dither)
    at = rng.uniform(low, high, (plan.positions, 2))
    at[0] = middle
    pixel = np.floor(at + 0.5).astype(int)
    corner, end = pixel.min(axis=0) - half, pixel.max(axis=0) + half + 1
    patch = detector.patch((corner[1], end[1]), (corner[0], end[0]))
    cuts = [np.s_[..., y : y + star.side, x : x + star.side] for x, y in (pixel - half - corner)]
    good = np.stack([patch.good[cut] for cut in cuts])
    # Displacements (position, (x, y), y, x): the true ones, and what the maps say.
    true, known = (
        np.einsum("nkyx,ka->nayx", np.stack([offsets[cut] for cut in cuts]), axes)
        for offsets in (patch.true, patch.known)
    )
    place = at - pixel
    mean = star.expected(place, true)
    noise = np.sqrt(star.read_variance) * rng.standard_normal(mean.shape)
    noisy = rng.poisson(np.maximum(mean, 0.0)) + noise
    errors = [
        star.fit(data, grid, good)[:, :2] - place
        for data in (mean, noisy)
        for grid in (np.zeros_like(known), known)
    ]
    weights = np.stack([star.weights(p, g) for p, g in zip(place, good, strict=True)])
    errors += [np.einsum("nabyx,nbyx->na", weights, moved) for moved in (true, true - known)]
    along = np.einsum("jna,ka->njk", np.stack(errors), axes)
    along[(np.einsum("kyx,nyx->nk", core, ~good) > MAX_LOST).any(axis=1)] = np.nan
    return np.asarray(along)
