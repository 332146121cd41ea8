"""Crosstalk between pixels: part of a pixel's signal is read at others, near or a few away."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pixcal.estimators.crosstalk.kernel import dense_kernel, detect, measure, significant
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.crosstalk import (
    Coupling,
    couple,
    couple_fringes,
    filled,
    largest_outflow,
    noise_shares,
    uncouple,
    uncouple_fringes,
)
from pixcal.model.arrays import F32, F64
from pixcal.model.config import quantity
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, Estimate, FringeMaps, Stage
from pixcal.simulation.shot import Shot

MIN_SHARE = 2e-5  # couplings below have negligible effect on offsets, and take time
MIN_FLAT = 0.01  # least response by which maps are divided

# a kernel of the size and kind measured on the paper's GIGAPYX-4600
FOUR_ROWS = (
    # Unequal couplings of pairs of rows, one of which skips a row: the paper finds 2 to 3 % up and
    # down, repeating every four rows, "sparse", and not always between nearest neighbours.
    Coupling(1, 0, 0.030, every_rows=4, row=0),
    Coupling(-1, 0, 0.025, every_rows=4, row=1),
    Coupling(1, 0, 0.020, every_rows=4, row=2),
    Coupling(-2, 0, 0.025, every_rows=4, row=3),
    # 0.6 % to the left and right, a little less to the left in two rows of four.
    Coupling(0, 1, 0.006),
    Coupling(0, -1, 0.006, every_rows=4, row=0),
    Coupling(0, -1, 0.006, every_rows=4, row=1),
    Coupling(0, -1, 0.004, every_rows=4, row=2),
    Coupling(0, -1, 0.004, every_rows=4, row=3),
)


_NONE = "no significant signal beside hot pixels, and no significant noise common to neighbours"


@dataclass(frozen=True)
class Ipc(Effect):
    """Couplings between pixels: any kernel, sparse or dense, of any period of rows and columns."""

    name = "ipc"
    title = "crosstalk between pixels"
    acts_at = Stage.SIGNAL
    order = 1
    domains = ("space", "noise")
    strengths = ("couplings",)
    frames_needed = ("dark", "flat", "baseline")
    remedy = "already included in the measured gain; frames can be deconvolved with this kernel"
    quick = False
    sources = (
        "Rousset et al., section 5.1: period of four rows, 2-3 % vertical, 0.6 % horizontal, "
        "sparse",
        "Moore, Ninkov & Forrest, Proc. SPIE 5167, 204 (2004): deterministic, conserves the signal",
        "Donlon, Ninkov & Baum, PASP 130, 074503 (2018): 0.68 to 1.45 % over the well of an H2RG",
        "Le Graët et al., Proc. SPIE 12191 (2022): the kernel changes over the array",
    )

    couplings: tuple[Coupling, ...] = quantity(FOUR_ROWS)
    """list of couplings: dy, dx (px, from source to receiver), share, per_ke (change of the share
    with the signal, 1/ke-); every_rows, row, every_columns, column (sources)"""

    def __post_init__(self) -> None:
        most = largest_outflow(self.couplings)
        if most >= 0.5:
            raise InputError(
                f"couplings: some pixels lose {most:.2f} of their signal; the limit is 0.5"
            )

    @classmethod
    def nearest(cls, share: float, diagonal: float = 0.0) -> Self:
        """Equal shares to the four nearest pixels, and another share to the diagonal ones."""
        corners = [diagonal, share, diagonal]
        return cls.of_kernel(np.array([corners, [share, 0, share], corners]))

    @classmethod
    def of_kernel(cls, kernel: F64, **sources: int) -> Self:
        """A dense kernel of odd size, the same for all pixels or for some ``sources``.

        ``kernel[c + dy, c + dx]`` is the share that the pixel at (dy, dx) receives. The centre is
        not used: a pixel keeps the rest.
        """
        kernel = np.asarray(kernel, float)
        y, x = (n // 2 for n in kernel.shape)
        if kernel.shape != (2 * y + 1, 2 * x + 1):
            rows, columns = kernel.shape
            raise InputError(
                f"a kernel needs odd numbers of rows and columns, not {rows} x {columns}"
            )
        others = [(int(v), int(u)) for v, u in np.argwhere(kernel) if (v, u) != (y, x)]
        return cls(tuple(Coupling(v - y, u - x, float(kernel[v, u]), **sources) for v, u in others))

    @classmethod
    def of_rows(cls, kernels: Sequence[F64]) -> Self:
        """A dense kernel, as in `of_kernel`, for sources in each of n rows, which repeat."""
        rows = [cls.of_kernel(k, every_rows=len(kernels), row=n) for n, k in enumerate(kernels)]
        return cls(tuple(coupling for own in rows for coupling in own.couplings))

    @property
    def halo(self) -> int:
        """Reach of the longest coupling, rows."""
        return max((abs(c.dy) for c in self.couplings), default=0)

    def signal(self, signal: F32, shot: Shot) -> F32:
        return couple(signal, self.couplings, (shot.rows[0], 0))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Kernel from hot pixels in darks, the noise of flats and fringes, and the maps, joined."""
        found = detect(evidence)
        if found is None:
            return None
        kernel, nothing = measure(found), Estimate(cls(()), {}, found.significance, _NONE)
        if kernel is None:
            return nothing
        couplings, covariance = significant(kernel)
        if not couplings:
            return nothing
        (per_ke, per_ke_error), sigma = kernel.per_ke, np.sqrt(np.diag(covariance))
        errors = {f"couplings[{n}].share": float(s) for n, s in enumerate(sigma)}
        law = f"a kernel of {len(couplings)} couplings, all significant"
        if per_ke:
            errors |= {f"couplings[{n}].per_ke": per_ke_error for n in range(len(sigma))}
            law += f", whose shares change by {100 * per_ke:+.3g} % per ke-"
            law += ", or are constant if brighter_fatter acts too" * kernel.either
        n = int(np.abs([c.share for c in couplings]).argmax())
        of = f"at (dy, dx) = {couplings[n].dy, couplings[n].dx}"
        of += f", the largest of {len(couplings)} couplings" * (len(couplings) > 1)
        rows, columns = (
            max(getattr(c, n) for c in couplings) for n in ("every_rows", "every_columns")
        )
        return Estimate(
            cls(couplings),
            errors,
            found.significance,
            f"{len(couplings)} couplings, repeating every {rows} rows and {columns} columns, in "
            + " and ".join(kernel.methods),
            law=law,
            size={"value": couplings[n].share, "error": float(sigma[n]), "unit": "", "of": of},
            in_full=cls(_worth_it(kernel.couplings)),
        )

    @classmethod
    def detect(cls, evidence: Evidence) -> float | None:
        found = detect(evidence)
        return None if found is None else found.significance

    def predict(self, maps: FringeMaps) -> FringeMaps:
        """Maps with the couplings: ``L (flat theta) / L flat`` (physics note, section 5).

        Signal-dependent shares are those at intensity and amplitude 1, for the flat at small
        signals. Pixels without data (NaN) stay so; as sources they are like their neighbours.
        """
        return self._changed(maps, couple_fringes, couple)

    def undo(self, maps: FringeMaps) -> FringeMaps:
        """Maps without the couplings: the inverse of `predict`, to rounding.

        A part of the window needs a margin of `undo_halo` rows and columns, except at the edge of
        the window.
        """
        return self._changed(maps, uncouple_fringes, uncouple)

    def _changed(
        self, maps: FringeMaps, of_theta: Callable[..., F64], of_flat: Callable[..., F64]
    ) -> FringeMaps:
        """Maps changed as charge, that is, before the division by the flat."""
        before = np.ones(maps.theta.shape[1:]) if maps.flat is None else maps.flat
        after = before
        if maps.flat is not None:
            after = np.maximum(of_flat(before, self._at_small_signals, maps.origin), MIN_FLAT)
        charge = filled(maps.theta * before, maps.k)
        theta = of_theta(charge, self.couplings, maps.origin) / after
        theta[:, ~np.isfinite(maps.theta).all(axis=0)] = np.nan
        return replace(maps, theta=theta, flat=None if maps.flat is None else after)

    def measured_again(self, parts: Iterable[Evidence]) -> Estimate | None:
        """All couplings within two pixels and those detected beyond, with the known period."""
        # Shares that are not significant are shrunk by their errors.
        if not self.couplings or any(c.per_ke for c in self.couplings):
            return None
        kernel = dense_kernel(parts, self.couplings)
        if kernel is None:
            return None
        return Estimate(
            type(self)(_worth_it(kernel.couplings)),
            {f"couplings[{n}].share": float(s) for n, s in enumerate(kernel.errors)},
            float("nan"),
            "every coupling within two pixels, measured on all frames",
            covariance=kernel.covariance,
        )

    def phase_slopes(self, maps: FringeMaps) -> F64:
        """As in `Effect.phase_slopes`: the source's fringe is added to that of the receiver."""
        flat = 1.0 if maps.flat is None else maps.flat
        z = (maps.theta[2] + 1j * maps.theta[1]) * flat
        slopes = np.zeros((len(self.couplings), *z.shape))
        for slope, c in zip(slopes, self.couplings, strict=True):
            here, there = c.places((z.shape[0], z.shape[1]), maps.origin)
            slope[there] = -np.imag(z[here] / z[there])
        return slopes

    @property
    def undo_halo(self) -> int:
        """Margin around a part of the window that `undo` needs for a precision of 1e-8, px."""
        reach = max((max(abs(c.dy), abs(c.dx)) for c in self.couplings), default=0)
        most = 2 * largest_outflow(self.couplings)
        return reach * math.ceil(math.log(1e-8) / math.log(most)) if 0 < most < 1 else 0

    def noise_factor(self, charge: float, read_noise: float, maps: FringeMaps) -> F64:
        """As in `Effect.noise_factor`: shot noise is coupled, read noise is added later."""
        shape = (maps.theta.shape[1], maps.theta.shape[2])
        shot, read = noise_shares(self._at_small_signals, shape, maps.origin)
        before, after = charge * shot + read_noise**2, charge + read_noise**2 * read
        # A fit scales its errors to the mean noise of the pixels.
        return np.asarray(np.sqrt(after / np.mean(before)))

    @property
    def _at_small_signals(self) -> tuple[Coupling, ...]:
        return tuple(replace(c, per_ke=0.0) for c in self.couplings)


def _worth_it(couplings: Sequence[Coupling]) -> tuple[Coupling, ...]:
    """The couplings, with negligible ones set to zero but kept for the covariance."""
    return tuple(c if abs(c.share) > MIN_SHARE else c.scaled(0.0) for c in couplings)
