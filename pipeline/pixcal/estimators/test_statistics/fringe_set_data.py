"""One fringe set as input of statistics: residuals in units of their noise, maps, frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.maps.map_fit import MIN_APART
from pixcal.estimators.maps.structure import (
    fit_terms,
    flattened,
    orders,
    smooth_surface,
    stitched_fields,
    without_outliers,
)
from pixcal.kernels import sample_sums
from pixcal.model.arrays import C128, F32, F64, Indices, Mask

OUTLIER_SIGMA = 8.0  # standard deviations beyond which a residual counts only as an outlier
OUTLIERS = (5.0, 7.0, 10.0)  # standard deviations beyond which residuals are counted
HARMONICS = (2, 3, 4)  # orders that are looked for


@dataclass(frozen=True)
class FringeSetData:
    """A fringe set of the evidence, and quantities that several statistics need."""

    fringes: FringeEvidence
    evidence: Evidence

    @property
    def good(self) -> Mask:
        """Pixels (y, x) used."""
        return self.fringes.good

    @cached_property
    def _calm(self) -> tuple[F32, F32, F64, F64]:
        fringes, maps = self.fringes, (self.fringes.shot_factor, self.fringes.read_variance)
        shot, read = (noise.astype(np.float32) for noise in maps)
        limits = np.array(OUTLIERS)
        return sample_sums.clipped_residuals(
            fringes.electrons, fringes.model, shot, read, self.good, OUTLIER_SIGMA, limits
        )

    @property
    def residual(self) -> F32:
        """Residuals (t, y, x) over their noise; zero for outliers and where there is no weight."""
        return self._calm[0]

    @property
    def electrons(self) -> F32:
        """The same residuals, e-, as (t, pixel) of all pixels."""
        return self._calm[1].reshape(len(self.residual), -1)

    @cached_property
    def harmonics(self) -> tuple[Indices, C128]:
        """Orders, and harmonics (order, pixel) of the residuals of good pixels over the amplitude.

        Only those that the phases of the frames separate from the fringes. Four phases to a turn,
        for instance, show no third or fourth harmonic: the fit absorbs them.
        """
        fringes, good = self.fringes, self.good
        _, sine, cosine = (part[good] for part in fringes.theta)
        amplitude = np.hypot(sine, cosine)
        every = np.exp(-1j * np.outer(HARMONICS, fringes.phi))
        fitted = [np.ones(len(fringes.phi)), np.sin(fringes.phi), np.cos(fringes.phi)]
        axes = np.linalg.qr(np.stack(fitted, axis=1))[0]
        apart = np.mean(np.abs(every - every @ axes @ axes.T) ** 2, axis=1) > MIN_APART
        orders, turns = np.array(HARMONICS)[apart], every[apart].astype(np.complex64)
        moments = turns.real @ self.electrons + 1j * (turns.imag @ self.electrons)
        # The signal goes with sin(phi + psi).
        unit = (cosine - 1j * sine) / np.maximum(amplitude, 1e-300)
        turned = moments[:, good.ravel()] * np.cumprod([unit] * max(HARMONICS), axis=0)[orders - 1]
        alpha = float(np.median(amplitude))
        return orders, np.asarray(2 * turned / len(fringes.phi) / alpha)

    @property
    def variance(self) -> F64:
        """Mean variance (t,) of the good samples of each frame, e-², from the noise model."""
        return self._calm[2]

    @property
    def outliers(self) -> F64:
        """How many residuals (2, n) are below and above `OUTLIERS`, sigmas."""
        return self._calm[3]

    @cached_property
    def theta(self) -> F32:
        """Maps (3, pixel) of the fit for all pixels; zero in those that are not good."""
        theta = np.where(self.good, self.fringes.theta, 0).astype(np.float32)
        return np.asarray(theta.reshape(3, -1))

    @cached_property
    def by_level(self) -> tuple[F64, F64]:
        """Mean residual (e-) and mean square over the noise, in bins of the level (bin,)."""
        model = self.fringes.model
        some = model[:: max(1, len(model) // 40), self.good][:, ::SPARSE]
        low, high = (float(level) for level in np.quantile(some, (0.005, 0.995)))
        sums = np.zeros((LEVELS, 3))
        step = max(high - low, 1e-9) / LEVELS
        sample_sums.level_sums(model, self.good, low, step, self._calm[1], self.residual, sums)
        count, total, squares = sums.T
        return total / np.maximum(count, 1), squares / np.maximum(count, 1)

    @cached_property
    def moments(self) -> tuple[F64, F64]:
        """Mean square and mean fourth power (y, x) of the residuals over their noise."""
        second, fourth = sample_sums.pixel_moments(self.residual)
        return second, fourth

    @property
    def thinned(self) -> int:
        """Interval of frames for statistics of pairs of pixels."""
        return max(1, len(self.residual) // MAX_FRAMES)

    @cached_property
    def neighbours(self) -> tuple[F64, F64]:
        """Products of residuals over their noise and those of neighbours (`neighbour_sums`)."""
        return neighbour_sums(self.residual, self.good, STEPS, self.thinned)

    @cached_property
    def remainders(self) -> Indices | None:
        """How often codes of good pixels have each remainder mod `CODES`; None for real numbers."""
        codes: NDArray[Any] = self.fringes.adu
        if codes.dtype.kind not in "iu":
            return None
        every = max(1, len(codes) // 100)
        count: Indices = sample_sums.count_remainders(codes[::every], self.good, CODES)
        return count

    @cached_property
    def psi(self) -> F64:
        """Phase (y, x) of the pixels, rad."""
        return np.asarray(np.arctan2(self.fringes.theta[1], self.fringes.theta[2]))

    @cached_property
    def maps(self) -> dict[str, F64]:
        """Offset (px), relative contrast and light (y, x), about zero; NaN if bad or at an edge."""
        theta, good = self.fringes.theta, np.zeros_like(self.good)
        inside = (slice(EDGE, -EDGE), slice(EDGE, -EDGE))
        good[inside] = self.good[inside]
        iota = np.where(good, theta[0], np.nan)
        contrast = np.where(good, np.hypot(theta[1], theta[2]), np.nan) / iota
        light = iota / smooth_surface(iota, good)
        return {
            "offset": without_outliers(np.where(good, self.fringes.delta, np.nan)),
            "contrast": without_outliers(contrast / np.nanmedian(contrast) - 1),
            "light": without_outliers(light - 1),
        }

    @cached_property
    def stitched(self) -> Indices:
        """Fields (y, x) of the foundry's stitching, from the offsets."""
        return stitched_fields([self.maps["offset"]], [self.fringe_terms])

    @cached_property
    def flat_maps(self) -> dict[str, F64]:
        """The maps less their smooth surfaces."""
        return {name: flattened(values) for name, values in self.maps.items()}

    @cached_property
    def fringe_terms(self) -> F64:
        """First and second harmonic of the fringes (term, y, x): cosine and sine of each."""
        psi = self.psi
        return np.stack([np.cos(psi), np.sin(psi), np.cos(2 * psi), np.sin(2 * psi)])

    @cached_property
    def maps_without_fringes(self) -> dict[str, F64]:
        """The flat maps less fringes, whose power varies widely with errors of four phases."""
        return {
            name: values - np.tensordot(fit_terms(values, self.fringe_terms), self.fringe_terms, 1)
            for name, values in self.flat_maps.items()
        }

    @cached_property
    def pattern_sizes(self) -> F64:
        """Sizes (t, pattern) of smooth patterns in the residuals (`pattern_sizes`)."""
        return pattern_sizes(self.residual, self.good)

    @cached_property
    def frames(self) -> dict[str, F64]:
        """Per frame (t,): relative intensity and contrast; phase along and across, rad."""
        b, a_cos, a_sin, dkx, dky = self.fringes.free.T
        contrast = np.hypot(a_cos, a_sin) / b
        ny, nx = self.good.shape
        kx, ky = self.fringes.k
        size = float(np.hypot(kx, ky))
        span = float(np.hypot(kx * nx, ky * ny)) / size
        return {
            "intensity": b / b.mean() - 1,
            "contrast": contrast / contrast.mean() - 1,
            "turn_along": (kx * dkx + ky * dky) / size * span,
            "turn_across": (kx * dky - ky * dkx) / size * span,
        }


