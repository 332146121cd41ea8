"""Compiled sums of the bilinear fringe model, in one file so that Numba's cache notices changes.

The model (paper, equation 2; physics note, section 2) is linear in the pixel's parameters if the
frame's are known, and vice versa::

    I[t, p] = theta[p] . g[t]     theta = (iota, alpha sin psi, alpha cos psi)
                                  g     = (B, A cos phi, A sin phi)

A change dk of a frame's fringe vector changes its phase by ``dk . r``. Samples are stored codes
``electrons = scale * code + offset``; a sample's variance is ``shot * model + read``, from
the model, never from the noisy sample (physics note, section 3).

Sums are of the residual from a start model, so that float32 is precise enough.
"""

from typing import Any

import numpy as np

from pixcal.kernels import inner, kernel
from pixcal.model.arrays import F32, F64, I64

# sums kept for each pixel: 6 normal, 3 right-hand, weighted square of the residual, samples
N_SUMS = 11
GAP, GOES_ON = -1, -2  # no batch; see `sweep_batches`
# least determinant over the product of the diagonal; without three phases it is zero up to rounding
SINGULAR = 1e-9
FAST = {"reassoc", "contract", "nsz", "arcp", "afn"}


@inner(fastmath=FAST, error_model="numpy")
def _sweep_row(
    codes: Any, row: int, scale: float, offset: float, fill: float, g: Any,
    dk: Any, y: float, x0: float,
    t0: Any, t1: Any, t2: Any, read: Any, shot: Any,
    n00: Any, n01: Any, n02: Any, n11: Any, n12: Any, n22: Any,
    b0: Any, b1: Any, b2: Any, rr: Any,
) -> None:  # fmt: skip
    # One array per sum and few others: LLVM then proves that none overlap and vectorises over i;
    # with a few more arrays it does not (6 times slower).
    one, zero, half = np.float32(1), np.float32(0), np.float32(0.5)
    for t in range(codes.shape[0]):
        a0, c1, c2 = g[t, 0], g[t, 1], g[t, 2]
        kx = dk[t, 0]
        u0 = dk[t, 1] * y + kx * x0
        for i in range(codes.shape[2]):
            u = kx * np.float32(i) + u0
            co = one - half * u * u
            a1 = c1 * co - c2 * u
            a2 = c2 * co + c1 * u
            code = np.float32(codes[t, row, i])
            model = t0[i] * a0 + t1[i] * a1 + t2[i] * a2
            w = (one if code != fill else zero) / (shot[i] * max(model, zero) + read[i])
            r = scale * code + offset - model
            wr, w0, w1 = w * r, w * a0, w * a1
            n00[i] += w0 * a0
            n01[i] += w0 * a1
            n02[i] += w0 * a2
            n11[i] += w1 * a1
            n12[i] += w1 * a2
            n22[i] += w * a2 * a2
            b0[i] += wr * a0
            b1[i] += wr * a1
            b2[i] += wr * a2
            rr[i] += wr * r


@inner(fastmath=FAST, error_model="numpy")
def _sweep_still_row(
    codes: Any, row: int, scale: float, offset: float, fill: float, g: Any,
    t0: Any, t1: Any, t2: Any, read: Any, shot: Any,
    n00: Any, n01: Any, n02: Any, n11: Any, n12: Any, n22: Any,
    b0: Any, b1: Any, b2: Any, rr: Any,
) -> None:  # fmt: skip
    # The same for a constant fringe vector: half the operations.
    one, zero = np.float32(1), np.float32(0)
    for t in range(codes.shape[0]):
        a0, a1, a2 = g[t, 0], g[t, 1], g[t, 2]
        a00, a01, a02, a11, a12, a22 = a0 * a0, a0 * a1, a0 * a2, a1 * a1, a1 * a2, a2 * a2
        for i in range(codes.shape[2]):
            code = np.float32(codes[t, row, i])
            model = t0[i] * a0 + t1[i] * a1 + t2[i] * a2
            w = (one if code != fill else zero) / (shot[i] * max(model, zero) + read[i])
            r = scale * code + offset - model
            wr = w * r
            n00[i] += w * a00
            n01[i] += w * a01
            n02[i] += w * a02
            n11[i] += w * a11
            n12[i] += w * a12
            n22[i] += w * a22
            b0[i] += wr * a0
            b1[i] += wr * a1
            b2[i] += wr * a2
            rr[i] += wr * r


@inner()
def _count_row(codes: Any, row: int, fill: int, count: Any) -> None:
    for t in range(codes.shape[0]):
        for i in range(codes.shape[2]):
            count[i] += np.float32(codes[t, row, i] != fill)


