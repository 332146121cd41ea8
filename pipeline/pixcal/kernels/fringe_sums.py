"""Compiled sums of fringes that hold still: weights depend on the phase alone.

The model is that of `pixcal.kernels.bilinear`; the normal matrices come from the frames
(`pixcal.estimators.fringe_fit.harmonics`), so that a sample costs three sums and its own square.
"""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pixcal.kernels.bilinear import GROUP, SINGULAR

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_FAST = {"reassoc", "contract", "nsz", "arcp", "afn"}


@njit(inline="always")  # type: ignore[untyped-decorator]
def _frame(row: Any) -> Any:
    return row[0], row[1], row[2], row[3], row[4]


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _fringe_group(
    codes: Any, first: int, stop: int, scale: float, offset: float, frames: Any, rho: float,
    level: Any, s: Any, c: Any, b0: Any, b1: Any, b2: Any, rr: Any,
) -> None:  # fmt: skip
    # Four frames at a time: the sums are loaded and stored once for all of them. Bound by the
    # number of floating-point operations.
    base = np.float32(1) + rho
    n = codes.shape[0] // 4 * 4
    for t in range(0, n, 4):
        pb, pa, pc, ps, pf = _frame(frames[t])
        qb, qa, qc, qs, qf = _frame(frames[t + 1])
        ub, ua, uc, us, uf = _frame(frames[t + 2])
        vb, va, vc, vs, vf = _frame(frames[t + 3])
        cp, cq = codes[t, first:stop], codes[t + 1, first:stop]
        cu, cv = codes[t + 2, first:stop], codes[t + 3, first:stop]
        for i in range(stop - first):
            si, ci, li = s[i], c[i], level[i]
            xp, xq = si * pc + ci * ps, si * qc + ci * qs
            xu, xv = si * uc + ci * us, si * vc + ci * vs
            rp = scale * np.float32(cp[i]) + offset - li * (pb + pa * xp)
            rq = scale * np.float32(cq[i]) + offset - li * (qb + qa * xq)
            ru = scale * np.float32(cu[i]) + offset - li * (ub + ua * xu)
            rv = scale * np.float32(cv[i]) + offset - li * (vb + va * xv)
            wp, wq = pf * rp / (base + xp), qf * rq / (base + xq)
            wu, wv = uf * ru / (base + xu), vf * rv / (base + xv)
            zp, zq, zu, zv = wp * pa, wq * qa, wu * ua, wv * va
            b0[i] += wp * pb + wq * qb + wu * ub + wv * vb
            b1[i] += zp * pc + zq * qc + zu * uc + zv * vc
            b2[i] += zp * ps + zq * qs + zu * us + zv * vs
            rr[i] += wp * rp + wq * rq + wu * ru + wv * rv
    for t in range(n, codes.shape[0]):
        pb, pa, pc, ps, pf = _frame(frames[t])
        cp = codes[t, first:stop]
        for i in range(stop - first):
            xp = s[i] * pc + c[i] * ps
            rp = scale * np.float32(cp[i]) + offset - level[i] * (pb + pa * xp)
            wp = pf * rp / (base + xp)
            zp = wp * pa
            b0[i] += wp * pb
            b1[i] += zp * pc
            b2[i] += zp * ps
            rr[i] += wp * rp


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _count_fill(codes: Any, first: int, stop: int, fill: int, count: Any) -> None:
    for t in range(codes.shape[0]):
        row = codes[t, first:stop]
        for i in range(stop - first):
            count[i] += np.float32(row[i] == fill)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _holds(codes: Any, fill: int) -> bool:
    found = False
    for t in range(codes.shape[0]):
        for i in range(codes.shape[1]):
            found |= codes[t, i] == fill
    return bool(found)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def fringe_block(
    codes: Any,
    scale: float,
    offset: float,
    fill: int,
    frames: F32,
    rho: float,
    level: F32,
    s: F32,
    c: F32,
    sums: F64,
    missing: F64,
) -> bool:
    """Right-hand sums of pixels for weights that depend on the phase of the fringe only.

    The weight is ``f / (1 + rho + s cos phi + c sin phi)``; the normal sums follow from the frames
    (`harmonics`), less those of samples without weight, given in ``missing``.

    Parameters
    ----------
    codes : (t, p) uint16
        Stored samples of p pixels.
    scale, offset, fill
        As in `sweep_block`.
    frames : (t, 5) float32
        (B, A, cos phi, sin phi, f) at the tile's centre, f the frame's own weight.
    rho : float
        Read variance over level, in the weights.
    level, s, c : (p,) float32
        Start model ``level * (B + s A cos phi + c A sin phi)``, in electrons.
    sums : (4, p) float64
        Added to: right-hand sums 0 to 2 of the residual, weighted square of the residual.
    missing : (7, p) float64
        Added to: normal sums of the samples without weight (6), and their number.

    Returns
    -------
    bool
        Whether any sample had no weight.
    """
    n = codes.shape[1]
    p = np.empty((5, GROUP), np.float32)
    sc, of, rh = np.float32(scale), np.float32(offset), np.float32(rho)
    # As wide as the codes: comparing wider numbers takes four times as long.
    mark = np.uint16(fill)
    filled = _holds(codes, mark)
    for first in range(0, n, GROUP):
        stop = min(first + GROUP, n)
        for k in range(5):
            for i in range(GROUP):
                p[k, i] = 0
        _fringe_group(
            codes, first, stop, sc, of, frames, rh, level[first:stop], s[first:stop],
            c[first:stop], p[0], p[1], p[2], p[3],
        )  # fmt: skip
        if filled:
            _count_fill(codes, first, stop, mark, p[4])
            for i in range(stop - first):
                if p[4, i] > 0:
                    at = first + i
                    _without_fill(
                        codes[:, at], sc, of, fill, frames, rh,
                        level[at], s[at], c[at], p, i, missing[:, at],
                    )  # fmt: skip
        for k in range(4):
            for i in range(stop - first):
                sums[k, first + i] += p[k, i]
    return bool(filled)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _without_fill(
    codes: Any, scale: float, offset: float, fill: int, frames: Any, rho: float,
    level: float, s: float, c: float, p: Any, i: int, missing: Any,
) -> None:  # fmt: skip
    """Sum a pixel anew without its samples of no weight, and note what the frames must lose."""
    b0 = b1 = b2 = rr = 0.0
    for t in range(codes.shape[0]):
        a0, amplitude, co, si, f = _frame(frames[t])
        a1, a2 = amplitude * co, amplitude * si
        w = f / (1.0 + rho + s * co + c * si)
        if codes[t] == fill:
            missing[0] += w * a0 * a0
            missing[1] += w * a0 * a1
            missing[2] += w * a0 * a2
            missing[3] += w * a1 * a1
            missing[4] += w * a1 * a2
            missing[5] += w * a2 * a2
            missing[6] += 1.0
            continue
        r = scale * codes[t] + offset - level * (a0 + s * a1 + c * a2)
        b0 += w * r * a0
        b1 += w * r * a1
        b2 += w * r * a2
        rr += w * r * r
    p[0, i], p[1, i], p[2, i], p[3, i] = b0, b1, b2, rr


