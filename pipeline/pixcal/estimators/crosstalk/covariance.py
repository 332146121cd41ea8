"""Couplings from the noise: neighbours that share charge share its shot noise.

With D the variance of a pixel's charge and k the share that it gives to a partner (primes: the
partner's),

    cov(p, p') = k D + k' D' + constant + b D D' + c (D² + D'²)

The constant is noise that neighbours share without light (of a row, a column, the whole frame);
bias frames measure it. Brighter-fatter makes a covariance that rises with the square of the level
(b and c are free, the same for all pixels). Flats give k + k' only; in fringes D and D' differ,
which separates the two.

The products of residuals are summed pixel by pixel, so that they can be combined into classes of
any period later.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pixcal.estimators.crosstalk.links import Place
from pixcal.estimators.crosstalk.residuals import STRIDE, UNIT, Residuals, all_residuals
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels import inner, kernel
from pixcal.kernels.crosstalk import Coupling
from pixcal.model.arrays import F32, F64, Indices

Frames = tuple[F32, F32, F32]  # factor, charge over sigma, and one over sigma, all (t, y, x)

# least charge (10⁴ e-) of usable light; less is enough where its shot noise variance is this many
# times that without light
MIN_CHARGE, ABOVE_READ = 0.1, 4.0
TINY = np.float32(1e-20)
TERMS = 5  # D, D', 1, D D', D² + D'²
# index of the normal sum of each two terms; terms 2 and 3 share theirs with 0 and 1
NORMAL = np.array([
    [0, 1, 3, 6, 9],
    [1, 2, 4, 7, 10],
    [3, 4, 5, 1, 11],
    [6, 7, 1, 8, 12],
    [9, 10, 11, 12, 13],
])  # fmt: skip
NORMALS = 14


@dataclass(frozen=True)
class Products:
    """Sums over frames for each link and pixel; zero where the partner is out of the window."""

    right: F32  # (link, 5, y, x) products of residuals with each of the `TERMS`; charge in 10⁴ e-
    normal: F32  # (link, 14, y, x) of the terms with each other, in the order of `NORMAL`
    # shot, shot_error: measured variance of a pixel over its shot noise: 1 for the right gain
    shot: float
    shot_error: float
    # curve, curve_error: relative change of that variance with the charge, 1/(10⁴ e-)
    curve: float
    curve_error: float
    read: float  # variance of a pixel without light


def products(
    evidence: Evidence, links: Sequence[Place], known: Sequence[Coupling] = ()
) -> Products | None:
    """Sum the products of neighbours over all frames; None where no frames have light."""
    ny, nx = evidence.good.shape
    steps = np.array(links, int).reshape(-1, 2)
    right = np.zeros((len(links), TERMS, ny, nx), np.float32)
    normal = np.zeros((len(links), NORMALS, ny, nx), np.float32)
    line, line_right = np.zeros((3, 3)), np.zeros(3)
    brightest = 0.0
    for parts in _gathered(all_residuals(evidence, known)):
        for part in parts:
            brightest = max(brightest, part.brightness)
            own, own_right = _variance(part)
            line, line_right = line + own, line_right + own_right
        _add(parts, steps, right, normal)
        # Freed before the next ones, as they are large.
        del parts, part
    if brightest < min(MIN_CHARGE, ABOVE_READ * evidence.read_noise**2 / UNIT):
        return None
    covariance = np.linalg.pinv(line, rcond=1e-12, hermitian=True)
    shot, _, curved = (float(v) for v in covariance @ line_right)
    error, _, curved_error = (float(v) for v in np.sqrt(2 * np.diag(covariance)))
    read = evidence.read_noise**2 / UNIT
    return Products(right, normal, shot, error, curved / shot, curved_error / shot, read)


def _add(parts: Sequence[Residuals], steps: Indices, right: F32, normal: F32) -> None:
    noise = [frames for p in parts for frames in ((p.e, p.charge, p.one), p.taken)]
    for piece in _pieces(noise):
        _add_right_sums(*_powers(piece, 2), steps, right)
    for piece in _pieces([_weights(p) for p in parts]):
        _add_normal_sums(*_powers(piece, 4), steps, normal)


def _weights(part: Residuals) -> Frames:
    """Frames whose products are the normal sums; one stands for all with the same charge."""
    if not part.steady:
        return part.one, part.charge, part.one
    one = part.one.max(axis=0, keepdims=True)
    # Both pixels of a pair count in a share of the frames; in all if neither is ever clipped.
    weight = (part.one**2).sum(axis=0, keepdims=True) / np.float32(np.sqrt(len(part.one)))
    return weight / np.maximum(one, TINY), part.charge.max(axis=0, keepdims=True), one


_FAST = {"reassoc", "contract", "nsz", "arcp"}
_LONG = 128  # frames up to which sequences are gathered
_COLUMNS = 16  # columns processed at a time: with their partners they stay in the cache


def _gathered(parts: Iterable[Residuals]) -> Iterator[list[Residuals]]:
    """Short sequences together, as sums over few frames cost as much; long ones one by one."""
    some: list[Residuals] = []
    for part in parts:
        if some and sum(len(p.e) for p in [*some, part]) > _LONG:
            yield some
            some = []
        some.append(part)
        if len(part.e) >= _LONG:
            # Freed before the next one, which is as large.
            del part
            yield some
            some = []
    if some:
        yield some


def _pieces(parts: Sequence[Frames]) -> Iterator[Sequence[Frames]]:
    """Short sequences together and long ones in pieces, to limit the memory for powers."""
    if short := [part for part in parts if len(part[0]) <= _LONG]:
        yield short
    for e, charge, one in parts:
        if len(e) > _LONG:
            for n in range(0, len(e), _LONG):
                piece = slice(n, n + _LONG)
                yield [(e[piece], charge[piece], one[piece])]


def _powers(parts: Sequence[Frames], highest: int) -> tuple[F32, ...]:
    """Factors over sigma, times the charge to the powers 0, 1, ...; one sequence after the other.

    From (factor, charge over sigma, one over sigma), all (t, y, x), to (y, x, t).
    """
    count = sum(len(factor) for factor, _, _ in parts)
    found = np.empty((highest + 1, *parts[0][0].shape[1:], count), np.float32)
    first = 0
    for factor, charge, one in parts:
        # Row by row, to limit the memory for intermediate arrays.
        for y in range(one.shape[1]):
            value = factor[:, y] * one[:, y]
            ratio = charge[:, y] / np.maximum(one[:, y], TINY)
            for power in found[:, y, :, first : first + len(factor)]:
                power[...] = value.T
                value *= ratio
        first += len(factor)
    return tuple(found)


@inner()
def _add_pixels(sums: F32, y: int, first: int, out: F32) -> None:
    """Add sums (pixel, link, n) of a row, from column ``first`` on, to all (link, n, y, x)."""
    count = min(len(sums), out.shape[3] - first)
    for n in range(out.shape[0]):
        for i in range(out.shape[1]):
            for x in range(count):
                out[n, i, y, first + x] += sums[x, n, i]


@kernel(fastmath=_FAST)
def _add_right_sums(e0: F32, e1: F32, e2: F32, links: Any, right: F32) -> None:
    """Add to the sums (link, 5, y, x), of powers of the charge times residuals (y, x, t)."""
    ny, nx, nt = e0.shape
    sums = np.empty((_COLUMNS, len(links), 5), np.float32)
    for first in range(0, nx, _COLUMNS):
        for y in range(ny):
            sums[:] = 0
            for x in range(first, min(first + _COLUMNS, nx)):
                a0, a1, a2 = e0[y, x], e1[y, x], e2[y, x]
                for n in range(len(links)):
                    v, u = y + links[n, 0], x + links[n, 1]
                    if v >= ny or u < 0 or u >= nx:
                        continue
                    b0, b1, b2 = e0[v, u], e1[v, u], e2[v, u]
                    s10 = s01 = s00 = s11 = both20 = np.float32(0)
                    for t in range(nt):
                        s10 += a1[t] * b0[t]
                        s01 += a0[t] * b1[t]
                        s00 += a0[t] * b0[t]
                        s11 += a1[t] * b1[t]
                        both20 += a2[t] * b0[t] + a0[t] * b2[t]
                    for i, value in enumerate((s10, s01, s00, s11, both20)):
                        sums[x - first, n, i] = value
            _add_pixels(sums, y, first, right)


@kernel(fastmath=_FAST)
def _add_normal_sums(w0: F32, w1: F32, w2: F32, w3: F32, w4: F32, links: Any, normal: F32) -> None:
    """Add to the sums (link, 14, y, x), of powers of the charge over the variance (y, x, t)."""
    ny, nx, nt = w0.shape
    sums = np.empty((_COLUMNS, len(links), NORMALS), np.float32)
    for first in range(0, nx, _COLUMNS):
        for y in range(ny):
            sums[:] = 0
            for x in range(first, min(first + _COLUMNS, nx)):
                a0, a1, a2, a3, a4 = w0[y, x], w1[y, x], w2[y, x], w3[y, x], w4[y, x]
                for n in range(len(links)):
                    v, u = y + links[n, 0], x + links[n, 1]
                    if v >= ny or u < 0 or u >= nx:
                        continue
                    b0, b1, b2, b3, b4 = w0[v, u], w1[v, u], w2[v, u], w3[v, u], w4[v, u]
                    s00 = s10 = s01 = s20 = s11 = s02 = np.float32(0)
                    s21 = s12 = s22 = s30 = s03 = both31 = both40 = np.float32(0)
                    for t in range(nt):
                        s00 += a0[t] * b0[t]
                        s10 += a1[t] * b0[t]
                        s01 += a0[t] * b1[t]
                        s20 += a2[t] * b0[t]
                        s11 += a1[t] * b1[t]
                        s02 += a0[t] * b2[t]
                        s21 += a2[t] * b1[t]
                        s12 += a1[t] * b2[t]
                        s22 += a2[t] * b2[t]
                        s30 += a3[t] * b0[t]
                        s03 += a0[t] * b3[t]
                        both31 += a3[t] * b1[t] + a1[t] * b3[t]
                        both40 += a4[t] * b0[t] + a0[t] * b4[t]
                    found = (
                        s20, s11, s02, s10, s01, s00, s21, s12, s22, s30 + s12, s21 + s03,
                        s20 + s02, both31, both40 + np.float32(2) * s22,
                    )  # fmt: skip
                    for i, value in enumerate(found):
                        sums[x - first, n, i] = value
            _add_pixels(sums, y, first, normal)


def _variance(part: Residuals) -> tuple[F64, F64]:
    """Sums of the variance of single pixels against shot noise, a constant and its square."""
    # The squares of the modes are the variance that was removed from the residuals.
    terms = np.stack([part.shot * part.one, part.one**2, part.shot**2]).reshape(3, -1)
    some = terms.reshape(3, *part.one.shape)[:, ::STRIDE].reshape(3, -1)
    removed_variance = (part.modes**2).sum(axis=0).ravel()
    right = terms @ (part.e**2).ravel() + some @ removed_variance
    return (terms @ terms.T).astype(float), right.astype(float)