@inner()
def _pour(part: Any, total: Any) -> None:
    """Add sums to others, and reset them."""
    for k in range(part.shape[0]):
        for i in range(part.shape[1]):
            total[k, i] += part[k, i]
            part[k, i] = 0


GROUP = 1024  # pixels summed at a time, so that their data stay in the first-level cache


@kernel()
def frame_sums(
    codes: F32,
    scale: float,
    offset: float,
    fill: int,
    g: F32,
    dk: F32,
    y: F32,
    x: F32,
    theta: F32,
    read: F32,
    shot: F32,
    normal: F64,
    right: F64,
) -> None:
    """Add scattered pixels to the weighted sums of every frame, for g and the fringe vector.

    codes : (t, p) float32 stored samples of p pixels; another type would be compiled again
    g, dk : (t, 3), (t, 2) float32, current frame parameters, which define the residuals
    y, x : (p,) pixel coordinates relative to the point where ``g`` holds, px
    theta, read, shot : (3, p), (p,), (p,) float32, as in `sweep_batches`
    normal : (t, 15) added to: upper triangle, by row, for (g0, g1, g2, dkx, dky)
    right : (t, 5) added to: right-hand sides
    """
    s, o, f = np.float32(scale), np.float32(offset), np.float32(fill)
    n = codes.shape[1]
    kept = np.empty((5, GROUP), np.float32)
    for first in range(0, n, GROUP):
        stop = min(first + GROUP, n)
        m = stop - first
        h1, h2, turn, w, wr = kept[0, :m], kept[1, :m], kept[2, :m], kept[3, :m], kept[4, :m]
        h0, t1, t2 = theta[0, first:stop], theta[1, first:stop], theta[2, first:stop]
        xs, ys, shots, reads = x[first:stop], y[first:stop], shot[first:stop], read[first:stop]
        for t in range(codes.shape[0]):
            kx, ky = dk[t, 0], dk[t, 1]
            if kx == 0 and ky == 0:
                for i in range(m):
                    h1[i], h2[i] = t1[i], t2[i]
            else:
                _turn_pixels(t1, t2, kx, ky, ys, xs, h1, h2)
            _weigh_pixels(
                codes[t, first:stop], s, o, f, g[t, 0], g[t, 1], g[t, 2],
                h0, h1, h2, reads, shots, turn, w, wr,
            )  # fmt: skip
            add_normal(h0, h1, h2, turn, w, ys, xs, normal[t])
            add_right(h0, h1, h2, turn, wr, ys, xs, right[t])


# Separate loops: a single one would need more registers than there are, and take three times as
# long.


@inner(fastmath=FAST, error_model="numpy")
def _turn_pixels(t1: Any, t2: Any, kx: float, ky: float, y: Any, x: Any, h1: Any, h2: Any) -> None:
    one, two, half = np.float32(1), np.float32(2), np.float32(0.5)
    sixth, fourth = np.float32(1 / 6), np.float32(1 / 24)
    fifth, tenth = np.float32(1 / 120), np.float32(1 / 720)
    eighth, turn_length = np.float32(0.125), np.float32(2 * np.pi)
    for i in range(x.size):
        # cos and sin of any u by halving it three times, as calls are not vectorised.
        u = kx * x[i] + ky * y[i]
        u = (u - turn_length * np.rint(u / turn_length)) * eighth
        v = u * u
        si = u * (one - v * (sixth - v * fifth))
        co = one - v * (half - v * (fourth - v * tenth))
        si, co = two * si * co, one - two * si * si
        si, co = two * si * co, one - two * si * si
        si, co = two * si * co, one - two * si * si
        h1[i] = t1[i] * co + t2[i] * si
        h2[i] = t2[i] * co - t1[i] * si


@inner(fastmath=FAST, error_model="numpy")
def _weigh_pixels(
    codes: Any, s: float, o: float, f: float, g0: float, c1: float, c2: float,
    h0: Any, h1: Any, h2: Any, read: Any, shot: Any, turn: Any, w: Any, wr: Any,
) -> None:  # fmt: skip
    one, zero = np.float32(1), np.float32(0)
    for i in range(codes.size):
        model = h0[i] * g0 + h1[i] * c1 + h2[i] * c2
        turn[i] = h2[i] * c1 - h1[i] * c2
        code = np.float32(codes[i])
        weight = (one if code != f else zero) / (shot[i] * max(model, zero) + read[i])
        w[i] = weight
        wr[i] = weight * (s * code + o - model)


