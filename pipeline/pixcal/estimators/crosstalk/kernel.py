"""A whole kernel: every coupling within two pixels, shrunk by its error instead of dropped.

Frames, dark signal and maps are corrected for the couplings known so far (`sources`). All
measurements are linear in the remaining shares; a few steps of least squares give the kernel. A
share is a sum of a part common to all classes and both directions, a part common to all classes in
one direction, and its own part. The sizes of these parts are learnt from all couplings of a kind
(empirical Bayes, by expectation and maximisation), which makes undetected parts small. The period
with the greatest evidence is chosen.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from math import lcm

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc

from pixcal.estimators.crosstalk.equations import Equations
from pixcal.estimators.crosstalk.links import PixelClasses, Place, couplings_of, links
from pixcal.estimators.crosstalk.sources import Sources, sources_of, total
from pixcal.estimators.crosstalk.support import significant_links
from pixcal.estimators.crosstalk.trails import SURE, trailing
from pixcal.estimators.diagnosis.central_crop import central_crop
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.crosstalk import Coupling, largest_outflow
from pixcal.model.arrays import F64, Indices
from pixcal.model.errors import InputError

WITHIN = 2  # rows and columns of the kernel on either side of its centre
MAX_SHARES = 480  # most shares measured together: time goes with the third power of their number
ITERATIONS = 60  # of expectation and maximisation
FEW = 20  # the same for a comparison of periods
# prior size of a part of a share, and of a true pattern (px), with the weight of one value
USUAL, PATTERN = 4e-4, 1e-4
START = (1e-2, 1e-3)  # start values of these sizes
STEPS = 6  # most steps of least squares
STILL = 0.3  # standard errors of a step below which the iteration ends
# sigmas beyond which a coupling is reported: with a hundred tested, one false in twenty kernels
THERE = 3.5
# most pixels of flats: their sums of pairs up to `links.REACH` apart fill 400 MB
MOST_PIXELS = 1 << 17
WORTH = 16.0  # fall in chi-square of the visibility required of another class of pixels
ALIKE = 0.05  # p-value above which the shares of all classes are assumed equal


@dataclass(frozen=True)
class Kernel:
    """Couplings as measured."""

    couplings: tuple[Coupling, ...]
    covariance: F64  # (n, n) of their shares
    methods: tuple[str, ...]  # of measurement
    # relative change of the shares with the source's signal, 1/ke-, and its error
    per_ke: tuple[float, float] = (0.0, np.inf)
    either: bool = False  # a rise may also be due to noise shared through shifted boundaries

    @property
    def shares(self) -> F64:
        """Of the couplings."""
        return np.array([c.share for c in self.couplings])

    @property
    def errors(self) -> F64:
        """Of the shares."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class Detection:
    """Whether pixels couple."""

    significance: float  # of the strongest coupling, sigmas, corrected for the number of trials
    evidence: Evidence  # of the pixels examined
    sources: Sources | None  # for the links of a kernel; None without a significant coupling
    classes: PixelClasses  # of the period of the kernel


def detect(evidence: Evidence) -> Detection | None:
    """Seek couplings within `links.REACH`; None where there is neither light nor dark signal.

    Raises InputError if too many are significant for a kernel.
    """
    if trailing(evidence) > SURE:
        raise InputError(
            "not decided: hot pixels have trails in one direction, which grow with the distance "
            "from the output; this is incomplete charge transfer, not crosstalk"
        )
    if not evidence.fringes:
        evidence = central_crop(evidence, MOST_PIXELS)
    every = links(evidence.good.shape)
    sources = sources_of([evidence], lambda _: every) if every else None
    if sources is None:
        return None
    there, sigmas = significant_links(sources)
    if not there:
        return Detection(sigmas, evidence, None, PixelClasses(1, 1, sources.first))
    near, classes = within(sources.shape, there), best_period(sources.of(there))
    return Detection(sigmas, evidence, sources.of(near), classes)


