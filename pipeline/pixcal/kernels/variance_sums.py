"""Sums over many small matrices, one a mode, for components of variance.

Compiled: they are small and mostly zeros, and NumPy takes four to ten times as long.
"""

import numpy as np
from numba import njit

from pixcal.model.arrays import F64


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def trace_products(weight: F64, parts: F64) -> F64:
    """Sum over modes of tr(W D_i W D_j), (m, m), of weights (n, c, c) and parts (m, n, c, c)."""
    m, n, c = parts.shape[0], parts.shape[1], parts.shape[2]
    out = np.zeros((m, m))
    product, there = np.empty((m, c, c)), np.empty(m, np.int64)
    for k in range(n):
        count = 0
        for i in range(m):
            if not np.any(parts[i, k]):
                continue
            there[count] = i
            for a in range(c):
                for b in range(c):
                    value = 0.0
                    for d in range(c):
                        value += weight[k, a, d] * parts[i, k, d, b]
                    product[count, a, b] = value
            count += 1
        for p in range(count):
            for q in range(p + 1):
                value = 0.0
                for a in range(c):
                    for b in range(c):
                        value += product[p, a, b] * product[q, b, a]
                out[there[p], there[q]] += value
    for i in range(m):
        for j in range(i):
            both = out[i, j] + out[j, i]
            out[i, j] = both
            out[j, i] = both
    return out
