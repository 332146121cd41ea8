"""What ``crests.json`` says of a fringe set: geometry, warnings, agreement with the fit."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from pixcal.kernels.optics import PARAMETERS, Geometry, phase, phase_jacobian
from pixcal.model.arrays import F64
from pixcal.stages.crests.crest_fit import CrestFit
from pixcal.stages.crests.crests import CrestPaths

NOTABLE_CHI2 = 3.0  # from here on the reduced chi-square of the points is pointed out


def warnings(fit: CrestFit) -> list[str]:
    """Sentences on the scatter of the points and on outliers."""
    sentences = []
    if fit.chi2_reduced > NOTABLE_CHI2:
        sentences.append(
            f"points scatter {np.sqrt(fit.chi2_reduced):.1f} times more than their noise. The "
            "errors include this, but are too small if whole blocks of pixels are offset"
        )
    lost = int((~fit.used).sum())
    if lost > 0.05 * len(fit.used):
        sentences.append(f"{lost} of {len(fit.used)} points are outliers and were left out")
    return sentences


def geometry_facts(fit: CrestFit) -> dict[str, float]:
    """Each parameter with its error, its nominal value and the error of the prior, mm."""
    columns = {
        "_mm": fit.geometry.vector(), "_sigma_mm": fit.sigma,
        "_nominal_mm": fit.prior.nominal.vector(), "_prior_sigma_mm": fit.prior.sigma,
    }  # fmt: skip
    return {
        name + suffix: float(values[n])
        for n, name in enumerate(PARAMETERS)
        for suffix, values in columns.items()
    }


def fitted_geometry(
    facts: Mapping[str, Any] | None, nominal: Geometry
) -> tuple[tuple[Geometry, F64] | None, str]:
    """Geometry of the hyperbolic fit and its errors (mm), or why there is none."""
    if facts is None:
        return None, "RUN/fit is not there yet"
    if facts["model"] != "hyperbolic":
        return None, f"the fit took {facts['model']} fringes, which have no positions of the fibres"
    fitted = facts["geometry"]
    geometry = nominal.with_vector([fitted[f"{name}_mm"] for name in PARAMETERS])
    return (geometry, np.array([fitted[f"{name}_sigma_mm"] for name in PARAMETERS])), ""


def agreement(paths: CrestPaths, fit: CrestFit, other: Geometry, sigma: F64) -> dict[str, Any]:
    """Differences to another fit's geometry, parameter by parameter and in what they predict."""
    difference = fit.geometry.vector() - other.vector()
    both = np.hypot(fit.sigma, sigma)
    ny, nx = paths.frame
    y, x = (a.ravel() for a in np.mgrid[0 : ny - 1 : 33j, 0 : nx - 1 : 33j])
    difference_rad = phase(x, y, fit.geometry) - phase(x, y, other)
    modes = phase_jacobian(x, y, fit.geometry)
    modes -= modes.mean(axis=0)
    expected = np.einsum("ni,ij,nj->n", modes, fit.covariance, modes)
    px = paths.interfringe / (2 * np.pi)
    return {
        "parameters": {
            name: {"difference_mm": d, "sigma_mm": s, "difference_sigma": d / s, "from_prior": held}
            for name, d, s, held in zip(
                PARAMETERS, difference.tolist(), both.tolist(), fit.from_prior.tolist(), strict=True
            )
        },
        "phase_rms_px": float(np.std(difference_rad) * px),
        "phase_max_px": float(np.max(np.abs(difference_rad - difference_rad.mean())) * px),
        "phase_sigma_px": float(np.sqrt(expected.mean()) * px),
    }
