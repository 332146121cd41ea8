"""A hidden state that is one of two: how likely each is in every frame, all frames being known."""

import numpy as np

from pixcal.kernels import kernel
from pixcal.model.arrays import F64


@kernel()
def likely_states(odds: F64, change: F64) -> tuple[F64, float, float]:
    """Chance of the second state, expected number of changes, and gain in log-likelihood.

    Forward and backward through a series (Rabiner 1989, Proc. IEEE 77, 257). ``odds`` (t,) are of
    each frame by itself, the log-likelihood of the second state less that of the first; ``change``
    (t - 1,) is the chance of a change from each frame to the next.
    """
    n = len(odds)
    ahead, second = np.empty(n), np.empty(n)
    # Of the frames so far, the chance of the second state; of those to come, of the first state
    # (one, other) their likelihood.
    before, likelihood = 0.5, 0.0
    for t in range(n):
        if t:
            before = ahead[t - 1] * (1.0 - change[t - 1]) + (1.0 - ahead[t - 1]) * change[t - 1]
        high = max(odds[t], 0.0)
        one, other = (1.0 - before) * np.exp(-high), before * np.exp(odds[t] - high)
        ahead[t] = other / (one + other)
        likelihood += np.log(one + other) + high
    one, other, changes = 0.5, 0.5, 0.0
    for t in range(n - 1, -1, -1):
        own_one, own_other = (1.0 - ahead[t]) * one, ahead[t] * other
        second[t] = own_other / (own_one + own_other)
        if t == 0:
            break
        high, turn = max(odds[t], 0.0), change[t - 1]
        one, other = one * np.exp(-high), other * np.exp(odds[t] - high)
        up, down = (1.0 - ahead[t - 1]) * turn * other, ahead[t - 1] * turn * one
        still = ((1.0 - ahead[t - 1]) * one + ahead[t - 1] * other) * (1.0 - turn)
        changes += (up + down) / (up + down + still)
        one, other = one + turn * (other - one), other + turn * (one - other)
        total = one + other
        one, other = one / total, other / total
    return second, changes, likelihood
