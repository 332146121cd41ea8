"""The fringes of a set as a run fitted them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pixcal.estimators.fringe_fit.models import FringeShape
from pixcal.estimators.fringe_fit.models.hyperbolic import Hyperbolic
from pixcal.estimators.fringe_fit.models.paraxial import Paraxial
from pixcal.kernels.optics import PARAMETERS, Geometry
from pixcal.model.acquisition import Acquisition
from pixcal.model.errors import InputError


def fitted_shape(
    run: Path, facts: Mapping[str, Any], acquisition: Acquisition, window: tuple[int, int]
) -> FringeShape:
    """The fringes of a set as fitted, from pixel (0, 0).

    Parameters
    ----------
    run : Path
        For messages.
    facts : mapping
        What ``fit.json`` says of the set.
    window : (int, int)
        (y, x), px.

    Raises
    ------
    InputError
        If they were fitted by a model that is not known here.
    """
    phase, origin = facts["phase_at_origin_rad"], (0.0, 0.0)
    if facts["model"] == "paraxial":
        return Paraxial(phase, facts["kx"], facts["ky"], origin, max(window) / 2)
    if facts["model"] != "hyperbolic":
        raise InputError(
            f"{run}: fitted with {facts['model']!r} fringes, whose modes are not known"
        )
    geometry = Geometry(
        acquisition.fibres.wavelength_nm * 1e-6,
        acquisition.detector.pitch_um * 1e-3,
        *(facts["geometry"][f"{name}_mm"] for name in PARAMETERS),
    )
    return Hyperbolic(phase, geometry, tuple(geometry.vector()), (1.0,) * len(PARAMETERS), origin)
