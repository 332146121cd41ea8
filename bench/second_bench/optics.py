"""Light on the detector: modes of fibres, propagated to the far field by HCIPy.

A fibre's tip is some 2 um wide and the detector 400 mm away: the Fresnel number is 1e-5, so the
detector is in the far zone of each fibre. There the Rayleigh-Sommerfeld integral is a spherical
wave from the tip times the Fourier transform of the mode at the sine of the angle to its axis
(Goodman, Introduction to Fourier Optics, 3rd ed., 3.5 and 4.3). HCIPy does the transform; the wave
is exact.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import hcipy
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from second_bench.model import F64, Beam, Bench, FringeSet, Run

C128 = NDArray[np.complex128]
V_NUMBER = 2.2
"""Of the fibres: single-mode below 2.405."""
_NODES = 25


def lp01(waist_um: float, wavelength_nm: float) -> Any:
    """The mode of a step-index fibre (HCIPy field).

    The core follows from the waist by Marcuse's fit (Bell Syst. Tech. J. 56, 703, 1977).
    """
    core = waist_um * 1e-6 / (0.65 + 1.619 / V_NUMBER**1.5 + 2.879 / V_NUMBER**6)
    aperture = V_NUMBER * wavelength_nm * 1e-9 / (2 * np.pi * core)
    grid = hcipy.make_pupil_grid(96, 16 * core)
    return hcipy.make_lp_modes(grid, 2 * np.pi / (wavelength_nm * 1e-9) * core * aperture, core)[0]


def gaussian(waist_um: float, wavelength_nm: float) -> Any:
    """A Gaussian mode of the same waist."""
    grid = hcipy.make_pupil_grid(96, 14e-6 * waist_um)
    r2 = grid.x**2 + grid.y**2
    return hcipy.Field(np.exp(-r2 / (waist_um * 1e-6) ** 2), grid)


@cache
def _on_axis(mode: Any, waist_um: float, wavelength_nm: float, distance_mm: float) -> float:
    axes = np.array([0.0, 1.0])
    return float(_far(mode, waist_um, wavelength_nm, distance_mm, axes, axes)[0, 0])


def _far(
    mode: Any, waist_um: float, wavelength_nm: float, distance_mm: float, u: F64, v: F64
) -> F64:
    """Amplitude at distance times the sine of the angle, (v, u), mm."""
    field = mode(waist_um, wavelength_nm)
    out = hcipy.CartesianGrid(hcipy.SeparatedCoords((u * 1e-3, v * 1e-3)))
    far = hcipy.FraunhoferPropagator(field.grid, out, focal_length=distance_mm * 1e-3)
    wave = far(hcipy.Wavefront(field, wavelength_nm * 1e-9))
    amplitude = np.abs(np.asarray(wave.electric_field))
    return np.asarray(amplitude.reshape(len(v), len(u)), float)


def field_of(bench: Bench, beam: Beam, mode: Any = lp01) -> C128:
    """Field of a beam at the pixels' positions (y, x)."""
    x, y = bench.grid()
    x = (x + bench.delta_x) * bench.pitch_um * 1e-3
    y = (y + bench.delta_y) * bench.pitch_um * 1e-3
    far, (sx, sy, sz) = bench.distance_mm, beam.tip_mm
    path = np.sqrt((x - sx) ** 2 + (y - sy) ** 2 + (far - sz) ** 2)
    # The path minus the distance, without cancellation.
    beyond = ((x - sx) ** 2 + (y - sy) ** 2 - 2 * far * sz + sz**2) / (path + far)
    axis = np.array([*beam.aim_mm, far]) - beam.tip_mm
    axis /= np.linalg.norm(axis)
    u, v = far * ((x - sx) / path - axis[0]), far * ((y - sy) / path - axis[1])
    described = (mode, beam.waist_um, bench.wavelength_nm, far)
    nodes = [np.linspace(w.min() - 0.1, w.max() + 0.1, _NODES) for w in (u, v)]
    table = _far(*described, *nodes) / _on_axis(*described)
    amplitude = RectBivariateSpline(nodes[1], nodes[0], table).ev(v, u) * far / path
    wavenumber = 2e6 * np.pi / bench.wavelength_nm
    return np.asarray(
        beam.amplitude * amplitude * np.exp(1j * (wavenumber * beyond + beam.delay_rad))
    )


@dataclass(frozen=True)
class Light:
    """Light of a fringe set, in electrons (y, x): each fibre, and the interference term."""

    first: F64
    second: F64
    cross: C128
    stray: F64


def light_of(bench: Bench, one: FringeSet, mode: Any = lp01) -> Light:
    """Light of a set, scaled to its brightest pixel."""
    fibres = np.zeros((2, 2, *bench.shape), complex)
    for beam in one.beams:
        field = field_of(bench, beam, mode)
        for polarisation, share in enumerate(beam.jones):
            fibres[beam.fibre, polarisation] += share * field
    first, second = (np.abs(fibres) ** 2).sum(1)
    cross = 2 * one.coherence * (fibres[0].conj() * fibres[1]).sum(0)
    stray = one.stray * (first + second).mean()
    scale = one.peak_e / (first + second + stray + np.abs(cross)).max()
    return Light(scale * first, scale * second, scale * cross, scale * stray)


def expose(light: Light, run: Run, index: int, grid: tuple[F64, F64]) -> F64:
    """Mean electrons (y, x) of a frame, at a response of one."""
    a, b = run.power[index]
    turn = np.exp(1j * run.phase[index]) * np.sqrt(a * b) * run.contrast[index]
    cross = light.cross * turn
    if run.tilt[index].any() or run.row_phase[index].any():
        x, y = grid
        kx, ky = run.tilt[index]
        rows = np.exp(1j * (ky * y + run.row_phase[index][:, None]))
        cross = cross * (np.exp(1j * kx * x) * rows)
    return np.asarray(a * light.first + b * light.second + cross.real + light.stray)