EDGE = 2  # pixels along the edges of the window that maps leave out
LEVELS = 8  # bins of level
CODES = 64  # modulus of the codes' remainders, a power of two
CELLS = 4  # cells of the window along each side
# rows and columns to a neighbour
STEPS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (0, 3), (3, 0), (0, 4), (4, 0))
ADJACENT = 4  # of these, to pixels that touch
MAX_FRAMES = 300  # frames for statistics of pairs of pixels
PATTERN_DEGREE = 3  # of the Legendre polynomials that smooth patterns are made of
SPARSE = 7  # interval of pixels for the range of levels


def neighbour_sums(
    values: F32, good: Mask, steps: Sequence[tuple[int, int]], every: int = 1
) -> tuple[F64, F64]:
    """Sums (step, y) of products of samples (t, y, x) with good neighbours, and how many."""
    pairs, count = _pairs(good, steps)
    sums = sample_sums.neighbour_products(values, pairs, np.array(steps), every)
    return sums, count * len(range(0, len(values), every))


def neighbour_sums_by_level(
    values: F32, level: F32, good: Mask, steps: Sequence[tuple[int, int]], every: int = 1
) -> tuple[F64, F64]:
    """The same, (2, step, y), of products of samples above the median level, and of those below."""
    pairs, count = _pairs(good, steps)
    middle = float(np.median(level[:: 4 * every, good][:, ::SPARSE]))
    sums = sample_sums.products_by_level(
        values, level, np.float32(middle), pairs, np.array(steps), every
    )
    return sums, count * len(range(0, len(values), every))