def turn_table(table: F64) -> F32:
    """What turns the right-hand sums of a pixel into its step from the start model.

    Parameters
    ----------
    table : (6, size) float64
        Normal sums over one turn of the phase (`harmonics.normal_table`).

    Returns
    -------
    (size + 1, 9) float32
        Over the same turn, its first row again at the end: three factors for the step across the
        phasor (along growing phase), three for the step along it; variance across, covariance,
        variance along. NaN where the frames do not give all three unknowns.
    """
    a, b, c, d, e, f = table
    i00, i01, i02 = d * f - e * e, c * e - b * f, b * e - c * d
    i11, i12, i22 = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * i00 + b * i01 + c * i02
    solvable = det > SINGULAR * a * d * f
    one = np.where(solvable, 1 / np.where(solvable, det, 1.0), np.nan)
    phase = 2 * np.pi * np.arange(table.shape[1]) / table.shape[1]
    sin, cos = np.sin(phase), np.cos(phase)
    across = [(cos * i01 - sin * i02), (cos * i11 - sin * i12), (cos * i12 - sin * i22)]
    along = [(sin * i01 + cos * i02), (sin * i11 + cos * i12), (sin * i12 + cos * i22)]
    squares = [
        cos * across[1] - sin * across[2],
        sin * across[1] + cos * across[2],
        sin * along[1] + cos * along[2],
    ]
    turned = (one * np.stack([*across, *along, *squares])).T.astype(np.float32)
    return np.concatenate([turned, turned[:1]])


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def close_fringes(
    normal: F64,
    turns: F32,
    place: F32,
    level: F32,
    visibility: float,
    part: F64,
    missing: F64,
    filled: bool,
    spread: F32,
    total: F64,
    turn: F32,
    sigma: F32,
) -> None:
    """Phase of a batch relative to the start model, and its error; its sums go to the run's.

    Parameters
    ----------
    normal : (6, size) float64
        Normal sums over one turn of the pixel's phase (`pixcal.estimators.fringe_fit.harmonics`).
    turns : (size + 1, 9) float32
        What solves them, from `turn_table`.
    place : (p,) float32
        Phase of the start model in turns, from 0 to 1.
    level : (p,) float32
        Of the start model, in electrons.
    visibility : float
        Of the start model.
    part : (4, p) float64
        Sums of the batch, from `fringe_block`; zero afterwards.
    missing : (7, p) float64
        As in `fringe_block`.
    filled : bool
        Whether ``missing`` holds anything.
    spread : (p,) float32
        Variance of the samples over that of the weights.
    total : (4, p) float64
        Sums of the run, added to.
    turn, sigma : (p,) float32
        Written: rad.
    """
    n = place.size
    kept = np.empty((5, GROUP), np.float32)
    v = np.float32(visibility)
    for first in range(0, n, GROUP):
        stop = min(first + GROUP, n)
        m = stop - first
        across, along = kept[0, :m], kept[1, :m]
        vaa, vab, vbb = kept[2, :m], kept[3, :m], kept[4, :m]
        _steps(turns, place[first:stop], part[:, first:stop], across, along, vaa, vab, vbb)
        _angles(
            across, along, vaa, vab, vbb, level[first:stop], v, spread[first:stop],
            turn[first:stop], sigma[first:stop],
        )  # fmt: skip
    if filled:
        for i in range(n):
            if missing[6, i] > 0:
                _angle_without_fill(
                    normal, place[i], level[i], v, part[:, i], missing[:, i], spread[i],
                    turn[i : i + 1], sigma[i : i + 1],
                )  # fmt: skip
    for k in range(4):
        for i in range(n):
            total[k, i] += part[k, i]
            part[k, i] = 0.0