def measure(found: Detection) -> Kernel | None:
    """All couplings within two pixels and those found beyond; None without a significant one.

    Raises InputError if their period is too long.
    """
    if found.sources is None:
        return None
    evidence, classes, near = found.evidence, found.classes, found.sources.links
    kernel = _kernel(found.sources, classes)
    known = np.zeros(len(kernel.couplings), np.bool_)
    for _ in range(STEPS):
        # A coupling stays: where shares rise steeply, those at small signals are uncertain.
        known |= np.abs(kernel.shares) > THERE * kernel.errors
        updated = sources_of([evidence], lambda _: near, tuple(compress(kernel.couplings, known)))
        assert updated is not None
        before, kernel = kernel, _kernel(updated, classes, *updated.level_dependence(classes))
        change = kernel.per_ke[0] - before.per_ke[0]
        moved = np.abs(kernel.shares - before.shares) * largest_outflow(kernel.couplings)
        if abs(change) < STILL * kernel.per_ke[1] and (moved < STILL * kernel.errors).all():
            break
    return kernel


def dense_kernel(parts: Iterable[Evidence], start: tuple[Coupling, ...]) -> Kernel | None:
    """Measure all couplings of the period of a kernel; None without light and dark signal.

    ``parts``: of the same pixels, with different frames. ``start``: couplings found so
    far; they set the period and any coupling beyond `WITHIN`.
    """
    far = {(c.dy, c.dx) for c in start} | {(-c.dy, -c.dx) for c in start}
    rows, columns = (lcm(*(getattr(c, n) for c in start)) for n in ("every_rows", "every_columns"))
    sources = sources_of(parts, lambda shape: within(shape, far), start)
    return None if sources is None else _kernel(sources, PixelClasses(rows, columns, sources.first))


def within(shape: tuple[int, ...], far: Collection[Place] = ()) -> tuple[Place, ...]:
    """Steps to partners within `WITHIN` pixels, and those in ``far``."""
    return tuple(s for s in links(shape) if max(map(abs, s)) <= WITHIN or s in far)


def significant(kernel: Kernel) -> tuple[tuple[Coupling, ...], F64]:
    """The significant couplings, as one if equal in all classes, and their covariance."""
    each, places = np.eye(len(kernel.couplings)), [(c.dy, c.dx) for c in kernel.couplings]

    def sigmas(column: F64) -> float:
        """Significance of the sum of some shares."""
        return abs(float(column @ kernel.shares)) / float(
            (column @ kernel.covariance @ column) ** 0.5
        )

    basis, couplings = [], []
    for place in dict.fromkeys(places):
        at = [n for n, own in enumerate(places) if own == place]
        precision = np.linalg.inv(kernel.covariance[np.ix_(at, at)])
        rest = kernel.shares[at] - precision.sum(axis=0) @ kernel.shares[at] / precision.sum()
        alike = chdtrc(max(len(at) - 1, 1), max(float(rest @ precision @ rest), 0.0)) > ALIKE
        for group in [at] if alike else [[n] for n in at]:
            # Noise alone measures the sum of the shares there and back (neighbours in the list): a
            # pair whose sum is significant has both, as long as they cannot be distinguished.
            there, back = (each[[n ^ way for n in group]].sum(axis=0) for way in (0, 1))
            both, apart = sigmas(there + back), sigmas(there - back)
            if sigmas(there) > THERE or both > THERE > apart:
                one = kernel.couplings[group[0]]
                if alike:
                    one = replace(one, every_rows=1, row=0, every_columns=1, column=0)
                basis.append(there)
                couplings.append(one)
    if not couplings:
        return (), np.zeros((0, 0))
    precision, columns = np.linalg.inv(kernel.covariance), np.array(basis).T
    covariance = np.linalg.inv(columns.T @ precision @ columns)
    shares = covariance @ columns.T @ precision @ kernel.shares
    # Shares that may be equal keep their individual errors.
    for n, column in enumerate(columns.T > 0):
        covariance[n, n] = max(covariance[n, n], np.diag(kernel.covariance)[column].mean())
    named = zip(couplings, shares.tolist(), strict=True)
    return tuple(replace(c, share=share) for c, share in named), covariance