@inner(fastmath=FAST, error_model="numpy")
def add_normal(h0: Any, h1: Any, h2: Any, turn: Any, w: Any, y: Any, x: Any, normal: Any) -> None:
    """Add pixels to the normal matrix (15 numbers) of g and dk; see `frame_sums`.

    ``turn`` is the derivative of the model with respect to the phase, ``w`` the weight.
    """
    zero = np.float32(0)
    q00 = q01 = q02 = q0x = q0y = zero
    q11 = q12 = q1x = q1y = q22 = q2x = q2y = qxx = qxy = qyy = zero
    for i in range(w.size):
        a0, a1, a2 = h0[i], h1[i], h2[i]
        ax, ay = turn[i] * x[i], turn[i] * y[i]
        w0, w1, w2, wx = w[i] * a0, w[i] * a1, w[i] * a2, w[i] * ax
        q00 += w0 * a0
        q01 += w0 * a1
        q02 += w0 * a2
        q0x += w0 * ax
        q0y += w0 * ay
        q11 += w1 * a1
        q12 += w1 * a2
        q1x += w1 * ax
        q1y += w1 * ay
        q22 += w2 * a2
        q2x += w2 * ax
        q2y += w2 * ay
        qxx += wx * ax
        qxy += wx * ay
        qyy += w[i] * ay * ay
    for k, q in enumerate(
        (q00, q01, q02, q0x, q0y, q11, q12, q1x, q1y, q22, q2x, q2y, qxx, qxy, qyy)
    ):
        normal[k] += q


@inner(fastmath=FAST, error_model="numpy")
def add_right(
    h0: Any, h1: Any, h2: Any, turn: Any, weighted: Any, y: Any, x: Any, right: Any
) -> None:
    """Add pixels to the right-hand sides (5) of g and dk; ``weighted`` is weight times residual."""
    r0 = r1 = r2 = rx = ry = np.float32(0)
    for i in range(weighted.size):
        value = weighted[i]
        turned = value * turn[i]
        r0 += value * h0[i]
        r1 += value * h1[i]
        r2 += value * h2[i]
        rx += turned * x[i]
        ry += turned * y[i]
    for k, r in enumerate((r0, r1, r2, rx, ry)):
        right[k] += r


def solve_pixels(sums: F64) -> tuple[F64, F64, F64]:
    """Solve the pixels' 3 x 3 systems.

    ``sums``: (10 or more, ...) as in `sweep_batches`. Returns the correction to the start model (3,
    ...), NaN where undetermined; the upper triangle (6, ...) of the covariance of theta; and the
    weighted square (...) of the remaining residual.
    """
    ten = np.asarray(sums[:10], float)
    out = np.empty(ten.shape)
    _solve(ten.reshape(10, -1), out.reshape(10, -1))
    return out[:3], out[3:9], out[9]


@kernel(error_model="numpy")
def _solve(sums: F64, out: F64) -> None:
    for i in range(sums.shape[1]):
        a, b, c, d, e, f = sums[0, i], sums[1, i], sums[2, i], sums[3, i], sums[4, i], sums[5, i]
        r0, r1, r2 = sums[6, i], sums[7, i], sums[8, i]
        i00, i01, i02, i11, i12, i22, det = _adjugate(a, b, c, d, e, f)
        det = det if det > SINGULAR * a * d * f else np.nan
        i00, i01, i02 = i00 / det, i01 / det, i02 / det
        i11, i12, i22 = i11 / det, i12 / det, i22 / det
        s0 = i00 * r0 + i01 * r1 + i02 * r2
        s1 = i01 * r0 + i11 * r1 + i12 * r2
        s2 = i02 * r0 + i12 * r1 + i22 * r2
        out[0, i], out[1, i], out[2, i] = s0, s1, s2
        out[3, i], out[4, i], out[5, i] = i00, i01, i02
        out[6, i], out[7, i], out[8, i] = i11, i12, i22
        out[9, i] = sums[9, i] - (s0 * r0 + s1 * r1 + s2 * r2)


@inner(inline="always")
def _adjugate(a: float, b: float, c: float, d: float, e: float, f: float) -> Any:
    """Upper triangle of a pixel's inverse normal matrix times its determinant; the determinant."""
    i00, i01, i02 = d * f - e * e, c * e - b * f, b * e - c * d
    i11, i12, i22 = a * f - c * c, b * c - a * e, a * d - b * b
    return i00, i01, i02, i11, i12, i22, a * i00 + b * i01 + c * i02


@inner(inline="always")
def _fringe(
    n00: float, n01: float, n02: float, n11: float, n12: float, n22: float,
    b0: float, b1: float, b2: float, m1: float, m2: float,
) -> Any:  # fmt: skip
    """Fringe phasor of a pixel across and along that of the model; variance of its phase."""
    _, i01, i02, i11, i12, i22, det = _adjugate(n00, n01, n02, n11, n12, n22)
    inverse = 1.0 / det if det > SINGULAR * n00 * n11 * n22 else np.nan
    s = m1 + (i01 * b0 + i11 * b1 + i12 * b2) * inverse
    c = m2 + (i02 * b0 + i12 * b1 + i22 * b2) * inverse
    square = s * s + c * c
    variance = (c * c * i11 - 2 * c * s * i12 + s * s * i22) * inverse / (square * square)
    return s * m2 - c * m1, c * m2 + s * m1, variance


