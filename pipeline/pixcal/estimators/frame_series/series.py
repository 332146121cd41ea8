"""Series of a fringe set's frames: their light, their fringe vector.

All pixels of a frame share the bench, but not the noise of the samples. Half the difference of two
halves of the pixels therefore contains only noise, whatever its origin. It is fitted together with
the series, so no noise model is needed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from pixcal.estimators.diagnosis.evidence import FringeEvidence
from pixcal.estimators.frame_series.variance_components import (
    Modes,
    WalkModes,
    estimate_components,
    walk_modes,
)
from pixcal.kernels.frame_order import with_neighbours
from pixcal.model.arrays import F64, Indices, Mask

FEWEST = 32  # fewest frames of a set
HARMONICS = 10  # of the phase, that are no noise
SPENT = 0.25  # share of the degrees of freedom that shapes which follow the phase may use
SLOW = 12  # walk modes that are drift
# modes whose median power is the level of the central one; median of chi-square
AROUND, MEDIAN = 15, 0.455
OUTLIER = 9.0  # power over the level from which a mode counts less
DARK = 0.05  # share of the mean light below which a frame is not used
MIN_NOISE = 0.05  # lowest size of the noise, over the prediction
BELOW = 0.15  # how negative a size may be, over the noise


TimedValues = tuple[str, F64, F64]
"""Fringe set or e.g. ``bias frames``; times (t,) from its first frame, s; offsets (t,), e-."""


@dataclass(frozen=True)
class FrameSeries:
    """Two quantities of every usable frame of a set."""

    name: str  # of the set
    k: tuple[float, float]  # fringe vector (kx, ky), rad/px
    frame: Indices  # (t,) numbers of the frames in their set
    time_s: F64  # (t,)
    exptime_s: float  # nan when unknown
    # values, apart: (t, 2) the quantities, and half their difference between two halves of the
    # pixels
    values: F64
    apart: F64
    shapes: F64  # (t, p) functions of the fringe phase, which are no noise
    # noise, apart_noise: (2, 2) their covariance from the noise model, mean over frames
    noise: F64
    apart_noise: F64
    share: float = 1.0  # of the frames' degrees of freedom that remain

    def __len__(self) -> int:
        return len(self.values)

    @property
    def step_s(self) -> float:
        """Mean time from a frame to the next one."""
        return float(np.ptp(self.time_s)) / max(int(np.ptp(self.frame)), 1) or 1.0

    @property
    def walk_modes(self) -> WalkModes:
        """Modes in which noise and walks are independent."""
        return walk_modes(self.time_s)

    def cleaned(self) -> "FrameSeries":
        """The series without its shapes."""
        if not self.shapes.size:
            return self
        rest = without(np.hstack([self.values, self.apart]), self.shapes, self.walk_modes)
        return replace(
            self,
            values=rest[:, :2],
            apart=rest[:, 2:],
            shapes=self.shapes[:, :0],
            share=self.share * (1 - np.linalg.matrix_rank(self.shapes) / len(self)),
        )


def motion_series(fringes: FringeEvidence, *, every: bool = False) -> FrameSeries | None:
    """Change (x, y) of the fringe vector, rad/px; ``every``: also of frames without neighbours."""
    slopes = np.eye(5)[3:]
    return _series(
        fringes,
        lambda free: free[:, 3:5],
        lambda free: np.broadcast_to(slopes, (len(free), 2, 5)),
        every=every,
    )


def light_series(fringes: FringeEvidence) -> FrameSeries | None:
    """B over its mean less one, and the logarithm of A/B; None with too few usable frames."""

    def values(free: F64) -> F64:
        b, a = free[:, 0], np.hypot(free[:, 1], free[:, 2])
        return np.stack([b / mean - 1, np.log(np.maximum(a / b, 1e-6))], axis=1)

    def slopes(free: F64) -> F64:
        jacobian = np.zeros((len(free), 2, 5))
        square = free[:, 1] ** 2 + free[:, 2] ** 2
        jacobian[:, 0, 0] = 1 / mean
        jacobian[:, 1, 0] = -1 / free[:, 0]
        jacobian[:, 1, 1:3] = free[:, 1:3] / square[:, None]
        return jacobian

    mean = float(fringes.free[_lit(fringes), 0].mean()) if _lit(fringes).any() else 1.0
    return _series(fringes, values, slopes)


def _lit(fringes: FringeEvidence) -> Mask:
    """Frames with light, fringes and samples in both halves of the pixels."""
    usable = np.ones(len(fringes.free), bool)
    for free, covariance in ((fringes.free, fringes.free_covariance), *fringes.halves):
        known = np.einsum("tii->ti", covariance)[:, :3] > 0
        usable &= np.isfinite(free).all(axis=1) & known.all(axis=1)
        b, a = free[:, 0], np.hypot(free[:, 1], free[:, 2])
        usable &= (b > DARK * np.median(b)) & (a > DARK * np.median(a))
    return usable


def _series(
    fringes: FringeEvidence,
    values: Callable[[F64], F64],
    slopes: Callable[[F64], F64],
    *,
    every: bool = False,
) -> FrameSeries | None:
    use = _lit(fringes)
    if use.sum() < FEWEST:
        return None
    taken, noises = [], []
    for free, covariance in ((fringes.free, fringes.free_covariance), *fringes.halves):
        jacobian = slopes(free[use])
        taken.append(values(free[use]))
        noises.append(np.einsum("tai,tij,tbj->ab", jacobian, covariance[use], jacobian) / use.sum())
    # A window of one row does not constrain ky.
    if min(np.diag(noise).min() for noise in noises) <= 0:
        return None
    frame, time = fringes.frame[use], fringes.time_s[use]
    phase = np.arctan2(fringes.free[use, 2], fringes.free[use, 1])
    # Effects of neighbouring frames are measured in frames that have both.
    inside = np.arange(len(frame)) if every else with_neighbours(frame)
    if len(inside) < FEWEST // 2:
        return None
    shapes = np.zeros((len(inside), 0))
    if not every:
        shapes = _follows_phase(phase, inside, walk_modes(time[inside]))
    return FrameSeries(
        name=fringes.name,
        k=fringes.k,
        frame=frame[inside],
        time_s=time[inside],
        exptime_s=fringes.exptime_s,
        values=taken[0][inside],
        apart=((taken[1] - taken[2]) / 2)[inside],
        shapes=shapes,
        noise=noises[0],
        apart_noise=(noises[1] + noises[2]) / 4,
    )


def without(values: F64, shapes: F64, basis: WalkModes) -> F64:
    """Series (t, c) without shapes (t, p) and mean, by weighted least squares of their modes."""
    # A mode's weight is the inverse of the power around it: drifts and lines are no shapes. The
    # noise that the shapes absorb is restored in each mode.
    modes, design = basis.of(values), basis.of(shapes)
    rest = np.empty_like(modes)
    for channel, wanted in enumerate(modes.T):
        own = wanted
        for _ in range(2):
            power = own**2
            around = median_filter(power, AROUND, mode="reflect") / MEDIAN
            root = 1 / np.sqrt(np.maximum(np.maximum(around, power / OUTLIER), 1e-300))
            left, size, _ = np.linalg.svd(design * root[:, None], full_matrices=False)
            left = left[:, size > 1e-6 * size.max(initial=1e-300)]
            own = wanted - left @ (left.T @ (wanted * root)) / root
        kept = 1 - np.einsum("kp,kp->k", left, left)
        rest[:, channel] = own / np.sqrt(np.maximum(kept, 0.1))
    return basis.series(rest)


def _follows_phase(phase: F64, inside: Indices, basis: WalkModes) -> F64:
    """Shapes (n, p) of n frames inside, functions of phases (t,) and steps; likeliest first."""
    here = phase[inside]
    steps = phase[inside - 1] - here, phase[inside + 1] - here
    angles = [here, 2 * here, *steps, 3 * here, 4 * here]
    for order in range(1, HARMONICS + 1):
        angles += [(order + 4) * here] * (order + 4 <= HARMONICS)
        angles += [step + turns * here for step in steps for turns in (order, -order)]
    angles = angles[: max(1, int(len(here) * SPENT / 2))]
    shapes = np.stack([turn(angle) for angle in angles for turn in (np.cos, np.sin)], axis=1)
    power = basis.of(shapes) ** 2
    fast = power[SLOW:].sum(axis=0) > np.maximum(power.sum(axis=0) / 2, 1e-9)
    return np.asarray(shapes[:, fast])


def assemble(
    every: Sequence[FrameSeries],
    parts: Callable[[FrameSeries], F64],
    known: Callable[[FrameSeries], F64] | None = None,
) -> Modes:
    """Series of all sets, with their noise, for `estimate_components`.

    ``parts``: of a series, covariance (m, t - 1, 2, 2) of its modes for unit sizes, common to all
    sets; three of each set's noise follow. ``known``: shapes (t, 2, q), whose coefficients come
    first.
    """
    shared = [np.asarray(parts(s)) for s in every]
    shapes = [np.zeros((len(s), 2, 0)) if known is None else known(s) for s in every]
    m, q = len(shared[0]), shapes[0].shape[2]
    values, designs, covariances = [], [], []
    least = np.full(m, -np.inf)
    for i, s in enumerate(every):
        n = len(s) - 1
        design = np.zeros((2 * n, 2, q))
        basis = s.walk_modes
        design[:n] = basis.of(shapes[i])
        covariance = np.zeros((m + 3 * len(every), 2 * n, 2, 2))
        covariance[:m, :n] = shared[i]
        for half, noise in ((slice(n), s.noise), (slice(n, 2 * n), s.apart_noise)):
            covariance[m + 3 * i : m + 3 * i + 3, half] = _noise_parts(noise)[:, None]
        values.append(np.concatenate([basis.of(s.values), basis.of(s.apart)]))
        designs.append(design)
        covariances.append(covariance)
        share = np.einsum("ab,inba->in", np.linalg.inv(s.noise), shared[i]).max(axis=1)
        least = np.maximum(least, -BELOW / np.maximum(share, 1e-300))
    stacked = np.concatenate(covariances, axis=1)
    of_noise = np.tile([MIN_NOISE, -np.inf, MIN_NOISE], len(every))
    return Modes(
        values=np.concatenate(values),
        known=np.concatenate(designs),
        parts=stacked,
        start=np.concatenate([np.zeros(m), np.ones(3 * len(every))]),
        least=np.concatenate([least, of_noise]),
        share=float(np.average([s.share for s in every], weights=[len(s) for s in every])),
    )


def mode_variance(series: FrameSeries, parts: F64) -> F64:
    """Variance (t - 1, 2) of a series' modes, for fitted noise and parts (m, t - 1, 2, 2)."""
    modes = assemble([series], lambda _: parts)
    size = np.maximum(estimate_components(modes).size, 0.0)
    # The first half of the modes are those of the series, the others of its two halves.
    covariance = np.einsum("i,inab->nab", size, modes.parts)[: len(series) - 1]
    return np.asarray(np.einsum("naa->na", covariance))


def _noise_parts(noise: F64) -> F64:
    """Covariance of two channels as three parts of unit size: one, both, the other."""
    parts = np.zeros((3, 2, 2))
    parts[0, 0, 0], parts[2, 1, 1] = noise[0, 0], noise[1, 1]
    parts[1, 0, 1] = parts[1, 1, 0] = noise[0, 1]
    return parts


def wiener(parts: F64, wanted: F64, values: F64) -> F64:
    """Modes (n,) of a quantity whose covariance with the values (n, c) is ``wanted`` (n, c)."""
    weight = np.linalg.solve(parts.sum(axis=0), wanted[..., None])[..., 0]
    return np.asarray(np.einsum("nc,nc->n", weight, values))
