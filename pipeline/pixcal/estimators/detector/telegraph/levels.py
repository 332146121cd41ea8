"""How much of the time pixels are in their upper level, from frames of which there are many.

The charge that fringes leave of a pixel has a normal distribution about either level. Its mean is
taken off, so the rarer level lies further from zero.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import logit, logsumexp

from pixcal.estimators.detector.telegraph.dwell import FEWEST_PIXELS, LitSeries
from pixcal.model.arrays import F64

_RARER = np.array([0.02, 0.035, 0.06, 0.1, 0.17, 0.28])
SHARES = np.concatenate([_RARER, [0.5], 1 - _RARER[::-1]])  # of the time in the upper level
AMPLITUDES = np.geomspace(1.0, 60.0, 14)  # over the noise of dark frames
# by which pixels with unequal levels must make the frames likelier, a pixel that has them: frames
# near each other are alike, so it rises by more than of independent ones
CLEAR, CLEAR_A_PIXEL = 10.0, 0.1
MOST_PIXELS = 400
_TURNS = 60  # of the maximisation


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