@inner(fastmath=FAST, error_model="numpy")
def _close_pixels(
    n00: Any, n01: Any, n02: Any, n11: Any, n12: Any, n22: Any, b0: Any, b1: Any, b2: Any,
    m1: Any, m2: Any, turn: Any, sigma: Any,
) -> None:  # fmt: skip
    # One array per sum, as in `_sweep_row`.
    far = False
    for i in range(turn.size):
        across, along, variance = _fringe(
            n00[i], n01[i], n02[i], n11[i], n12[i], n22[i], b0[i], b1[i], b2[i], m1[i], m2[i]
        )
        # Series of the arc tangent, accurate to 2e-8 rad for arguments up to 1/4.
        q = across / along
        z = q * q
        turn[i] = q * (1 - z * (1 / 3 - z * (1 / 5 - z * (1 / 7 - z / 9))))
        sigma[i] = np.sqrt(max(variance, 0.0))
        far |= not (along > 0 and z < 0.0625)
    if far:
        for i in range(turn.size):
            across, along, _ = _fringe(
                n00[i], n01[i], n02[i], n11[i], n12[i], n22[i], b0[i], b1[i], b2[i], m1[i], m2[i]
            )
            turn[i] = np.arctan2(across, along)


@kernel()
def sweep_batches(
    codes: Any,
    scale: float,
    offset: float,
    fill: int,
    g: F32,
    dk: F32,
    y0: float,
    x0: float,
    theta: F32,
    read: F32,
    shot: F32,
    stops: I64,
    closes: I64,
    part: F64,
    total: F64,
    turn: F32,
    sigma: F32,
) -> None:
    """Add a block of frames to the sums of batches, and full batches to the sums of the run.

    Row by row, so that a row's sums stay in the first-level cache for any number of batches. The
    sums are: normal 00, 01, 02, 11, 12, 22; right-hand 0 to 2 (of the residual from the start
    model), its weighted square; number of samples.

    codes : (t, y, x) unsigned int stored samples; ``fill`` has no weight
    scale, offset : electrons of a code
    g : (t, 3) float32 frame parameters at the tile's centre
    dk : (t, 2) float32 change of the fringe vector (x, y), rad/px; used to second order
    y0, x0 : the tile's first pixel relative to its centre, px
    theta : (3, y, x) float32 start model, e-
    read, shot : (y, x) float32 variance of a sample: ``shot * model + read``, e-²
    stops : (n,) frames of the block at which its sums are cut; the last is their number. Steps
        are at most some 100 frames, so that sums in float32 keep their precision
    closes : (n,) batch that ends there; `GAP` at the end of a gap, `GOES_ON` if nothing ends
    part, total : (y, N_SUMS, x) sums of the current batch, and of all that have ended; added to
    turn, sigma : (batch, y, x) written: phase of a batch relative to the start model and its error,
        rad; NaN where it does not determine all three unknowns
    """
    s, o, f, left = np.float32(scale), np.float32(offset), np.float32(fill), np.float32(x0)
    # Loops instead of numpy's functions, which take longer to compile.
    moving = False
    for t in range(dk.shape[0]):
        moving |= dk[t, 0] != 0 or dk[t, 1] != 0
    p = np.empty((N_SUMS, codes.shape[2]), np.float32)
    for k in range(N_SUMS):
        for i in range(codes.shape[2]):
            p[k, i] = 0
    for row in range(codes.shape[1]):
        t0, t1, t2 = theta[0, row], theta[1, row], theta[2, row]
        q, whole = part[row], total[row]
        first = 0
        for n in range(stops.size):
            stop = stops[n]
            block, frames = codes[first:stop], g[first:stop]
            if moving:
                _sweep_row(
                    block, row, s, o, f, frames, dk[first:stop], np.float32(y0 + row), left,
                    t0, t1, t2, read[row], shot[row],
                    p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9],
                )  # fmt: skip
            else:
                _sweep_still_row(
                    block, row, s, o, f, frames, t0, t1, t2, read[row], shot[row],
                    p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9],
                )  # fmt: skip
            _count_row(block, row, fill, p[10])
            _pour(p, q)
            first = stop
            if closes[n] == GOES_ON:
                continue
            if closes[n] != GAP:
                _close_pixels(
                    q[0], q[1], q[2], q[3], q[4], q[5], q[6], q[7], q[8], t1, t2,
                    turn[closes[n], row], sigma[closes[n], row],
                )  # fmt: skip
            _pour(q, whole)
