"""Light as a sum of coherent beams, and the part that pixels collect.

The intensity at place r in frame t, from beams j of amplitude a_j, static phase theta_j and fibre
phase phi_j, and incoherent light S, is

    I(r, t) = sum_j a_j² + 2 sum_{j<k} gamma_jk a_j a_k cos(theta_j - theta_k + phi_j - phi_k) + S

One fibre is modulated. Interference of beams of the same fibre is static and belongs to the mean
light; interference of beams of both fibres follows the modulator (Born & Wolf, Principles of
Optics, sections 7.2 and 10.3).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from pixcal.model.arrays import C128, F32, F64

MODULATED, FIXED = "modulated", "fixed"  # the fibres


@dataclass(frozen=True)
class Beam:
    """A coherent beam on rows of the window."""

    amplitude: F64  # (y, x) its square: light that a pixel of unit response collects from it, e-
    phase: F64 | float  # (y, x) rad, at the positions of the pixels
    fibre: str = FIXED
    crossed: bool = False  # polarised orthogonally to the other fibre, so they do not interfere

    @cached_property
    def field(self) -> C128:
        """Complex amplitude (y, x)."""
        return np.asarray(self.amplitude * np.exp(1j * self.phase))

    def delayed(self, phase: F64) -> Self:
        """The same beam over a longer path: phase (y, x) added, rad."""
        return replace(self, phase=self.phase + phase)

    def reflected(self, share: float, phase: F64, *, crossed: bool = False) -> Self:
        """A ghost of the beam: ``share`` of its amplitude, phase (y, x) added, rad."""
        ghost = replace(self, amplitude=share * self.amplitude, crossed=self.crossed or crossed)
        return ghost.delayed(phase)


@dataclass(frozen=True)
class LightMaps:
    """Fringes that pixels collect on rows of the window, for `synthesis.illuminate`; e-."""

    iota: F32
    alpha_sin: F32
    alpha_cos: F32

    @property
    def phasor(self) -> C128:
        """Fringe amplitude times exp(i psi), (y, x)."""
        return np.asarray(self.alpha_cos.astype(float) + 1j * self.alpha_sin)

    @classmethod
    def of(cls, iota: F64, phasor: C128) -> Self:
        """From the mean and the complex amplitude of the fringes."""
        return cls(*(m.astype(np.float32) for m in (iota, phasor.imag, phasor.real)))


@dataclass(frozen=True)
class Light:
    """All light of a recording on rows of the window, before the pixels."""

    beams: tuple[Beam, ...]
    coherence: F64 | float = 1.0  # (y, x) mutual coherence of the fibres
    incoherent: F64 | float = 0.0  # (y, x) e-

    @classmethod
    def of_fringes(cls, iota: F64, phasor: C128) -> Self:
        """Two equal beams that give these maps (y, x): mean light, complex fringe amplitude."""
        each = np.sqrt(np.maximum(iota, 0) / 2)
        size = np.abs(phasor)
        coherence = np.divide(size, iota, out=np.zeros_like(size), where=iota > 0)
        return cls((Beam(each, np.angle(phasor), MODULATED), Beam(each, 0.0)), coherence)

    @cached_property
    def power(self) -> F64:
        """Sum (y, x) of the beams without interference, e-."""
        return np.asarray(sum(beam.amplitude**2 for beam in self.beams))

    @cached_property
    def mean(self) -> F64:
        """Light (y, x) that does not follow the modulator, e-."""
        each = [self._field(fibre) for fibre in (MODULATED, FIXED)]
        return np.asarray(sum(f.real**2 + f.imag**2 for f in each) + self.incoherent)

    @cached_property
    def phasor(self) -> C128:
        """Complex amplitude (y, x) of the fringes that follow the modulator, e-."""
        one, other = (self._field(fibre, crossed=False) for fibre in (MODULATED, FIXED))
        return np.asarray(2 * self.coherence * one * np.conj(other))

    def collected(self, response: F32) -> LightMaps:
        """Light that pixels of given response (y, x) collect."""
        return LightMaps.of(response * self.mean, response * self.phasor)

    def masked(self, transmission: F64) -> Self:
        """The light behind a mask of given transmission (y, x)."""
        beams = (replace(b, amplitude=b.amplitude * np.sqrt(transmission)) for b in self.beams)
        dimmed = self.incoherent * transmission
        return replace(self, beams=tuple(beams), incoherent=dimmed)

    def with_beams(self, more: Sequence[Beam]) -> Self:
        """The light with further beams."""
        return replace(self, beams=(*self.beams, *more))

    def with_incoherent(self, more: F64) -> Self:
        """The light with further incoherent light (y, x), e-."""
        return replace(self, incoherent=self.incoherent + more)

    def _field(self, fibre: str, *, crossed: bool = True) -> C128:
        fields = [b.field for b in self.beams if b.fibre == fibre and (crossed or not b.crossed)]
        return np.asarray(sum(fields)) if fields else np.zeros((1, 1), complex)


def with_margin(light: LightMaps, margin: int) -> LightMaps:
    """The light with a margin of pixels like those at the edge, in which the fringes continue."""
    # The phase continues by its step along each row, and from row to row at the edge, so a part of
    # the window has the same margin as the whole at common edges.
    z = light.alpha_cos + 1j * light.alpha_sin
    beyond = np.arange(1, margin + 1)
    step = np.angle(np.sum(z[:, 1:] * z[:, :-1].conj(), axis=1))[:, None]
    left, right = np.exp(-1j * step * beyond[::-1]), np.exp(1j * step * beyond)
    z = np.hstack([z[:, :1] * left, z, z[:, -1:] * right])
    up, down = (np.angle(np.sum(b * a.conj())) for a, b in ((z[:2][-1], z[0]), (z[-2:][0], z[-1])))
    above, below = np.exp(1j * up * beyond[::-1, None]), np.exp(1j * down * beyond[:, None])
    z = np.vstack([z[:1] * above, z, z[-1:] * below])
    iota = np.pad(light.iota, margin, "edge")
    return LightMaps(iota, z.imag.astype(np.float32), z.real.astype(np.float32))
