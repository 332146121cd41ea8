"""How far pixels jump and how much of the time they are in their upper level.

The charge that fringes leave of a pixel has a normal distribution about either level. Its mean is
taken off, so the rarer level lies further from zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logit, logsumexp

from pixcal.estimators.detector.telegraph.dwell import FEWEST_PIXELS, LitSeries
from pixcal.model.arrays import F32, F64, Indices

_RARER = np.array([0.02, 0.035, 0.06, 0.1, 0.17, 0.28])
SHARES = np.concatenate([_RARER, [0.5], 1 - _RARER[::-1]])  # of the time in the upper level
AMPLITUDES = np.geomspace(1.0, 60.0, 14)  # over the noise of dark frames
# by which pixels with unequal levels must make the frames likelier, a pixel that has them: frames
# near each other are alike, so it rises by more than of independent ones
CLEAR, CLEAR_A_PIXEL = 10.0, 0.1
MOST_PIXELS = 400
_TURNS = 60  # of the maximisation
# of single pixels: shares and amplitudes as above, and by how much the logarithm of the likelihood
# of two levels must be above that of one
OWN_SHARES = np.array([0.03, 0.08, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92, 0.97])
OWN_AMPLITUDES = np.geomspace(1.0, 60.0, 28)
TWO_LEVELS = 8.0


def find_upper(lit: Sequence[LitSeries], noise: float) -> float:
    """Share of the time in the upper level that all pixels have in common; 0.5 unless it is clear.

    Parameters
    ----------
    lit : frames of fringes; a pixel counts in each set by itself, as one may lack it
    noise : of dark frames, e-
    """
    used = [s for s in lit if s.charge.shape[1] >= FEWEST_PIXELS]
    if not used:
        return 0.5
    jumps = np.hstack([_by_share(s, noise * AMPLITUDES) for s in used])
    even = len(_RARER)
    plain = _mixed(jumps[[even]])[0]
    found = [
        _mixed(jumps[[even, n]]) if n != even else (plain, 0.0, 1.0) for n in range(len(SHARES))
    ]
    likely, parts, others = np.array(found).T
    best = int(np.argmax(likely))
    gain = likely[best] - plain
    if gain < CLEAR + CLEAR_A_PIXEL * parts[best] * jumps.shape[1] or parts[best] < others[best]:
        return 0.5
    # The top of a parabola through it and its neighbours.
    near = np.clip(np.arange(best - 1, best + 2), 0, len(SHARES) - 1)
    if len(set(near.tolist())) < 3:
        return float(SHARES[best])
    curve = np.polyfit(logit(SHARES[near]), likely[near] - likely[best], 2)
    return float(1 / (1 + np.exp(curve[1] / (2 * curve[0]))))


@dataclass(frozen=True)
class OwnLevels:
    """The two levels of single pixels."""

    pixel: Indices  # (n,)
    amplitude: F64  # (n,) difference of the two, e-
    upper: F64  # (n,) share of the time in the upper one


def own_levels(series: Sequence[LitSeries], noise: float) -> OwnLevels:
    """Levels of the pixels that have two, by all frames together.

    In each series a pixel may be in its upper level for another share of the time, or in one level
    all along. The share is that of the series of most frames.

    Parameters
    ----------
    series : frames without light, and of fringes
    noise : of frames without light, e-
    """
    pixels = np.unique(np.concatenate([s.pixel for s in series]))
    likely = np.zeros((len(OWN_AMPLITUDES), len(pixels)))
    of_share = np.zeros((len(OWN_SHARES), *likely.shape))
    longest = max(len(s.frame) for s in series)
    for one in series:
        at = np.searchsorted(pixels, one.pixel)
        each = _two_levels(one, noise * OWN_AMPLITUDES)
        # Or it stayed in one level all along.
        likely[:, at] += np.logaddexp(logsumexp(each, axis=0), 0) - np.log(len(OWN_SHARES) + 1)
        if 2 * len(one.frame) > longest:
            of_share[:, :, at] += each
    best = np.clip(likely.argmax(axis=0), 1, len(OWN_AMPLITUDES) - 2)
    number = np.arange(len(pixels))
    low, middle, high = likely[best[None] + np.array([-1, 0, 1])[:, None], number]
    # The top of a parabola through the best and its neighbours.
    off = (high - low) / np.maximum(2 * (2 * middle - low - high), 1e-9)
    step = OWN_AMPLITUDES[1] / OWN_AMPLITUDES[0]
    amplitude = noise * OWN_AMPLITUDES[best] * step ** np.clip(off, -1, 1)
    upper = OWN_SHARES[of_share[:, best, number].argmax(axis=0)]
    two = likely.max(axis=0) > TWO_LEVELS
    return OwnLevels(pixels[two], amplitude[two], upper[two])


def _two_levels(series: LitSeries, amplitudes: F64) -> F32:
    """Logarithms (share, amplitude, n) of the likelihoods over that of one level."""
    charge, weight = series.charge.astype(np.float32), series.weight.astype(np.float32)
    found = np.empty((len(OWN_SHARES), len(amplitudes), charge.shape[1]), np.float32)
    for of_share, upper in zip(found, OWN_SHARES.astype(np.float32), strict=True):
        for own, a in zip(of_share, amplitudes.astype(np.float32), strict=True):
            # Of the lower level, and by how much the upper one is likelier.
            lower = -(upper * a * charge + (upper * a) ** 2 / 2) * weight
            more = (a * charge + (upper - np.float32(0.5)) * a**2) * weight
            own[:] = (lower + np.logaddexp(np.log1p(-upper), np.log(upper) + more)).sum(axis=0)
    return found


def _by_share(series: LitSeries, amplitudes: F64) -> F64:
    """Logarithms (share, n) of the likelihoods of some pixels, over that of quiet ones."""
    each = -(-series.charge.shape[1] // MOST_PIXELS)
    charge, weight = series.charge[:, ::each], series.weight[:, ::each]
    return np.stack([_log_likelihoods(charge, weight, p, amplitudes) for p in SHARES])


def _mixed(jumps: F64) -> tuple[float, float, float]:
    """Likelihood of pixels that are quiet or of some kinds; shares of the last one, and before it.

    ``jumps``: (kind, n) logarithm of each pixel's likelihood, over that of a quiet one.
    """
    every = np.vstack([np.zeros(jumps.shape[1]), jumps])
    log_share = np.full(len(every), -np.log(len(every)))
    for _ in range(_TURNS):
        joint = every + log_share[:, None]
        own = joint - logsumexp(joint, axis=0)
        log_share = logsumexp(own, axis=1) - np.log(own.shape[1])
    total = logsumexp(every + log_share[:, None], axis=0)
    last, before = np.exp(log_share[[-1, -2]])
    return float(total.sum()), float(last), float(before)


def _log_likelihoods(charge: F64, weight: F64, upper: float, amplitudes: F64) -> F64:
    """Of pixels (t, n), each of which has any of the amplitudes, over that of none."""
    total = np.empty((len(amplitudes), charge.shape[1]))
    for own, amplitude in zip(total, amplitudes, strict=True):
        levels = -upper * amplitude, (1 - upper) * amplitude
        low, high = ((level * charge - level**2 / 2) * weight for level in levels)
        own[:] = np.logaddexp(np.log1p(-upper) + low, np.log(upper) + high).sum(axis=0)
    return np.asarray(logsumexp(total, axis=0) - np.log(len(amplitudes)))
