"""Statistics of bias, dark and flat frames: differences of two frames of one scene.

The difference of two frames holds no fixed pattern, only noise. The statistics are its covariance
between neighbours, rows and columns at several distances, and how that grows with the level.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, Stack, cached_on_evidence
from pixcal.estimators.test_statistics import Curve, family, statistic
from pixcal.estimators.test_statistics.fringe_set_data import ADJACENT, STEPS, neighbour_sums
from pixcal.estimators.test_statistics.noise import RANGES, in_range
from pixcal.kernels.line_means import without_line_means
from pixcal.kernels.sample_sums import frame_means
from pixcal.model.arrays import F32, F64, Mask

of_noise = partial(statistic, "noise")

REPEATS = (1, 2, 3, 4)  # distances (lines) of rows or columns that may share noise
OUTLIER_SIGMA = 8.0
BANDS = 4  # of the spectrum, from the size of the window to two pixels


@cached_on_evidence
def differences(evidence: Evidence, stack: Stack) -> F32:
    """Differences (t, y, x) of frames 0 and 1, 2 and 3, ..., over their noise; outliers zero."""
    light = stack.adu - evidence.bias.astype(np.float32)
    good = evidence.good
    if stack.kind == "flat":
        means = frame_means(light, good)
        light *= (means.mean() / means)[:, None, None].astype(np.float32)
    count = len(light) // 2 * 2
    steps = light[1:count:2] - light[:count:2]
    if stack.kind == "flat":
        # Differences (t, y, x) of flats without changes of the light's gradient.
        # The gradient of the sky rotates from frame to frame; light is no part of the detector.
        basis = _gradient(evidence)
        flat = steps.reshape(len(steps), -1)
        steps = np.asarray((flat - flat @ basis @ basis.T).reshape(steps.shape))
    steps -= frame_means(steps, good)[:, None, None].astype(np.float32)
    # Root mean squares, as medians of integers are quantised.
    noise = np.sqrt((steps[:, good] ** 2).mean())
    rest = steps / noise if noise > 0 else steps
    rest[np.abs(rest) > OUTLIER_SIGMA] = 0
    return np.asarray(rest * good, np.float32)


@cached_on_evidence
def _gradient(evidence: Evidence) -> F32:
    """Light and its gradient, orthonormal (pixel, 3)."""
    ny, nx = evidence.good.shape
    y, x = np.linspace(-1, 1, ny)[:, None], np.linspace(-1, 1, nx)
    lit = np.where(evidence.good, evidence.flat, 0)
    terms = np.stack([lit, lit * y, lit * x]).reshape(3, -1)
    # From their products: a decomposition of all pixels takes three times as long.
    gram = terms @ terms.T
    root = np.linalg.cholesky(gram + 1e-12 * np.trace(gram) * np.eye(len(gram)))
    return np.asarray((np.linalg.inv(root) @ terms).T, np.float32)


def repeated(evidence: Evidence, kind: str) -> tuple[Stack, ...]:
    """Stacks of a kind whose frames differ, by noise that is not hidden by rounding."""
    if kind != "flat" and not evidence.dithered:
        return ()
    stacks = evidence.ladder if kind == "flat" else evidence.of_kind(kind)
    # Copies of one frame, and frames that are clipped everywhere, do not differ.
    return tuple(s for s in stacks if len(s.adu) >= 2 and differences(evidence, s).any())


def _correlation(evidence: Evidence, stacks: Sequence[Stack]) -> F64:
    """Correlation (step,) of pixels by rows and columns; lines have their own statistic."""
    sums = (_neighbour_sums(evidence, stack) for stack in stacks)
    total, pairs, square, count = sum(sums, np.zeros((4, len(STEPS))))
    return np.asarray(total / np.maximum(pairs, 1) / (square / np.maximum(count, 1)))


@cached_on_evidence
def _neighbour_sums(evidence: Evidence, stack: Stack) -> F64:
    """Sums (4, step): of products with neighbours, their number; of squares, and theirs."""
    good = evidence.good
    steps = without_line_means(differences(evidence, stack), good)
    sums, number = neighbour_sums(steps, good, STEPS)
    square = np.full(len(STEPS), np.einsum("tyx,tyx->", steps, steps, dtype=float))
    count = np.full(len(STEPS), len(steps) * np.count_nonzero(good))
    return np.stack([sums.sum(axis=1), number.sum(axis=1), square, count])


def _repeats(rest: F32, good: Mask, axis: int) -> F64:
    """Products of the means of lines at `REPEATS`, over the variance of a mean."""
    means = rest.sum(axis=axis) / np.sqrt(np.maximum(good.sum(axis=axis - 1), 1))
    means = means - means.mean(axis=1, keepdims=True)
    return np.array([float((means[:, n:] * means[:, :-n]).mean()) for n in REPEATS])


@of_noise("correlation of neighbours in flats, bright minus dim", "correlation", x="neighbour")
def flat_neighbours_by_level(evidence: Evidence) -> Curve | None:
    """Correlation in the brighter half of the levels minus that in the other half."""
    stacks = repeated(evidence, "flat")
    if len(stacks) < 2:
        return None
    levels = [float(s.adu.mean()) for s in stacks]
    order = np.argsort(levels, kind="stable")
    half = len(order) // 2
    dim, bright = (
        _correlation(evidence, [stacks[n] for n in own]) for own in (order[:half], order[half:])
    )
    return Curve.numbered((bright - dim)[:ADJACENT])


@statistic(
    "time",
    "change of the bias: spatial spectrum",
    "noise / expected noise",
    x="band, then two rows, two columns",
    power=True,
)
def bias_change(evidence: Evidence) -> Curve | None:
    """Power of the change from the first to the second half of the frames, over that of noise."""
    stacks = [s for s in repeated(evidence, "bias") if len(s.adu) >= 4]
    if not stacks:
        return None
    adu, good = stacks[0].adu, evidence.good
    half = len(adu) // 2
    change = adu[:half].mean(axis=0) - adu[-half:].mean(axis=0)
    change = np.where(good, change - change[good].mean(), 0)
    noise = np.sqrt(2 / half) * evidence.read_noise / evidence.gain
    change = np.clip(change / noise, -OUTLIER_SIGMA, OUTLIER_SIGMA)
    power = np.abs(np.fft.rfft2(change)) ** 2 / change.size
    fy, fx = np.abs(np.fft.fftfreq(change.shape[0])), np.fft.rfftfreq(change.shape[1])
    band = np.minimum((2 * BANDS * np.maximum(fy[:, None], fx[None, :])).astype(int), BANDS - 1)
    power[0, 0] = 0
    bands = np.bincount(band.ravel(), power.ravel()) / np.bincount(band.ravel())
    ends = [power[len(fy) // 2].mean(), power[:, -1].mean()]
    return Curve.numbered(np.concatenate([bands, ends]))


KINDS = (("bias",), ("dark",), ("flat",))


NEIGHBOURS = tuple((f"{kind}_{own[0]}", kind, *own) for own in RANGES for (kind,) in KINDS)


@family(
    "{0}", NEIGHBOURS, "noise", "correlation of {3} in {1} frames", "correlation", x="{4}",
)  # fmt: skip
def neighbours(of: str, evidence: Evidence) -> Curve | None:
    """Correlation in the differences of two frames of a kind."""
    kind, _, distance = of.partition("_")
    stacks = repeated(evidence, kind)
    return in_range(distance, _correlation(evidence, stacks)) if stacks else None


@family(
    "{0}_line_repeats",
    KINDS,
    "noise",
    "correlated row and column noise in {0} frames",
    "correlation",
    x="distance: rows, then columns",
)
def line_repeats(kind: str, evidence: Evidence) -> Curve | None:
    """Correlation of the means of lines some lines apart."""
    stacks = repeated(evidence, kind)
    if not stacks:
        return None
    rest = np.concatenate([differences(evidence, s) for s in stacks])
    value = [one for axis in (2, 1) for one in _repeats(rest, evidence.good, axis)]
    return Curve.numbered(value)
