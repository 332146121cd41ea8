"""Photon transfer of flats, level by level, over that expected with the gain used.

Covariances of neighbours are added to the variance: crosstalk and brighter-fatter move noise from
one to the other but conserve the sum within `STEPS`.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, Stack, cached_on_evidence
from pixcal.kernels.frame_order import slow_trends
from pixcal.kernels.line_means import without_line_means
from pixcal.kernels.medians import robust_sigma
from pixcal.kernels.residual_sums import residual_sums
from pixcal.model.arrays import F32, F64, Mask

# rows and columns from a pixel to itself and to those that may share its noise
STEPS = np.array([(0, 0), (0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)])
# systematic error of a share of the variance: no detector's gain is known better than this, and
# amplifiers differ by as much
FLOOR = 5e-3
MIN_PIXELS = 200  # fewest pixels for a noise measurement
CLIP = 6.0  # standard deviations beyond which a residual does not count

_FAR_OFF = 4.0  # ratio of measured to expected noise beyond which a gain is grossly wrong
_MIN_LEVELS = 3
_ALIKE = 1e4
_READ_KNOWN = 0.3  # assumed relative error of the variance of the read noise
_EXACT = 1e-3  # the same where the error, common to all levels, is added afterwards


@dataclass(frozen=True)
class TransferCurve:
    """Photon transfer of flats over that expected with the gain used, as a line in the level."""

    share: float  # share, error: at level zero
    error: float
    slope: float  # slope, slope_error: change from zero to the highest level
    slope_error: float
    top: float  # highest level, e-
    levels: F64  # levels, shares, errors: (n,) of each level (e-)
    shares: F64
    errors: F64
    # error (e-²) of the variance of the read noise, common to all levels, if not fitted to them
    common: float = 0.0


@cached_on_evidence
def transfer_curve(evidence: Evidence, *, whole: bool = False) -> TransferCurve | None:
    """Photon transfer of each level of flats; None with fewer than three, or no level of darks.

    Where the gain was measured from flats, only `STEPS` found to share noise count, unless
    ``whole``. This makes the slope more precise, but several insignificant covariances may
    together exceed the error.
    """
    if not evidence.has_level:
        return None
    counted = None if whole else _shared_steps(evidence)
    darks = [_read_alone(s) for s in _without_light(evidence)]
    known = read_known(evidence)
    common = 0.0 if known is None else known * evidence.read_noise**2
    exact = None if known is None else _EXACT
    points = []
    for stack in filter(_is_enough, evidence.ladder):
        sums = _of_stack(evidence, stack)
        share = None if sums is None else shot_share([sums, *darks], counted, exact)
        level = float((stack.adu.mean(axis=0) - evidence.bias)[evidence.good].mean())
        if share is not None and level > 0:
            points.append((level * evidence.gain, *share))
    if len(points) < _MIN_LEVELS:
        return None
    level, share, error = np.array(points).T
    top = float(level.max())
    design = np.stack([np.ones_like(level), level / top])
    weights = np.linalg.inv(np.diag(error**2) + np.outer(common / level, common / level))
    normal = design @ weights @ design.T
    if np.linalg.cond(normal) > _ALIKE:
        return None
    covariance = np.linalg.inv(normal)
    line = covariance @ (design @ weights @ share)
    errors = np.sqrt(np.diag(covariance))
    at_zero, rise = zip(line.tolist(), errors.tolist(), strict=True)
    return TransferCurve(
        *at_zero, *rise, top, level, share, np.hypot(error, common / level), common
    )


def _read_alone(sums: F64) -> F64:
    """Sums of frames without light, less the expected shot noise of their dark signal."""
    # Dark signal is low, where the response has another slope than at the levels of flats.
    n, _, s12, s22, _, p2, square = sums.T
    none = np.zeros_like(n)
    first = np.arange(len(n)) == 0
    return np.stack([n, none, none, s22, none, p2 - s12 * first, square], axis=1)


def shot_share(
    sums: Iterable[F64], counted: Mask | None = None, known: float | None = None
) -> tuple[float, float] | None:
    """Level-dependent noise over that expected, with its error; None without samples.

    ``counted``: which of `STEPS` to add to the first, all by default. ``known``: relative error of
    the variance of the read noise, where frames without light do not determine it.
    """
    total = sum(sums, np.zeros((len(STEPS), 7)))
    if not total[0, 0]:
        return None
    share = variance = 0.0
    for number, (n, s11, s12, s22, p1, p2, square) in enumerate(total):
        is_variance = number == 0
        if counted is not None and not counted[number]:
            continue
        normal, right = np.array([[s11, s12], [s12, s22]]), np.array([p1, p2])
        scatter = square / n - is_variance
        prior = scatter / (known if is_variance and known is not None else _READ_KNOWN) ** 2
        normal[1, 1] += prior
        right[1] += prior * is_variance
        inverse = np.linalg.inv(normal)
        times = 1 if is_variance else 2
        share += times * (inverse @ right)[0]
        variance += times**2 * scatter * inverse[0, 0]
    # Negative if levels are too similar to separate shot noise from read noise.
    if share <= 0.1 or not 0 <= variance < np.inf:
        return None
    floor = FLOOR * (share if share > _FAR_OFF else 1.0)
    return float(share), float(np.sqrt(variance + floor**2))


def sums_of_stacks(evidence: Evidence) -> list[F64]:
    """Sums of flats, and of frames without light, which give the noise at zero level."""
    flats = [s for s in evidence.stacks if s.kind == "flat" and _is_enough(s)]
    return [*_of_stacks(flats, evidence), *_without_light(evidence)] if flats else []


def read_known(evidence: Evidence) -> float | None:
    """Relative error of the variance of the read noise; None if frames without light give it."""
    if not evidence.without_dark and evidence.lowest_adu is None:
        return None
    error = 2 * evidence.read_noise_error / evidence.read_noise
    return min(error, _READ_KNOWN) if error > 0 else _READ_KNOWN


def _without_light(evidence: Evidence) -> list[F64]:
    """Sums of bias and dark frames; their variance is left out if it is not that of flats."""
    unlit = _of_stacks((s for s in evidence.stacks if s.kind != "flat"), evidence)
    if read_known(evidence) is None:
        return unlit
    other = np.arange(len(STEPS))[:, None] > 0
    return [sums * other for sums in unlit]


def _of_stacks(stacks: Iterable[Stack], evidence: Evidence) -> list[F64]:
    every = (_of_stack(evidence, stack) for stack in filter(_is_enough, stacks))
    return [sums for sums in every if sums is not None]


def _is_enough(stack: Stack) -> bool:
    return len(stack.adu) >= 2


@cached_on_evidence
def _of_stack(evidence: Evidence, stack: Stack) -> F64 | None:
    good = evidence.good & (stack.adu < evidence.saturation_adu).all(axis=0)
    pixels = np.count_nonzero(good)
    if pixels < MIN_PIXELS:
        return None
    frames = (stack.adu - evidence.bias.astype(np.float32)) * np.float32(evidence.gain)
    level = frames.mean(axis=0)
    # Excess of a frame, of light or of bias. Pixels' own levels are too noisy to predict their
    # noise: the share would be biased low.
    pattern = evidence.flat if stack.kind == "flat" else np.ones(level.shape)
    pattern = np.where(good, pattern, 0).astype(np.float32)
    usual = pattern * max(float(level[good].mean() / pattern[good].mean()), 0.0)
    frames -= level
    read = np.float32(evidence.read_noise**2)
    scale = _noise_scale(frames, good, float(usual[good].mean()), float(read))
    noise = scale * usual + read
    more = np.einsum("tyx,yx->t", frames, pattern / noise)
    brighter = (more / (pattern**2 / noise).sum())[:, None, None] * pattern
    ones = np.ones(level.shape)
    # Noise that every second row shares does not average out over few frames.
    residual = without_line_means(frames - brighter, good)
    # A lamp that drifts, with its shape, is no noise either.
    slow = slow_trends(stack.frame)
    residual -= np.tensordot(slow, np.tensordot(slow, residual, (0, 0)), 1)
    residual /= np.sqrt(1 - (slow**2).sum(axis=1))[:, None, None]
    nothing = np.zeros((len(frames), 1))
    sums = residual_sums(
        residual,
        usual + brighter,
        scale * ones,
        evidence.read_noise**2 * ones,
        good,
        nothing,
        nothing[:1, :, None] * noise,
        np.full(len(STEPS), 1 / pixels),
        STEPS,
        CLIP,
    )
    return np.asarray(sums / np.array([1, scale**2, scale, 1, scale, 1, 1]))


def _noise_scale(rest: F32, good: Mask, shot: float, read: float) -> float:
    """Noise of light in deviations (t, y, x) from pixels' means over that expected, roughly."""
    # It is 1 unless it is above `_FAR_OFF`, as with a grossly wrong gain, which would clip samples.
    # Between neighbours in a row, as rows may have noise in common.
    steps = np.diff(rest, axis=2)[:, good[:, 1:] & good[:, :-1]]
    spread = robust_sigma(steps) ** 2 / 2 * len(rest) / (len(rest) - 1)
    scale = (spread - read) / max(shot, 1e-9)
    return scale if scale > _FAR_OFF else 1.0


def _shared_steps(evidence: Evidence) -> Mask:
    """Which of `STEPS` share noise according to the flats; all where these gave no gain."""
    if np.isnan(evidence.photon_transfer[0]):
        return np.ones(len(STEPS), np.bool_)
    counted = {(0, 0), *evidence.neighbours, *((-y, -x) for y, x in evidence.neighbours)}
    return np.array([(int(y), int(x)) in counted for y, x in STEPS])