def best_period(sources: Sources) -> PixelClasses:
    """The classes of the period of the greatest evidence."""

    def score(period: tuple[PixelClasses, Mapping[str, Equations]]) -> float:
        classes, (normal, right) = period[0], total(period[1])
        fit = shrunk(block_diag(*normal), right.ravel(), sources.links, classes.count, rounds=FEW)
        pattern = 0.0 if sources.maps is None else sources.maps.pattern(classes)
        return fit[-1] + (pattern - WORTH * (classes.count - 1)) / 2

    return max(sources.periods(), key=score)[0]


def _kernel(
    sources: Sources,
    classes: PixelClasses,
    per_ke: float = 0.0,
    error: float = np.inf,
    either: bool = False,
) -> Kernel:
    """All couplings of the links for the classes of a period.

    With ``per_ke``, maps are not used, because they have one level.
    """
    every = couplings_of(classes, sources.links)
    if len(every) > MAX_SHARES:
        raise InputError(
            "not decided: a kernel of that period has more couplings than can be measured"
        )
    known, rising = sources.known_shares(classes)
    _, measured = next(sources.periods((classes.rows, classes.columns), doubted=False))
    # The change of the frames if the known shares rose by this.
    measured = {n: one.risen(rising - per_ke * known) for n, one in measured.items()}
    normal, right = total(measured, per_ke)
    whole, rights, free = block_diag(*normal), right.ravel(), 0
    if sources.maps is not None and not per_ke:
        free = 2 * classes.count
        more, of_maps = sources.maps.sums(every, classes)
        whole = block_diag(whole, np.zeros((free, free))) + more
        rights = np.concatenate([rights, np.zeros(free)]) + of_maps
    rights = rights + whole[:, : len(every)] @ known.ravel()
    shares, covariance, _ = shrunk(whole, rights, sources.links, classes.count, free)
    couplings = zip(every, shares.tolist(), strict=True)
    return Kernel(
        tuple(replace(c, share=share, per_ke=per_ke) for c, share in couplings),
        covariance,
        (*measured, *["maps"] * bool(free)),
        (per_ke, error),
        either,
    )


def shrunk(
    normal: F64,
    right: F64,
    steps: Sequence[Place],
    classes: int,
    free: int = 0,
    rounds: int = ITERATIONS,
) -> tuple[F64, F64, float]:
    """Shares, their covariance, and the logarithm of the evidence.

    From least-squares sums (n + free, n + free), (n + free,) of the shares, and of a true pattern.
    """
    basis, group = _parts(steps, classes)
    shares = len(basis)
    basis = block_diag(basis, np.eye(free))
    group = np.concatenate([group, np.full(free, group.max() + 1)])
    inner, inner_right = basis.T @ normal @ basis, basis.T @ right
    usual = np.full(group.max() + 1, USUAL)
    size = np.full(len(usual), START[0])
    if free:
        usual[-1], size[-1] = PATTERN, START[1]
    count = np.bincount(group)
    for _ in range(rounds):
        covariance = np.linalg.inv(inner + np.diag(size[group] ** -2.0))
        value = covariance @ inner_right
        square = np.bincount(group, value**2 + np.diag(covariance))
        last, size = size, np.sqrt((square + usual**2) / (count + 1))
    evidence = (
        value @ inner_right + np.linalg.slogdet(covariance)[1] - 2 * np.log(last[group]).sum()
    )
    own = basis @ covariance @ basis.T
    return (basis @ value)[:shares], own[:shares, :shares], float(evidence / 2)


def _parts(steps: Sequence[Place], classes: int) -> tuple[F64, Indices]:
    """Parts of shares (share, part), and which of them (part,) have a common size."""
    size = 2 * classes
    common = np.kron(np.eye(len(steps)), np.ones((size, 1)))
    one_way = common * np.tile([1.0, -1.0], len(steps) * classes)[:, None]
    # Couplings of similar size: along rows, along columns, or diagonal, by distance.
    kinds = [
        (abs(dy), abs(dx)) if not dy * dx else (max(abs(dy), abs(dx)),) * 2 for dy, dx in steps
    ]
    names = sorted(set(kinds))
    number = np.array([names.index(kind) for kind in kinds])
    columns, groups = [common, one_way], [number, len(names) + number]
    if classes > 1:
        columns.append(np.eye(size * len(steps)))
        groups.append(2 * len(names) + np.repeat(number, size))
    return np.hstack(columns), np.concatenate(groups)