def _pairs(good: Mask, steps: Sequence[tuple[int, int]]) -> tuple[F32, F64]:
    """Pairs of good pixels (step, y, x), by the place of the first, and their number (step, y)."""
    ny, nx = good.shape
    pairs = np.zeros((len(steps), ny, nx), np.float32)
    for pair, (dy, dx) in zip(pairs, steps, strict=True):
        here = (slice(0, ny - dy), slice(max(0, -dx), nx - max(0, dx)))
        there = (slice(dy, ny), slice(max(0, dx), nx + min(0, dx)))
        pair[: ny - dy, : nx - abs(dx)] = good[here] & good[there]
    return pairs, pairs.sum(axis=2, dtype=float)


def by_cell(values: F64, good: Mask) -> F64:
    """Means (cell,) of the good pixels of each cell; empty where a cell has too few."""
    ny, nx = good.shape
    row = np.arange(ny)[:, None] * CELLS // ny
    cell = row * CELLS + np.arange(nx)[None, :] * CELLS // nx
    count = np.bincount(cell[good], minlength=CELLS**2)
    if count.min() < 8:
        return np.zeros(0)
    return np.asarray(np.bincount(cell[good], values[good], minlength=CELLS**2) / count)


def pattern_sizes(noise: F32, good: Mask) -> F64:
    """Sizes (t, pattern) of smooth patterns in frames (t, y, x), independent for white noise."""
    y, x = (legvander(np.linspace(-1, 1, n), PATTERN_DEGREE) for n in good.shape)
    i, j = np.array(orders(PATTERN_DEGREE)).T
    # Along rows, then along columns: whole terms would take ten times as long for large frames. The
    # first is the level. What makes them orthonormal is found from their products.
    along = good @ np.einsum("xj,xl->xjl", x, x).reshape(len(x), -1)
    gram = np.einsum("yi,yk,yjl->ijkl", y, y, along.reshape(len(y), *x.shape[1:] * 2))
    gram = gram[i[:, None], j[:, None], i, j]
    root = np.linalg.cholesky(gram + 1e-12 * np.trace(gram) * np.eye(len(gram)))
    rows = (noise if good.all() else noise * good) @ x.astype(np.float32)
    products = np.einsum("yi,tyj->tij", y, rows)[:, i, j]
    sizes = np.linalg.solve(root, products.T.astype(float)).T[:, 1:]
    return np.asarray(sizes - sizes.mean(axis=0))
