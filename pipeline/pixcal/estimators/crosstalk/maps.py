"""Couplings from the maps of a fit, class by class of pixels: visibility, and offsets.

A pixel that receives the share k from one a step n away has its fringe multiplied by ``1 + k
(exp(-i K n) - 1)``, whatever the flat, to first order. The real part changes the visibility, the
imaginary part shifts the offset by ``1 / |K|`` of it. A true displacement is the same at every K,
so only differences of offsets between sets count; this needs more than one set per axis. The
visibility needs one set, if pixels of all classes are equally wide (to within `WIDTH`).

True offsets have a pattern of classes by chance, or a real one, whose size is learnt together with
the couplings (`kernel`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pixcal.estimators.crosstalk.links import REACH, PixelClasses
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.fringe_fit.fringes import grid, polynomial_basis
from pixcal.estimators.fringe_fit.gauge import fringe_modes
from pixcal.estimators.maps.corrected import phase_change
from pixcal.kernels.crosstalk import Coupling, filled, uncouple_fringes
from pixcal.kernels.medians import median_and_sigma
from pixcal.model.arrays import F64, Mask

CLIP = 5.0  # offsets and visibilities beyond this many robust deviations are outliers
ROUNDS = 4  # iterations of clipping: smooth modes are fitted better without outliers
WIDTH = 0.01  # prior 1-sigma of the width of a class of pixels relative to others, px
DEGREE = 3  # of the polynomial that absorbs smooth variation
MIN_PIXELS = 100


@dataclass(frozen=True)
class Maps:
    """Maps of all sets without smooth modes, corrected for known couplings."""

    sets: tuple[FringeEvidence, ...]
    good: Mask  # (y, x) pixels with an offset in every set
    known: tuple[Coupling, ...] = ()

    @classmethod
    def of(cls, evidence: Evidence, known: tuple[Coupling, ...] = ()) -> "Maps | None":
        """None without fringes."""
        sets = tuple(evidence.fringes.values())
        rows, columns = evidence.good.shape
        y, x = min(REACH, rows // 8), min(REACH, columns // 8)
        good = np.zeros(evidence.good.shape, bool)
        good[y : rows - y, x : columns - x] = True
        for fringes in sets:
            good &= fringes.good & np.isfinite(fringes.delta)
        return cls(sets, good, known) if sets and good.sum() >= MIN_PIXELS else None

    def sums(self, couplings: Sequence[Coupling], classes: PixelClasses) -> tuple[F64, F64]:
        """Least-squares sums (m, m), (m,) of the shares and of a true pattern of the offsets.

        First n remaining shares, then the true mean offset along x and along y of each class, px.
        """
        number = classes.of(*np.nonzero(self.good))
        members = (number == np.arange(classes.count)[:, None]).astype(float)
        members -= (members @ self._smooth.T) @ self._smooth
        gram = members @ members.T
        size, each = len(couplings), np.eye(classes.count)
        receivers = [
            (c.row + c.dy) % classes.rows * classes.columns + (c.column + c.dx) % classes.columns
            for c in couplings
        ]
        normal = np.zeros((size + 2 * classes.count,) * 2)
        right = np.zeros(len(normal))
        slopes, values = [], []
        for fringes, (delta, logs, spread) in zip(self.sets, self._values, strict=True):
            k = float(np.hypot(*fringes.k))
            turn = [
                np.exp(-1j * (fringes.k[0] * c.dx + fringes.k[1] * c.dy)) - 1 for c in couplings
            ]
            slope = np.array(turn)[:, None] * each[receivers]
            # Pixels of a class may be wider than others by `WIDTH`.
            weight = spread**-2
            inner = gram + np.eye(len(gram)) / (weight * (WIDTH * k**2 / 12) ** 2)
            kept = weight * (np.eye(len(gram)) - gram @ np.linalg.inv(inner))
            normal[:size, :size] += slope.real @ kept @ gram @ slope.real.T
            right[:size] += slope.real @ kept @ (members @ logs)
            axis = np.array(fringes.k) / k
            slopes.append(np.vstack([slope.imag / k, axis[0] * each, axis[1] * each]))
            values.append(members @ delta)
        weighted = np.tensordot(self._weight, np.stack(slopes), 1)
        normal += np.einsum("aik,kl,ajl->ij", weighted, gram, np.stack(slopes), optimize=True)
        return normal, right + np.einsum("aik,ak->i", weighted, np.stack(values))

    def pattern(self, classes: PixelClasses) -> float:
        """Fall in chi-square if each class of a period has its own mean of log visibility."""
        number = classes.of(*np.nonzero(self.good))
        count = np.maximum(np.bincount(number, minlength=classes.count), 1)
        sums = [np.bincount(number, logs / s, classes.count) for _, logs, s in self._values]
        return float(sum(np.sum(own**2 / count) for own in sums))

    @cached_property
    def _smooth(self) -> F64:
        """Orthonormal (mode, pixel): smooth variation, and the fringes left by free light."""
        good = self.good
        y, x = grid(good.shape)
        modes = [polynomial_basis(good.shape, DEGREE)[good.ravel()].T]
        for fringes in self.sets:
            psi = np.broadcast_to(fringes.k[0] * x + fringes.k[1] * y, good.shape)[good]
            phasor = (fringes.theta[2] + 1j * fringes.theta[1])[good] * np.exp(-1j * psi)
            modes += fringe_modes(psi + np.angle(phasor.sum()), np.ones(len(psi)))
        return np.asarray(np.linalg.qr(np.vstack(modes).T)[0].T)

    @cached_property
    def _values(self) -> list[tuple[F64, F64, float]]:
        """Of each set: offsets (pixel,), px, logarithms of the visibility and their scatter."""
        values = []
        for one in self.sets:
            # Flagged pixels were fitted too, so their contribution to others is known.
            read = filled(one.theta / one.shot_factor, one.k)
            theta = uncouple_fringes(read, self.known, one.origin)
            shift = phase_change(read, theta) / np.hypot(*one.k)
            iota, sine, cosine = theta[:, self.good]
            logs, spread = self._clipped(np.log(np.hypot(sine, cosine) / iota))
            values.append((self._clipped((one.delta + shift)[self.good])[0], logs, spread))
        return values

    @cached_property
    def _weight(self) -> F64:
        """Inverse covariance (set, set) of the offsets of a pixel, scattered by its own offset."""
        k = np.array([one.k for one in self.sets])
        length = np.hypot(*k.T)
        axes = k / length[:, None]
        noise = [np.median(one.sigma[self.good]) for one in self.sets] / length
        scatter = np.array([median_and_sigma(delta)[1] for delta, *_ in self._values])
        variance = np.maximum(scatter**2 - noise**2, 0).mean()
        return np.linalg.inv(np.diag(noise**2) + variance * axes @ axes.T)

    def _clipped(self, values: F64) -> tuple[F64, float]:
        """Values without modes, zero where they are outliers, and their robust scatter."""
        # Outliers would move all modes, and fringe modes resemble a period of rows.
        for _ in range(ROUNDS):
            rest = values - (values @ self._smooth.T) @ self._smooth
            sigma = float(median_and_sigma(rest)[1])
            usual = np.abs(rest) < CLIP * sigma
            values = np.where(usual, values, values - rest)
        return np.where(usual, rest, 0.0), sigma
