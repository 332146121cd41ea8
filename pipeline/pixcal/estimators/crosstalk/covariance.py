"""Couplings from the noise: neighbours that share charge share its shot noise.

With the variance D of the charge of a pixel and k the share that it gives to a partner, primes for
the partner,

    cov(p, p') = k D + k' D' + constant + b D D' + c (D² + D'²)

The constant takes up noise that neighbours have in common without light (of a row, a column, the
whole frame); bias frames measure it. Covariance that rises with the square of the level is what
brighter-fatter makes (b and c are free, the same for all pixels). Flats give k + k' only; in
fringes D and D' differ, and the two are told apart.

The products of residuals are summed pixel by pixel, so that they can be joined to classes of any
period later.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pixcal.estimators.crosstalk.links import Place
from pixcal.estimators.crosstalk.residuals import STRIDE, UNIT, Residuals, all_residuals
from pixcal.estimators.evidence import Evidence
from pixcal.kernels.crosstalk import Coupling

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

MIN_CHARGE = 0.1
"""Charge (10⁴ e-) of the least light whose noise can tell."""

TINY = np.float32(1e-20)
TERMS = 5
"""D, D', 1, D D', D² + D'²."""
NORMAL = {(0, 0): 0, (0, 1): 1, (1, 1): 2, (0, 2): 3, (1, 2): 4, (2, 2): 5, (0, 3): 6,
          (1, 3): 7, (3, 3): 8, (2, 3): 1, (0, 4): 9, (1, 4): 10, (2, 4): 11, (3, 4): 12,
          (4, 4): 13}  # fmt: skip
"""Place of each normal sum; terms 2 and 3 meet in the same sum as 0 and 1."""
NORMALS = 14


@dataclass(frozen=True)
class Products:
    """Sums over frames for each link and pixel (zero where the partner is out of the window).

    Attributes
    ----------
    right : (link, 5, y, x) float64
        Products of residuals with each of the `TERMS`; charge in 10⁴ e-.
    normal : (link, 14, y, x) float64
        Of the terms with each other, in the order of `NORMAL`.
    shot, shot_error : float
        Variance of a pixel over what its charge gives, as measured: 1 for the right gain.
    read : float
        Variance of a pixel without light.
    """

    right: F64
    normal: F64
    shot: float
    shot_error: float
    read: float


def products(
    evidence: Evidence, links: Sequence[Place], known: Sequence[Coupling] = ()
) -> Products | None:
    """Sum the products of neighbours over all frames; None where no frames have light.

    Parameters
    ----------
    evidence : Evidence
    links : sequence of (int, int)
    known : sequence of Coupling
        What is known of the couplings, by which the charge collected follows from what is read.
    """
    ny, nx = evidence.good.shape
    right = np.zeros((len(links), TERMS, ny, nx))
    normal = np.zeros((len(links), NORMALS, ny, nx))
    line, line_right = np.zeros((3, 3)), np.zeros(3)
    brightest = 0.0
    for part in all_residuals(evidence, known):
        brightest = max(brightest, part.brightness)
        own, own_right = _variance(part)
        line, line_right = line + own, line_right + own_right
        noise, terms = _factors(part.e, part.charge, part.one)
        modes, _ = _factors(*part.taken)
        for n, (dy, dx) in enumerate(links):
            _right_sums(*noise, dy, dx, right[n])
            _right_sums(*modes, dy, dx, right[n])
            _normal_sums(*terms, dy, dx, normal[n])
        # Not beside the next one: each is large.
        del part, noise, terms, modes
    if brightest < MIN_CHARGE:
        return None
    covariance = np.linalg.pinv(line, rcond=1e-12, hermitian=True)
    shot, error = float((covariance @ line_right)[0]), float(np.sqrt(2 * covariance[0, 0]))
    return Products(right, normal, shot, error, evidence.read_noise**2 / UNIT)


def _factors(e: F32, charge: F32, one: F32) -> tuple[tuple[F32, ...], tuple[F32, ...]]:
    """What products of residuals are sums of, and what products of terms are; all (y, x, t)."""
    e, p, g = (np.ascontiguousarray(a.transpose(1, 2, 0)) for a in (e, charge, one))
    h = (p * p / np.maximum(g, TINY)).astype(np.float32)
    return (e * p, e * g, e * h), (p * p, p * g, g * g, p * h, g * h, h * h)


_FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(cache=True, nogil=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _right_sums(ep: Any, eg: Any, eh: Any, dy: int, dx: int, right: Any) -> None:
    ny, nx, nt = ep.shape
    for y in range(ny - dy):
        for x in range(max(0, -dx), min(nx, nx - dx)):
            v, j = y + dy, x + dx
            r0 = r1 = r2 = r3 = r4 = np.float32(0)
            for t in range(nt):
                r0 += ep[y, x, t] * eg[v, j, t]
                r1 += eg[y, x, t] * ep[v, j, t]
                r2 += eg[y, x, t] * eg[v, j, t]
                r3 += ep[y, x, t] * ep[v, j, t]
                r4 += eh[y, x, t] * eg[v, j, t] + eg[y, x, t] * eh[v, j, t]
            right[0, y, x] += r0
            right[1, y, x] += r1
            right[2, y, x] += r2
            right[3, y, x] += r3
            right[4, y, x] += r4


@njit(cache=True, nogil=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _normal_sums(
    pp: Any, pg: Any, gg: Any, ph: Any, gh: Any, hh: Any, dy: int, dx: int, normal: Any
) -> None:
    ny, nx, nt = pp.shape
    for y in range(ny - dy):
        for x in range(max(0, -dx), min(nx, nx - dx)):
            v, j = y + dy, x + dx
            n0 = n1 = n2 = n3 = n4 = n5 = n6 = n7 = n8 = np.float32(0)
            m0 = m1 = m2 = m3 = m4 = np.float32(0)
            for t in range(nt):
                n0 += pp[y, x, t] * gg[v, j, t]
                n1 += pg[y, x, t] * pg[v, j, t]
                n2 += gg[y, x, t] * pp[v, j, t]
                n3 += pg[y, x, t] * gg[v, j, t]
                n4 += gg[y, x, t] * pg[v, j, t]
                n5 += gg[y, x, t] * gg[v, j, t]
                n6 += pp[y, x, t] * pg[v, j, t]
                n7 += pg[y, x, t] * pp[v, j, t]
                n8 += pp[y, x, t] * pp[v, j, t]
            for t in range(nt):
                m0 += ph[y, x, t] * gg[v, j, t] + pg[y, x, t] * gh[v, j, t]
                m1 += gh[y, x, t] * pg[v, j, t] + gg[y, x, t] * ph[v, j, t]
                m2 += gh[y, x, t] * gg[v, j, t] + gg[y, x, t] * gh[v, j, t]
                m3 += ph[y, x, t] * pg[v, j, t] + pg[y, x, t] * ph[v, j, t]
                m4 += hh[y, x, t] * gg[v, j, t] + gg[y, x, t] * hh[v, j, t]
                m4 += np.float32(2) * gh[y, x, t] * gh[v, j, t]
            normal[0, y, x] += n0
            normal[1, y, x] += n1
            normal[2, y, x] += n2
            normal[3, y, x] += n3
            normal[4, y, x] += n4
            normal[5, y, x] += n5
            normal[6, y, x] += n6
            normal[7, y, x] += n7
            normal[8, y, x] += n8
            normal[9, y, x] += m0
            normal[10, y, x] += m1
            normal[11, y, x] += m2
            normal[12, y, x] += m3
            normal[13, y, x] += m4


def _variance(part: Residuals) -> tuple[F64, F64]:
    """Sums of the variance of single pixels against shot noise, a constant and its square.

    The modes' own squares are what the residuals were robbed of.
    """
    terms = np.stack([part.shot * part.one, part.one**2, part.shot**2]).reshape(3, -1)
    some = terms.reshape(3, *part.one.shape)[:, ::STRIDE].reshape(3, -1)
    robbed = (part.modes**2).sum(axis=0).ravel()
    right = terms @ (part.e**2).ravel() + some @ robbed
    return (terms @ terms.T).astype(float), right.astype(float)