# Apart from the loop after it, which is vectorised.
@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _steps(
    table: Any, place: Any, part: Any, across: Any, along: Any, vaa: Any, vab: Any, vbb: Any
) -> None:
    """Steps from the start model across and along its phasor, and their covariance."""
    one = np.float32(1)
    size, last = np.float32(table.shape[0] - 1), table.shape[0] - 2
    for i in range(place.size):
        at = place[i] * size
        # A phase a hair below zero is a whole turn in single precision.
        j = min(int(at), last)
        q = at - np.float32(j)
        p = one - q
        low, high = table[j], table[j + 1]
        b0, b1, b2 = np.float32(part[0, i]), np.float32(part[1, i]), np.float32(part[2, i])
        across[i] = (
            (p * low[0] + q * high[0]) * b0
            + (p * low[1] + q * high[1]) * b1
            + (p * low[2] + q * high[2]) * b2
        )
        along[i] = (
            (p * low[3] + q * high[3]) * b0
            + (p * low[4] + q * high[4]) * b1
            + (p * low[5] + q * high[5]) * b2
        )
        vaa[i] = p * low[6] + q * high[6]
        vab[i] = p * low[7] + q * high[7]
        vbb[i] = p * low[8] + q * high[8]


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _angles(
    across: Any, along: Any, vaa: Any, vab: Any, vbb: Any, level: Any, visibility: float,
    spread: Any, turn: Any, sigma: Any,
) -> None:  # fmt: skip
    zero, one, two, half = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
    third, fifth = np.float32(1 / 3), np.float32(1 / 5)
    seventh, ninth = np.float32(1 / 7), np.float32(1 / 9)
    far = False
    for i in range(turn.size):
        x = visibility * level[i] + along[i]
        q = across[i] / x
        square = q * q
        # The arc tangent's series: good to 2e-8 rad up to a quarter.
        rest = fifth - square * (seventh - square * ninth)
        turn[i] = q * (one - square * (third - square * rest))
        variance = (vaa[i] - q * (two * vab[i] - q * vbb[i])) * spread[i]
        sigma[i] = np.sqrt(max(variance, zero)) / (abs(x) * (one + square))
        far |= not (x > zero and square < np.float32(0.0625))
    if far:
        for i in range(turn.size):
            x = visibility * level[i] + along[i]
            if not (x > zero and abs(across[i]) < half * half * x):
                turn[i] = np.arctan2(across[i], x)


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _angle_without_fill(
    normal: F64, place: float, level: float, visibility: float, b: Any, missing: Any,
    spread: float, turn: Any, sigma: Any,
) -> None:  # fmt: skip
    """Phase and error of a pixel whose normal sums lack those of some samples."""
    size = normal.shape[1]
    at = place * size
    j = int(at) % size
    k = j + 1 if j + 1 < size else 0
    part = at - np.floor(at)
    n = np.empty(6)
    for m in range(6):
        n[m] = normal[m, j] + part * (normal[m, k] - normal[m, j]) - missing[m]
    i00, i01 = n[3] * n[5] - n[4] * n[4], n[2] * n[4] - n[1] * n[5]
    i02, i11 = n[1] * n[4] - n[2] * n[3], n[0] * n[5] - n[2] * n[2]
    i12, i22 = n[1] * n[2] - n[0] * n[4], n[0] * n[3] - n[1] * n[1]
    det = n[0] * i00 + n[1] * i01 + n[2] * i02
    one = 1.0 / det if det > SINGULAR * n[0] * n[3] * n[5] else np.nan
    s, c = np.sin(2 * np.pi * place), np.cos(2 * np.pi * place)
    ts = visibility * level * s + (i01 * b[0] + i11 * b[1] + i12 * b[2]) * one
    tc = visibility * level * c + (i02 * b[0] + i12 * b[1] + i22 * b[2]) * one
    power = ts * ts + tc * tc
    variance = (tc * tc * i11 - 2 * tc * ts * i12 + ts * ts * i22) * one / (power * power)
    turn[0] = np.arctan2(ts * c - tc * s, tc * c + ts * s)
    sigma[0] = np.sqrt(max(variance, 0.0) * spread)


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def frame_moments(g: F64, weight: F64, out: Any) -> None:
    """Add ``f exp(i k phi) g_i g_j`` of every frame to out (6, orders), for k = 0, 1, ...

    Parameters
    ----------
    g : (t, 3) float64
        (B, A cos phi, A sin phi).
    weight : (t,) float64
        The frames' own weights f.
    out : (6, orders) complex128
        Pairs ij in the order 00, 01, 02, 11, 12, 22.
    """
    for t in range(g.shape[0]):
        a0, a1, a2 = g[t, 0], g[t, 1], g[t, 2]
        length = np.sqrt(a1 * a1 + a2 * a2)
        turn = complex(a1, a2) / length if length > 0 else complex(1.0, 0.0)
        power = complex(weight[t], 0.0)
        for k in range(out.shape[1]):
            out[0, k] += power * (a0 * a0)
            out[1, k] += power * (a0 * a1)
            out[2, k] += power * (a0 * a2)
            out[3, k] += power * (a1 * a1)
            out[4, k] += power * (a1 * a2)
            out[5, k] += power * (a2 * a2)
            power *= turn


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def interpolate_periodic(table: F64, phase: F64) -> F64:
    """Linear interpolation of tables (n, size) over one turn at phases (p,), rad: (n, p)."""
    n, size = table.shape
    out = np.empty((n, phase.size))
    per_rad = size / (2 * np.pi)
    for p in range(phase.size):
        at = phase[p] * per_rad
        first = np.floor(at)
        part = at - first
        i = int(first) % size
        j = i + 1 if i + 1 < size else 0
        for k in range(n):
            out[k, p] = table[k, i] * (1 - part) + table[k, j] * part
    return out
