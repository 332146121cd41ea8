"""Couplings from the noise: neighbours that share charge share its shot noise.

With D the variance of a pixel's charge and k the share that it gives to a partner (primes: the
partner's),

    cov(p, p') = k D + k' D' + constant + b (D² + D'²) / 2

The constant is noise that neighbours share without light (of a row, a column, the whole frame);
bias frames measure it. The quadratic term describes boundaries shifted by charge (brighter-fatter),
and shares that change with the level. Flats give k + k' only; in fringes D and D' differ, which
separates the two.

The products of residuals are summed pixel by pixel, so that they can be combined into classes of
any period later.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from pixcal.estimators.crosstalk.links import Place
from pixcal.estimators.crosstalk.residuals import MAX_SAMPLES, UNIT, Residuals, all_residuals
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.crosstalk import Coupling
from pixcal.kernels.normal_matrix import inverse_normal, symmetric
from pixcal.model.arrays import F32, F64, Mask

Frames = tuple[F32, F32, Mask]  # values and charges (t, n) of the pixels of a mask (y, x)

# least charge (10⁴ e-) of usable light; less is enough where its shot noise variance is this many
# times that without light
MIN_CHARGE, ABOVE_READ = 0.1, 4.0
# prior 1-sigma of the covariance of neighbours over the square of their charge, 1/e-
BRIGHTER_FATTER = 1e-6
# Terms k, k', constant, b: (term, i, j) coefficients of the powers i and j of D and D'; and
# products of each two terms, packed as in `symmetric`
TERMS = np.zeros((4, 3, 3), np.float32)
TERMS[0, 1, 0] = TERMS[1, 0, 1] = TERMS[2, 0, 0] = 1
TERMS[3, 2, 0] = TERMS[3, 0, 2] = 0.5
BOTH = np.zeros((10, 5, 5), np.float32)
for _own, _i, _j in zip(BOTH, *np.triu_indices(4), strict=True):
    for _n, _m in np.ndindex(3, 3):
        _own[_n : _n + 3, _m : _m + 3] += TERMS[_i, _n, _m] * TERMS[_j]
_BLOCK = 12  # columns whose products are made together
_AT_ONCE = MAX_SAMPLES  # samples up to which sequences are gathered
_ENOUGH = 64  # frames whose weights stand for those of a sequence


@dataclass(frozen=True)
class Products:
    """Sums over frames for each link and pixel; zero where the partner is out of the window."""

    # right, normal: (link, 4, y, x), (link, 10, y, x) sums of products of weighted residuals times
    # `TERMS`, and of weights times `BOTH`; charges in 10⁴ e-
    right: F32
    normal: F32
    line: F64  # (3, 4) normal equations of the variance of pixels: shot noise, constant, square
    read: float  # variance of a pixel without light

    @property
    def shot(self) -> tuple[float, float, float]:
        """Measured variance over shot noise (1 for the right gain); its rise with the charge.

        The latter with its error, 1/(10⁴ e-).
        """
        covariance = inverse_normal(self.line[:, :3], 1e-12)
        shot, _, rise = covariance @ self.line[:, 3]
        return float(shot), float(rise / shot), float(np.sqrt(2 * covariance[2, 2]))

    def of(self, links: Sequence[int]) -> "Products":
        """Those of some links."""
        return replace(self, right=self.right[links], normal=self.normal[links])


def products(
    evidence: Evidence, links: Sequence[Place], known: Sequence[Coupling] = ()
) -> Products | None:
    """Sum the products of neighbours over all frames; None where no frames have light.

    ``known``: couplings for which the frames are corrected first.
    """
    shape = evidence.good.shape
    right = np.zeros((len(links), len(TERMS), *shape), np.float32)
    normal = np.zeros((len(links), len(BOTH), *shape), np.float32)
    line, brightest = np.zeros((3, 4)), 0.0
    for parts in _gathered(all_residuals(evidence, known)):
        brightest = max(brightest, *(part.brightness for part in parts))
        line += sum(map(_variance, parts))
        _add([(part.e, part.charge, part.good) for part in parts], TERMS, links, right)
        _add([_weights(part) for part in parts], BOTH, links, normal)
        del parts  # freed before the next ones, which are as large
    if brightest < min(MIN_CHARGE, ABOVE_READ * evidence.read_noise**2 / UNIT):
        return None
    return Products(right, normal, line, evidence.read_noise**2 / UNIT)


def joined(parts: Sequence[Products | None]) -> Products | None:
    """Sum over several parts of the frames."""
    some = [one for one in parts if one is not None]
    if len(some) < 2:
        return some[0] if some else None
    names = "right", "normal", "line"
    return replace(some[0], **{n: np.sum([getattr(o, n) for o in some], axis=0) for n in names})


def share_sums(right: F64, normal: F64, read: float, per_ke: float = 0.0) -> tuple[F64, F64]:
    """Least-squares sums (link, u, u), (link, u) of the shares, with the other terms free.

    If shares rise with the signal (``per_ke``, 1/ke-), the last term is no longer free.
    ``right``, ``normal``: as in `Products`, over classes instead of pixels. Unknown ``2 c`` is the
    share that pixels of class c give over the link, ``2 c + 1`` the share that their partners give
    back.
    """
    every = np.moveaxis(symmetric(np.moveaxis(normal, 1, -1)), 1, -1)
    prior = np.diag([read**-2, (BRIGHTER_FATTER * UNIT) ** -2])
    if per_ke > 0:
        terms = np.eye(3, 4)
        terms[:2, 3] = 2 * per_ke * UNIT * 1e-3
        every, right = np.einsum("it,ltuc,ju->lijc", terms, every, terms), terms @ right
        prior = prior[:1, :1]
    links, _, _, count = every.shape
    matrix: F64 = np.zeros((links, count, 2, count, 2))
    at = np.arange(count)
    matrix[:, at, :, at] = np.moveaxis(every[:, :2, :2], -1, 0)
    cross = np.moveaxis(every[:, :2, 2:], -1, 1).reshape(links, 2 * count, -1)
    nuisance = every[:, 2:, 2:].sum(-1) + prior
    taken = cross @ np.linalg.inv(nuisance)
    shares = right[:, :2].swapaxes(1, 2).reshape(links, -1)
    rest = shares - np.einsum("lun,ln->lu", taken, right[:, 2:].sum(-1))
    return matrix.reshape(links, 2 * count, -1) - taken @ cross.swapaxes(1, 2), rest


def share_and_square(sums: Products) -> tuple[F64, F64]:
    """Mean share of both pixels, and covariance over the product of the charges, 1/(10⁴ e-).

    With their covariance: (link, 2), (link, 2, 2).
    """
    right, normal = (part.sum((-2, -1), dtype=float) for part in (sums.right, sums.normal))
    mean = np.array([[0.5, 0.5, 0, 0], [0, 0, 0, 1]])
    covariance = mean @ inverse_normal(symmetric(normal))
    return np.einsum("lat,lt->la", covariance, right), covariance @ mean.T


def _weights(part: Residuals) -> Frames:
    """Few frames that represent all (one if all are equal), because weights have no noise."""
    every = slice(0, part.count, part.count if part.steady else -(-part.count // _ENOUGH))
    weight, charge = part.weight[every], part.charge[every]
    return weight * np.float32((part.count / len(weight)) ** 0.5), charge, part.good


def _gathered(parts: Iterable[Residuals]) -> Iterator[list[Residuals]]:
    """Short sequences together, as sums over few frames cost as much."""
    some: list[Residuals] = []
    for part in parts:
        some.append(part)
        del part
        if sum(one.e.size for one in some) > _AT_ONCE:
            yield some
            some = []
    if some:
        yield some


def _add(parts: Sequence[Frames], terms: F32, links: Sequence[Place], sums: F32) -> None:
    """Add to sums (link, term, y, x) products of the values of both pixels, over time."""
    ny, nx = sums.shape[-2:]
    reach, count = max((abs(dx) for _, dx in links), default=0), terms.shape[-1]
    # With margins along x, so that all columns have partners.
    time = sum(len(value) for value, *_ in parts)
    powers, first = np.zeros((ny, nx + 2 * reach, count, time), np.float32), 0
    for value, charge, good in parts:
        weighted, inside = value.T, powers[:, reach : reach + nx, :, first : first + len(value)]
        for power in range(count):
            inside[:, :, power][good] = weighted
            weighted = weighted * charge.T
        first += len(value)
    for dy, x in product({dy for dy, _ in links}, range(0, nx, _BLOCK)):
        wide = min(_BLOCK, nx - x)
        one, other = (
            a.reshape(ny - dy, -1, powers.shape[-1])
            for a in (powers[: ny - dy, reach + x : reach + x + wide],
                      powers[dy:, x : x + wide + 2 * reach])
        )  # fmt: skip
        both = (one @ other.swapaxes(1, 2)).reshape(ny - dy, wide, count, -1, count)
        for n, link in enumerate(links):
            if link[0] == dy:
                first = reach + link[1]
                pairs = both[:, :, :, first : first + wide].diagonal(axis1=1, axis2=3)
                sums[n, :, : ny - dy, x : x + wide] += np.tensordot(terms, pairs, ([1, 2],) * 2)


def _variance(part: Residuals) -> F64:
    """Normal equations (3, 4) of the variance of single pixels."""
    weight, charge = part.weight, part.charge
    terms = np.stack([weight * charge, weight, weight * charge**2]).reshape(3, -1)
    square = (part.e**2 / np.where(weight > 0, weight, 1)).ravel()
    used = terms[:, : weight[: part.count].size]
    return np.column_stack([used @ used.T, terms @ square]).astype(float)
