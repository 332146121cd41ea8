"""A whole kernel: every coupling within two pixels, shrunk by its error instead of dropped.

Shared noise, hot pixels and the pattern of the maps are joined as least-squares sums of the shares.
A share is a sum of a part common to all classes and both directions, a part common to all classes
in one direction, and its own part. The sizes of these parts are learnt from all couplings of a kind
(empirical Bayes, by expectation and maximisation), which makes undetected parts small.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from math import lcm

import numpy as np
from scipy.linalg import block_diag

from pixcal.estimators.crosstalk.covariance import Products, products
from pixcal.estimators.crosstalk.hot_pixels import hot_pixels
from pixcal.estimators.crosstalk.information import MeasuredLinks, to_first_order
from pixcal.estimators.crosstalk.links import PixelClasses, Place, links
from pixcal.estimators.crosstalk.pattern import pattern_information
from pixcal.estimators.crosstalk.support import coupling_of
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.fringe_fit.combine import weighted_mean
from pixcal.kernels.crosstalk import Coupling, outflow
from pixcal.model.arrays import F64, Indices

Sums = tuple[F64, F64]

WITHIN = 2  # rows and columns of the kernel on either side of its centre
ROUNDS = 3  # iterations of the shares, each with the second order of the last ones
MAX_SHARES = 480  # most shares measured together: time goes with the third power of their number
NEGLIGIBLE = 1e-4  # share below which products with others are neglected
ITERATIONS = 60  # of expectation and maximisation
# prior size of a part of a share, and of a true pattern (px), with the weight of one value
USUAL, PATTERN = 4e-4, 1e-4
START = (1e-2, 1e-3)  # start values of these sizes


@dataclass(frozen=True)
class Dense:
    """A kernel with all its couplings."""

    couplings: tuple[Coupling, ...]
    covariance: F64  # (n, n) of their shares
    methods: tuple[str, ...]  # of measurement

    @property
    def shares(self) -> F64:
        """Of the couplings."""
        return np.array([c.share for c in self.couplings])


@dataclass(frozen=True)
class CouplingFrames:
    """What frames measure of the couplings of some steps, before pixels are joined in classes."""

    evidence: Evidence
    links: MeasuredLinks  # as measured, of any order in the shares

    def measured(self, known: Sequence[Coupling], per_ke: float = 0.0) -> MeasuredLinks:
        """The same to first order in the shares; known shares give the second order."""
        large = [replace(c, per_ke=per_ke) for c in known if abs(c.share) > NEGLIGIBLE]
        own = self.links
        noise, hot = own.products, own.hot
        if noise is not None:
            noise = to_first_order(noise, large, own.links, own.first)
        if hot is not None:
            hot = hot.corrected(outflow(large, own.shape, own.first), per_ke)
        return replace(own, products=noise, hot=hot)

    def of_steps(self, steps: tuple[Place, ...]) -> "CouplingFrames":
        """What they measure of some of the steps."""
        return replace(self, links=self.links.of([self.links.links.index(s) for s in steps]))

    def kernel(
        self, classes: PixelClasses, known: Sequence[Coupling], per_ke: float = 0.0
    ) -> "Dense | None":
        """All couplings of the steps for the classes of a period; None for more than `MAX_SHARES`.

        Known couplings are the start values. With ``per_ke``, a relative change of the shares with
        the signal (1/ke-), maps are not used, as they are of one level.
        """
        every = tuple(
            coupling_of(classes, *divmod(u, 2), step)
            for step in self.links.links
            for u in range(2 * classes.count)
        )
        if len(every) > MAX_SHARES:
            return None
        shrinkage = ShareShrinkage.of(self.links.links, classes.count)
        shares = _shares_of(every, known)
        found = None
        for _ in range(ROUNDS):
            now = [replace(c, share=float(k)) for c, k in zip(every, shares, strict=True)]
            measured = self.measured(now, per_ke)
            methods = {
                method: (block_diag(*normal), right.ravel())
                for method, (normal, right) in measured.of_period(classes).items()
            }
            if measured.products is not None:
                methods["covariance"] = _any_gain(methods["covariance"], measured.products, shares)
            normal, right = (np.sum(part, axis=0) for part in zip(*methods.values(), strict=True))
            maps = None if per_ke else pattern_information(self.evidence, now, classes)
            found = shrinkage.solve(normal, right, maps)
            shares = found[0]
        assert found is not None
        couplings = tuple(
            replace(c, share=float(k), per_ke=per_ke) for c, k in zip(every, shares, strict=True)
        )
        return Dense(couplings, found[1], (*methods, *["maps"] * (maps is not None)))


def frames_of(
    parts: Iterable[Evidence],
    steps_in: Callable[[tuple[int, ...]], tuple[Place, ...]],
    known: Sequence[Coupling] = (),
) -> CouplingFrames | None:
    """What several parts of the frames measure together; None without light and dark signal.

    ``parts``: of the same pixels, each needed once. ``steps_in``: steps (dy, dx) in a window of
    given rows and columns. ``known``: couplings by which the charge follows from the signal.
    """
    noise: list[Products | None] = []
    first: Evidence | None = None
    for part in parts:
        if first is None:
            steps = steps_in(part.good.shape)
            first, hot = part.without_frames(), hot_pixels(part, steps, known)
        noise.append(products(part, steps, known))
        del part  # the next one is read only then
    total = _sum(noise)
    if first is None or (total is None and hot is None):
        return None
    shape, origin = first.good.shape, first.origin
    return CouplingFrames(first, MeasuredLinks(total, hot, steps, shape, origin))


def dense_kernel(parts: Iterable[Evidence], start: Sequence[Coupling]) -> Dense | None:
    """Measure all couplings of the period of a kernel; None for more than `MAX_SHARES`.

    ``parts``: of the same pixels, with different frames. ``start``: couplings found so
    far; they set the period and any coupling beyond `WITHIN`.
    """
    far = {(c.dy, c.dx) for c in start} | {(-c.dy, -c.dx) for c in start}
    rows, columns = (lcm(*(getattr(c, n) for c in start)) for n in ("every_rows", "every_columns"))
    frames = frames_of(parts, lambda shape: within(shape, far), start)
    if frames is None:
        return None
    return frames.kernel(PixelClasses(rows, columns, frames.evidence.origin), start)


def within(shape: tuple[int, ...], far: Collection[Place] = ()) -> tuple[Place, ...]:
    """Steps to partners within `WITHIN` pixels, and those in ``far``."""
    return tuple(s for s in links(shape) if max(map(abs, s)) <= WITHIN or s in far)


def _any_gain(sums: Sums, noise: Products, shares: F64) -> Sums:
    """Sums that allow all shares a common factor, with the error of the shot noise."""
    normal, right = sums
    slope = normal @ shares
    inner = shares @ slope + (noise.shot / noise.shot_error) ** 2
    return normal - np.outer(slope, slope) / inner, right - slope * (shares @ right) / inner


def _sum(found: Sequence[Products | None]) -> Products | None:
    """Sum over several parts of the frames."""
    some = [one for one in found if one is not None]
    if len(some) < 2:
        return some[0] if some else None
    shots = np.array([(one.shot, one.curve) for one in some])
    errors = np.array([(one.shot_error, one.curve_error) for one in some])
    (shot, curve), (shot_error, curve_error), _ = weighted_mean(shots, errors)
    return replace(
        some[0],
        right=np.sum([one.right for one in some], axis=0),
        normal=np.sum([one.normal for one in some], axis=0),
        shot=float(shot),
        shot_error=float(shot_error),
        curve=float(curve),
        curve_error=float(curve_error),
    )


def _shares_of(every: Sequence[Coupling], known: Sequence[Coupling]) -> F64:
    """Shares of all couplings where some, of shorter periods too, are known."""
    shares = np.zeros(len(every))
    for k in known:
        for n, c in enumerate(every):
            same = (k.dy, k.dx, k.row, k.column)
            if same == (c.dy, c.dx, c.row % k.every_rows, c.column % k.every_columns):
                shares[n] += k.share
    return shares


@dataclass(frozen=True)
class ShareShrinkage:
    """Parts of shares, and which of them have a common size."""

    basis: F64  # (share, part) shares are this times their parts
    group: Indices  # (part,)
    classes: int

    @classmethod
    def of(cls, steps: Sequence[Place], classes: int) -> "ShareShrinkage":
        """Parts of the couplings of each step: there and back of every class."""
        size = 2 * classes
        common = np.kron(np.eye(len(steps)), np.ones((size, 1)))
        one_way = common * np.tile([1.0, -1.0], len(steps) * classes)[:, None]
        kinds = [_kind(step) for step in steps]
        names = sorted(set(kinds))
        number = np.array([names.index(kind) for kind in kinds])
        columns, groups = [common, one_way], [number, len(names) + number]
        if classes > 1:
            columns.append(np.eye(size * len(steps)))
            groups.append(2 * len(names) + np.repeat(number, size))
        return cls(np.hstack(columns), np.concatenate(groups), classes)

    def solve(
        self, normal: F64, right: F64, maps: tuple[F64, F64] | None
    ) -> tuple[F64, F64, float]:
        """Shares, their covariance, and the rms of a true pattern.

        From least-squares sums (n, n), (n,) of the shares, and of shares and true pattern in
        ``maps``.
        """
        n, parts = self.basis.shape
        free = 0 if maps is None else 2 * self.classes
        basis = block_diag(self.basis, np.eye(free))
        group = np.concatenate([self.group, np.full(free, self.group.max() + 1)])
        whole, whole_right = block_diag(normal, np.zeros((free, free))), np.zeros(n + free)
        whole_right[:n] = right
        if maps is not None:
            whole, whole_right = whole + maps[0], whole_right + maps[1]
        inner, inner_right = basis.T @ whole @ basis, basis.T @ whole_right
        usual = np.full(group.max() + 1, USUAL)
        size = np.full(len(usual), START[0])
        if free:
            usual[-1], size[-1] = PATTERN, START[1]
        count = np.bincount(group)
        for _ in range(ITERATIONS):
            covariance = np.linalg.inv(inner + np.diag(size[group] ** -2.0))
            value = covariance @ inner_right
            square = np.bincount(group, value**2 + np.diag(covariance))
            size = np.sqrt((square + usual**2) / (count + 1))
        shares = self.basis @ value[:parts]
        own = self.basis @ covariance[:parts, :parts] @ self.basis.T
        return shares, own, float(size[-1]) if free else 0.0


def _kind(step: Place) -> tuple[int, int]:
    """Couplings of similar size: along rows, along columns, or diagonal, by distance."""
    dy, dx = abs(step[0]), abs(step[1])
    if dy and dx:
        return (1, 1) if dy == dx == 1 else (2, 2)
    return (dy, dx) if max(dy, dx) == 1 else (2 * (dy > 0), 2 * (dx > 0) + 3)
