"""Correction of centroids by the maps of a run: tables, and a WCS distortion.

FITS readers know offsets as a distortion: lookup tables, applied before all other transformations.
The headers name them by ``D2IMDIS1`` and ``D2IMDIS2``; the tables are in ``D2IMARR`` (Calabretta et
al. 2004, "Representations of distortions in FITS world coordinate systems"; as astropy reads them).
"""

from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from astropy.wcs import WCS, DistortionLookupTable

from pixcal import __version__
from pixcal.estimators.star_centroids import (
    Corrected,
    Star,
    correct_centroids,
    correction_map,
    gaussian_star,
)
from pixcal.model.arrays import F32, F64
from pixcal.model.errors import InputError, reason_of
from pixcal.model.options import FWHMS, Centroids, Wcs
from pixcal.stages.advice import maps_to_use
from pixcal.storage.folder import written_aside
from pixcal.storage.manifest import read_json
from pixcal.storage.products import read_map
from pixcal.storage.stage import read_acquisition


def read_offsets(run_dir: Path) -> tuple[F32, F32]:
    """Offsets along x and y, corrected ones if any, and errors, (2, y, x), px; NaN if unknown.

    With a single fringe axis, those across it are assumed to be zero.
    """
    maps = {name: read_map(path)[:2] for name, path in maps_to_use(run_dir).items()}
    if not maps:
        raise InputError(f"{run_dir}: has no map of offsets; run 'pixcal fit' again")
    if "delta_fringe" in maps:
        facts = read_json(run_dir / "fit" / "fit.json")["sets"]
        axis = np.array(next(iter(facts.values()))["axis"], np.float32)[:, None, None]
        delta, sigma = maps["delta_fringe"]
        return axis * delta, np.abs(axis * sigma)
    delta, sigma = (np.stack([maps[f"delta_{axis}"][n] for axis in "xy"]) for n in (0, 1))
    return delta, sigma


def star_of(run_dir: Path, fwhm_px: float, electrons: float | None) -> Star:
    """A star of some width; refused if that is out of range."""
    low, high = FWHMS
    if not low <= fwhm_px <= high:
        raise InputError(f"--fwhm: {fwhm_px:g} px; give a width from {low:g} to {high:g} px")
    if electrons is not None and not 0 < electrons < np.inf:
        raise InputError(f"--electrons: {electrons:g}; give a number above zero")
    return gaussian_star(fwhm_px, electrons, read_acquisition(run_dir).detector.read_noise_e)


def correct(run_dir: Path, place: F64, *, fwhm_px: float, electrons: float | None) -> Corrected:
    """Correct centroids (n, 2), px from the centre of the first pixel."""
    delta, sigma = read_offsets(run_dir)
    return correct_centroids(place, delta, sigma, star_of(run_dir, fwhm_px, electrons))


def correct_table(run_dir: Path, file: Path, config: Centroids) -> Corrected:
    """Write a table with columns added: ``<x>_corrected``, ``<x>_map_error``; the same of y."""
    table, first, out = _read_table(file), int(config.origin), config.out
    names = {"--x": config.x, "--y": config.y}
    measured = np.stack([_column(table, n, file, option) for option, n in names.items()], axis=1)
    corrected = correct(
        run_dir, measured - first, fwhm_px=config.fwhm_px, electrons=config.electrons
    )
    for n, name in enumerate(names.values()):
        table[f"{name}_corrected"] = corrected.place[:, n] + first
        table[f"{name}_map_error"] = corrected.error[:, n]
    if out.exists() and not config.overwrite:
        raise InputError(f"{out}: exists; choose another --out, or add --overwrite")
    kinds = {".csv": "ascii.csv", ".ecsv": "ascii.ecsv", ".fits": "fits", ".vot": "votable"}
    if out.suffix.lower() not in kinds:
        raise InputError(f"{out}: the ending of the name must be one of {', '.join(kinds)}")
    table.write(out, format=kinds[out.suffix.lower()], overwrite=config.overwrite)
    return corrected


def _read_table(path: Path) -> Table:
    kinds = {".csv": "ascii.csv", ".ecsv": "ascii.ecsv", ".txt": "ascii", ".dat": "ascii"}
    try:
        return Table.read(path, format=kinds.get(path.suffix.lower()))
    except Exception as error:  # the readers raise a dozen kinds, all of which mean one thing
        reason = reason_of(error)[:200] if path.exists() else "no such file"
        raise InputError(
            f"{path}: cannot be read as a table ({reason}); give CSV, ECSV, FITS or VOTable"
        ) from error


def _column(table: Table, name: str, path: Path, option: str) -> F64:
    """Numbers of a column; NaN where it is masked."""
    if name not in table.colnames:
        raise InputError(
            f"{option}: {path} has no column {name!r}; its columns are {', '.join(table.colnames)}"
        )
    try:
        values: Any = np.ma.filled(np.ma.asarray(table[name], dtype=float), np.nan)
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{option}: column {name!r} of {path} holds no numbers; name another"
        ) from error


def wcs_of(run_dir: Path, *, fwhm_px: float | None) -> WCS:
    """A WCS whose detector-to-image step corrects pixels, or stars of some width."""
    star = None if fwhm_px is None else star_of(run_dir, fwhm_px, None)
    correction = correction_map(read_offsets(run_dir)[0], star)
    wcs = WCS(naxis=2)
    wcs.pixel_shape = correction.shape[:0:-1]
    # A pixel of the table is a pixel of the detector, both counted from 1.
    wcs.det2im1, wcs.det2im2 = (
        DistortionLookupTable(np.ascontiguousarray(part), (1.0, 1.0), (1.0, 1.0), (1.0, 1.0))
        for part in correction
    )
    return wcs


def write_wcs(run_dir: Path, config: Wcs) -> None:
    """Write `wcs_of` to a FITS file."""
    out, fwhm_px = config.out, config.fwhm_px
    if out.exists() and not config.overwrite:
        raise InputError(f"{out}: exists; choose another --out or add --overwrite")
    names = " and ".join(path.name for path in maps_to_use(run_dir).values())
    of = "pixels" if fwhm_px is None else f"stars of FWHM {fwhm_px:g} px"
    hdus = wcs_of(run_dir, fwhm_px=fwhm_px).to_fits(relax=True)
    hdus[0].header["CREATOR"] = (f"pixcal {__version__}", "program that wrote this file")
    hdus[0].header.add_history(f"offsets of {of}, from {names}")
    with written_aside(out) as aside:
        hdus.writeto(aside, overwrite=True)
