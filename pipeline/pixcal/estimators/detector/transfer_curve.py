"""Photon transfer of flats, level by level, over that of the gain used.

Noise that neighbours share counts with that of the pixels themselves: crosstalk and brighter-fatter
move it from one to the other and leave the sum, as far as `STEPS` reach.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.diagnosis.evidence import Evidence, Stack
from pixcal.model.arrays import F32, F64, Indices, Mask

# rows and columns from a pixel to itself and to those that it may share its noise with
STEPS = np.array([(0, 0), (0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)])
# error of a share of the variance that is left however many samples there are: no owner knows the
# gain of a detector better than this, and amplifiers differ by as much
FLOOR = 5e-3
MIN_PIXELS = 200  # fewest pixels that tell a noise

_CLIP = 6.0
_MIN_LEVELS = 3
_ALIKE = 1e4
_READ_KNOWN = 0.3  # relative error of the read noise's variance as it was used


@dataclass(frozen=True)
class TransferCurve:
    """Photon transfer of flats over that of the gain used, as a line over the level."""

    share: float  # share, error: at level zero
    error: float
    slope: float  # slope, slope_error: change up to the top
    slope_error: float
    top: float  # highest level, e-
    levels: F64  # levels, shares, errors: (n,) of each level (e-)
    shares: F64
    errors: F64


def transfer_curve(evidence: Evidence) -> TransferCurve | None:
    """Photon transfer of each level of flats; None with fewer than three levels."""
    return evidence.once("transfer curve", make=lambda: _transfer_curve(evidence))


def _transfer_curve(evidence: Evidence) -> TransferCurve | None:
    without = (s for s in evidence.stacks if s.kind != "flat" and _is_enough(s))
    darks = [sums for s in without if (sums := _of_stack(s, evidence)) is not None]
    points = []
    for stack in filter(_is_enough, evidence.ladder):
        sums = _of_stack(stack, evidence)
        share = None if sums is None else shot_share([sums, *darks], shared_steps(evidence))
        level = float((stack.adu.mean(axis=0) - evidence.bias)[evidence.good].mean())
        if share is not None and level > 0:
            points.append((level * evidence.gain, *share))
    if len(points) < _MIN_LEVELS:
        return None
    level, share, error = np.array(points).T
    top = float(level.max())
    design = np.stack([np.ones_like(level), level / top]) / error
    normal = design @ design.T
    if np.linalg.cond(normal) > _ALIKE:
        return None
    covariance = np.linalg.inv(normal)
    found = covariance @ (design @ (share / error))
    errors = np.sqrt(np.diag(covariance))
    at_zero, rise = zip(found.tolist(), errors.tolist(), strict=True)
    return TransferCurve(*at_zero, *rise, top, level, share, error)


def shared_steps(evidence: Evidence) -> Mask:
    """Which of `STEPS` count: where flats told the gain, only those found to share noise.

    The others would add nothing but their own noise.
    """
    if np.isnan(evidence.photon_transfer[0]):
        return np.ones(len(STEPS), np.bool_)
    counted = {(0, 0), *evidence.neighbours, *((-y, -x) for y, x in evidence.neighbours)}
    return np.array([(int(y), int(x)) in counted for y, x in STEPS])


def shot_share(sums: Iterable[F64], counted: Mask | None = None) -> tuple[float, float] | None:
    """Noise that grows with the level over that expected, with its error; None without samples.

    ``counted`` tells which of `STEPS` to add to the first, all by default.
    """
    total = sum(sums, np.zeros((len(STEPS), 7)))
    if not total[0, 0]:
        return None
    share = variance = 0.0
    for number, (n, s11, s12, s22, p1, p2, square) in enumerate(total):
        own = number == 0
        if counted is not None and not counted[number]:
            continue
        normal, right = np.array([[s11, s12], [s12, s22]]), np.array([p1, p2])
        scatter = square / n - own
        known = scatter / _READ_KNOWN**2
        normal[1, 1] += known
        right[1] += known * own
        inverse = np.linalg.inv(normal)
        times = 1 if own else 2
        share += times * (inverse @ right)[0]
        variance += times**2 * scatter * inverse[0, 0]
    if share <= 0.1 or not np.isfinite(variance):
        return None
    return float(share), float(np.sqrt(variance + FLOOR**2))


def sums_of_stacks(evidence: Evidence) -> Iterable[F64]:
    """The same of flats, and of frames without light, which tell the noise at no level."""
    if any(s.kind == "flat" and _is_enough(s) for s in evidence.stacks):
        for stack in filter(_is_enough, evidence.stacks):
            sums = _of_stack(stack, evidence)
            if sums is not None:
                yield sums


def _is_enough(stack: Stack) -> bool:
    return len(stack.adu) >= 2


def _of_stack(stack: Stack, evidence: Evidence) -> F64 | None:
    good = evidence.good & (stack.adu < evidence.saturation_adu).all(axis=0)
    pixels = np.count_nonzero(good)
    if pixels < MIN_PIXELS:
        return None
    frames = (stack.adu - evidence.bias.astype(np.float32)) * np.float32(evidence.gain)
    level = frames.mean(axis=0)
    # What a frame has more: of light, or of bias. Pixels' own levels are too noisy to say how much
    # noise to expect: that would come out too small a share of it.
    pattern = evidence.flat if stack.kind == "flat" else np.ones(level.shape)
    pattern = np.where(good, pattern, 0).astype(np.float32)
    usual = pattern * max(float(level[good].mean() / pattern[good].mean()), 0.0)
    noise = usual + np.float32(evidence.read_noise**2)
    more = (frames - level) * (pattern / noise)
    change = more[:, good].sum(axis=1) / (pattern**2 / noise).sum()
    brighter = change[:, None, None] * pattern
    ones = np.ones(level.shape)
    return residual_sums(
        frames - level - brighter, usual + brighter, ones, evidence.read_noise**2 * ones, good,
        np.ones((len(frames), 1)), (noise / len(frames))[None], np.full(len(STEPS), 1 / pixels),
    )  # fmt: skip


def residual_sums(
    rest: F32, model: F32, shot_factor: F64, read: F64,
    good: Mask, of_time: NDArray[np.floating], of_pixels: NDArray[np.floating],
    taken: F64, steps: Indices = STEPS, limit: float = _CLIP,
) -> F64:  # fmt: skip
    """Sums (step, 7) for ``product = a shot + b read`` of residuals, by steps between pixels.

    ``shot`` and ``read`` are means of the two pixels' variances; all is divided by the root of the
    product of their variances, so that every product has the same weight. Summed are the number,
    the normal matrix (11, 12, 22), the right-hand side (1, 2) and the squared products.

    Parameters
    ----------
    rest, model : (t, y, x) residuals (NaN without weight) and their model, e-
    shot_factor, read : (y, x) variance of a sample: ``shot_factor * model + read``, e-²
    of_time, of_pixels : (t, k), (k, y, x); their product over the variance is the share of a
        sample's variance that its pixel's own fit took up
    taken : (step,) covariance that the frames' fits took off, as a share of the variance
    steps : (step, 2) rows (not negative) and columns
    limit : standard deviations beyond which a residual has no weight
    """
    of_time, of_pixels = of_time.astype(np.float32), of_pixels.astype(np.float32)
    factor, still_variance = shot_factor.astype(np.float32), read.astype(np.float32)
    sums = np.zeros((len(steps), 7))
    ny, nx = good.shape
    for residual, level, share in zip(rest, model, of_time, strict=True):
        signal = np.maximum(level, np.float32(0)) * factor
        weight = 1 / (signal + still_variance)
        root = np.sqrt(weight)
        value = residual * root
        # False of NaN.
        root[~(good & (np.abs(value) <= limit))] = 0
        left = np.sqrt(1 - np.tensordot(share, of_pixels, 1) * weight)
        size = np.where(root > 0, value / left, np.float32(0))
        shot, still = signal * root, still_variance * root
        for n, (dy, dx) in enumerate(steps):
            one = np.s_[: ny - dy, max(0, -dx) : nx - max(0, dx)]
            two = np.s_[dy:, max(0, dx) : nx - max(0, -dx)]
            first = (shot[one] * root[two] + root[one] * shot[two]) / 2
            second = (still[one] * root[two] + root[one] * still[two]) / 2
            there = second > 0
            product = size[one] * size[two] + np.float32(taken[n]) * there
            columns = np.stack([first, second, product]).reshape(3, -1)
            (s11, s12, p1), (_, s22, p2), (_, _, square) = columns @ columns.T
            sums[n] += there.sum(), s11, s12, s22, p1, p2, square
    return sums
