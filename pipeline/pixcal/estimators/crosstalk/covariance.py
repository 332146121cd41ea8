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

from pixcal.estimators.crosstalk.equations import Equations
from pixcal.estimators.crosstalk.links import Place
from pixcal.estimators.crosstalk.residuals import MAX_SAMPLES, UNIT, Residuals, all_residuals
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.crosstalk import Coupling
from pixcal.kernels.normal_matrix import inverse_normal, symmetric
from pixcal.model.arrays import F32, F64

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
OF_RISE = 2e-3 * UNIT * np.array([[0.0, 0.0], [1.0, 1.0]])  # constant and b of rising shares
_BLOCK = 12  # columns whose products are made together
_AT_ONCE = MAX_SAMPLES  # samples up to which sequences are gathered
_ENOUGH = 64  # frames whose weights stand for those of a sequence

Frames = tuple[F32, F32]  # values and charges (t, y, x)


@dataclass
class Products:
    """Sums over frames for each link and pixel; zero where the partner is out of the window."""

    # right, normal: (link, 4, y, x), (link, 10, y, x) sums of products of weighted residuals times
    # `TERMS`, and of weights times `BOTH`; charges in 10⁴ e-
    right: F32
    normal: F32
    line: F64  # (3, 4) normal equations of the variance of pixels: shot noise, constant, square
    read: float  # variance of a pixel without light
    brightest: float = 0.0  # median charge of the brightest frames

    @classmethod
    def none(cls, links: Sequence[Place], evidence: Evidence) -> "Products":
        """Of no frames yet."""
        right, normal = (
            np.zeros((len(links), len(t), *evidence.good.shape), np.float32) for t in (TERMS, BOTH)
        )
        return cls(right, normal, np.zeros((3, 4)), evidence.read_noise**2 / UNIT)

    def add(self, evidence: Evidence, links: Sequence[Place], known: Sequence[Coupling]) -> None:
        """Add all frames, corrected for the couplings that are ``known``."""
        for parts in _gathered(all_residuals(evidence, known)):
            self.brightest = max(self.brightest, *(part.brightness for part in parts))
            self.line += sum(map(_variance, parts))
            _add([(part.e, part.charge[part.frame]) for part in parts], TERMS, links, self.right)
            _add([_weights(part) for part in parts], BOTH, links, self.normal)
            del parts  # freed before the next ones, which are as large

    @property
    def lit(self) -> bool:
        """Whether frames have usable light."""
        return self.brightest >= min(MIN_CHARGE, ABOVE_READ * self.read)

    def of(self, links: Sequence[int]) -> "Products":
        """Those of some links."""
        return replace(self, right=self.right[links], normal=self.normal[links])

    @property
    def shot(self) -> tuple[float, float, float]:
        """Measured variance over shot noise (1 for the right gain), and its rise with the charge.

        The latter as the relative rise of shares with as much effect, with its error, 1/ke-.
        """
        covariance = inverse_normal(self.line[:, :3], 1e-12)
        shot, _, rise = covariance @ self.line[:, 3]
        error, scale = np.sqrt(2 * covariance[2, 2]), OF_RISE[1, 0]
        return float(shot), float(rise / shot / scale), float(error / scale)

    def equations(self, right: F64, normal: F64) -> Equations:
        """From sums (link, term, class) of ``right`` and ``normal``."""
        every = np.moveaxis(symmetric(np.moveaxis(normal, 1, -1)), 1, -1)
        shot, slope, _ = self.shot
        prior = np.array([self.read, BRIGHTER_FATTER * UNIT])
        return Equations(every, right / shot, OF_RISE, np.eye(2), prior, slope)


def _weights(part: Residuals) -> Frames:
    """Few frames that represent all (one if all are equal), because weights have no noise."""
    count = len(part.weight)
    if len(part.charge) == 1:
        return part.weight.mean(axis=0, keepdims=True) * np.float32(count**0.5), part.charge
    every = slice(0, count, -(-count // _ENOUGH))
    weight = part.weight[every]
    return weight * np.float32((count / len(weight)) ** 0.5), part.charge[every]


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
    time = sum(len(value) for value, _ in parts)
    powers, first = np.zeros((ny, nx + 2 * reach, count, time), np.float32), 0
    for value, charge in parts:
        inside = powers[:, reach : reach + nx, :, first : first + len(value)]
        for power in range(count):
            inside[:, :, power] = np.moveaxis(value, 0, -1)
            value = value * charge
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
    weight = part.weight
    terms = np.stack([weight * part.charge, weight, weight * part.charge**2]).reshape(3, -1)
    square = part.e[: len(weight)] ** 2 / np.where(weight > 0, weight, 1)
    return np.column_stack([terms @ terms.T, terms @ square.ravel()]).astype(float)
