"""The kernel from darks, noise and maps together, and from each alone."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from pixcal.estimators.crosstalk.dense import CouplingFrames, Dense, frames_of, within
from pixcal.estimators.crosstalk.links import links
from pixcal.estimators.crosstalk.pattern import visibility_pattern
from pixcal.estimators.crosstalk.support import Choice, choose
from pixcal.estimators.crosstalk.trails import SURE, trailing
from pixcal.estimators.diagnosis.evidence import Evidence, central_crop
from pixcal.kernels.crosstalk import Coupling
from pixcal.model.arrays import F64
from pixcal.model.errors import InputError

LEVEL_STEPS = 10  # most iterations of a level dependence
CERTAIN = 5.0  # sigmas beyond which a level dependence is accepted
# sigmas beyond which a coupling is reported: with a hundred tested, one false in twenty kernels
THERE = 3.5
# most pixels of flats: their sums of pairs up to `links.REACH` apart fill 600 MB
MOST_PIXELS = 1 << 17
ALIKE = 0.05  # p-value from which the shares of all classes are taken as equal


@dataclass(frozen=True)
class Kernel:
    """Couplings as measured."""

    couplings: tuple[Coupling, ...]
    covariance: F64  # (n, n) of their shares
    significance: float  # of the strongest, in sigmas, corrected for the number of trials
    by: tuple[str, ...]  # methods of measurement
    # per_ke, per_ke_error: relative change of the shares with the source's signal, 1/ke-, where
    # they fall; the error is infinite where it is not constrained
    per_ke: float
    per_ke_error: float
    whole: tuple[Coupling, ...] = ()  # all that were measured, significant or not


def measure(evidence: Evidence) -> Kernel | None:
    """Couplings of an acquisition; None where it has neither light nor dark signal.

    Significant couplings give the period; then all within two pixels are measured together. Raises
    InputError if too many are significant for a kernel.
    """
    stands_out = _standing_out(evidence)
    if stands_out is None:
        return None
    evidence, frames, found = stands_out
    none = Kernel((), np.zeros((0, 0)), found.significance, (), 0.0, np.inf)
    if not found.links:
        return none
    near = within(evidence.good.shape, {frames.links.links[n] for n in found.links})
    own: CouplingFrames | None = frames.of_steps(near)
    del frames, stands_out  # large
    known: tuple[Coupling, ...] = ()
    per_ke, error = 0.0, np.inf
    for again in (False, True):
        # The second pass uses the charge as collected, and all hot pixels.
        if again:
            own = frames_of([evidence], lambda _: near, known)
        dense = None if own is None else own.kernel(found.classes, known, per_ke)
        if own is None or dense is None:
            raise InputError(
                "not decided: a kernel of that period has more couplings than can be measured"
            )
        dense, per_ke, error = _level(own, dense, found, per_ke)
        known = dense.couplings
    assert dense is not None
    return _significant_kernel(dense, replace(none, per_ke=per_ke, per_ke_error=error))


def significance(evidence: Evidence) -> float | None:
    """Of the strongest coupling, as `measure` gives it."""
    stands_out = _standing_out(evidence)
    return None if stands_out is None else stands_out[-1].significance


def _standing_out(evidence: Evidence) -> tuple[Evidence, CouplingFrames, Choice] | None:
    """The pixels examined, what frames tell of all their links, and the significant ones."""
    if trailing(evidence) > SURE:
        raise InputError(
            "not decided: charge trails hot pixels in one direction, the farther they are from the "
            "output the more, as incomplete charge transfer leaves it; this is no crosstalk"
        )
    if not evidence.fringes:
        evidence = central_crop(evidence, MOST_PIXELS)
    every = links(evidence.good.shape)
    frames = frames_of([evidence], lambda _: every) if every else None
    if frames is None:
        return None
    return evidence, frames, choose(frames.measured(()), visibility_pattern(evidence))


def _level(
    frames: CouplingFrames, dense: Dense, found: Choice, per_ke: float
) -> tuple[Dense, float, float]:
    """Relative fall (1/ke-) of shares with the signal, zero if not significant, and its error."""
    # Shares that rise may be due to brighter-fatter; those that fall are not.
    error = np.inf
    for _ in range(LEVEL_STEPS):
        there = np.abs(dense.shares) > THERE * np.sqrt(np.diag(dense.covariance))
        known = [c for c, significant in zip(dense.couplings, there, strict=True) if significant]
        more, error = frames.measured(dense.couplings, per_ke).level_dependence(known)
        falls = per_ke + more < -CERTAIN * error
        if abs(more) < 0.1 * error or (not falls and per_ke == 0):
            break
        per_ke = per_ke + more if falls else 0.0
        now = frames.kernel(found.classes, dense.couplings, per_ke)
        if now is None:
            break
        dense = now
    return dense, per_ke, error


def _significant_kernel(dense: Dense, about: Kernel) -> Kernel:
    """The significant couplings; those equal in all classes as one."""
    basis, couplings = _plain(dense)
    if not couplings:
        return about
    precision = np.linalg.inv(dense.covariance)
    covariance = np.asarray(np.linalg.inv(basis.T @ precision @ basis), float)
    shares = covariance @ basis.T @ precision @ dense.shares
    # Shares that may be equal keep their individual errors.
    for n, (column, own) in enumerate(zip(basis.T > 0, np.diag(covariance), strict=True)):
        each = float(np.diag(dense.covariance)[column].mean())
        covariance[n, n] = max(own, each) if column.sum() > 1 else own
    return replace(
        about,
        couplings=tuple(replace(c, share=float(k)) for c, k in zip(couplings, shares, strict=True)),
        covariance=covariance,
        by=dense.methods,
        whole=dense.couplings,
    )


def _plain(dense: Dense) -> tuple[F64, list[Coupling]]:
    """Basis (share, number) of the significant couplings of a kernel, and these couplings."""
    # Noise alone measures the sum of the shares there and back: a pair whose sum is significant has
    # both, even if neither is significant alone, or only one of them just is.
    columns: list[F64] = []
    couplings: list[Coupling] = []
    steps = dict.fromkeys((c.dy, c.dx) for c in dense.couplings)
    for step in (s for s in steps if s > (0, 0)):
        ways = [_of_step(dense, one) for one in (step, (-step[0], -step[1]))]
        found = [_significant(dense, way) for way in ways]
        there, back = (np.sum([column for column, _ in way], axis=0) for way in ways)
        if _sigmas(dense, there + back) > THERE > _sigmas(dense, there - back):
            found = [own or [_alike(way)] for own, way in zip(found, ways, strict=True)]
        directed = [part for own in found for part in own]
        columns += [column for column, _ in directed]
        couplings += [coupling for _, coupling in directed]
    return np.array(columns).T, couplings


# which shares of a kernel are one number, and their coupling
Part = tuple[F64, Coupling]


def _of_step(dense: Dense, step: tuple[int, int]) -> list[Part]:
    """The shares of all classes over a step, one by one."""
    every = np.eye(len(dense.couplings))
    return [(every[n], c) for n, c in enumerate(dense.couplings) if (c.dy, c.dx) == step]


def _alike(group: Sequence[Part]) -> Part:
    """The shares of all classes as one."""
    column = np.sum([own for own, _ in group], axis=0)
    return column, replace(group[0][1], every_rows=1, row=0, every_columns=1, column=0)


def _significant(dense: Dense, group: Sequence[Part]) -> list[Part]:
    """The significant shares of classes over a step; a single one where all are equal."""
    at = np.flatnonzero(np.sum([column for column, _ in group], axis=0))
    precision = np.linalg.inv(dense.covariance[np.ix_(at, at)])
    shares, weight = dense.shares[at], float(precision.sum())
    mean = float(precision.sum(0) @ shares) / weight
    apart = shares - mean
    if len(at) > 1 and chdtrc(len(at) - 1, max(float(apart @ precision @ apart), 0.0)) > ALIKE:
        return [_alike(group)] if abs(mean) > THERE * weight**-0.5 else []
    return [part for part in group if _sigmas(dense, part[0]) > THERE]


def _sigmas(dense: Dense, column: F64) -> float:
    """Significance of the sum of some shares."""
    return abs(float(column @ dense.shares)) / float(np.sqrt(column @ dense.covariance @ column))
