"""The fringes of a set: nominal, and as a run fitted them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pixcal.estimators.fringe_fit.shapes import FringeShape
from pixcal.estimators.fringe_fit.shapes.hyperbolic import Hyperbolic
from pixcal.estimators.fringe_fit.shapes.paraxial import Paraxial
from pixcal.kernels.optics import PARAMETERS, Geometry, paraxial_vector
from pixcal.model.acquisition import Acquisition
from pixcal.model.errors import InputError


def nominal_geometry(
    acquisition: Acquisition, name: str, reference: tuple[float, float] = (0.0, 0.0)
) -> Geometry:
    """Nominal geometry of a set, the fibres centred in front of point (y, x) of the window, px."""
    (baseline,) = (s.baseline_mm for s in acquisition.frames.fringes if s.name == name)
    optics, pitch = acquisition.fibres, acquisition.detector.pitch_um * 1e-3
    centre = (reference[1] * pitch, reference[0] * pitch)
    return Geometry(optics.wavelength_nm * 1e-6, pitch, *centre, optics.distance_mm, *baseline)


def nominal_vector(acquisition: Acquisition, name: str) -> tuple[float, float]:
    """Nominal fringe vector (kx, ky) of a set in rad/px (paper, equation 4)."""
    return paraxial_vector(nominal_geometry(acquisition, name))


def fitted_shape(
    run: Path, facts: Mapping[str, Any], acquisition: Acquisition, window: tuple[int, int]
) -> FringeShape:
    """The fringes of a set as fitted (``fit.json``), from pixel (0, 0) of a window (y, x) px."""
    phase, origin = facts["phase_at_origin_rad"], (0.0, 0.0)
    if facts["model"] == "paraxial":
        return Paraxial(phase, facts["kx"], facts["ky"], origin, max(window) / 2)
    if facts["model"] != "hyperbolic":
        raise InputError(
            f"{run}: fitted with {facts['model']!r} fringes, unknown here; run 'pixcal fit' again"
        )
    geometry = Geometry(
        acquisition.fibres.wavelength_nm * 1e-6,
        acquisition.detector.pitch_um * 1e-3,
        *(facts["geometry"][f"{name}_mm"] for name in PARAMETERS),
    )
    return Hyperbolic(phase, geometry, tuple(geometry.vector()), (1.0,) * len(PARAMETERS), origin)
