"""Correction of centroids by the maps of a run: tables, and a WCS distortion."""

from pathlib import Path

import numpy as np
from astropy.wcs import WCS

from pixcal.estimators.star_centroids import (
    Corrected,
    Star,
    correct_centroids,
    correction_map,
    gaussian_star,
)
from pixcal.model.arrays import F32, F64
from pixcal.model.errors import InputError
from pixcal.model.options import FWHMS, Centroids, Wcs
from pixcal.stages.advice import maps_to_use
from pixcal.storage.manifest import read_json
from pixcal.storage.products import read_map
from pixcal.storage.stage import read_acquisition
from pixcal.storage.star_files import column, distortion, read_table, write_distortion, write_table


def read_offsets(run_dir: Path) -> tuple[F32, F32]:
    """Offsets along x and y, corrected ones if any, and errors, (2, y, x), px; NaN if unknown.

    With a single fringe axis, those across it are taken as zero.
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
    table, first = read_table(file), int(config.origin)
    names = {"--x": config.x, "--y": config.y}
    measured = np.stack([column(table, n, file, option) for option, n in names.items()], axis=1)
    corrected = correct(
        run_dir, measured - first, fwhm_px=config.fwhm_px, electrons=config.electrons
    )
    for n, name in enumerate(names.values()):
        table[f"{name}_corrected"] = corrected.place[:, n] + first
        table[f"{name}_map_error"] = corrected.error[:, n]
    write_table(table, config.out, overwrite=config.overwrite)
    return corrected


def wcs_of(run_dir: Path, *, fwhm_px: float | None) -> WCS:
    """The maps as a distortion: of the pixels themselves, or of stars of some width."""
    delta, _ = read_offsets(run_dir)
    star = None if fwhm_px is None else star_of(run_dir, fwhm_px, None)
    return distortion(correction_map(delta, star))


def write_wcs(run_dir: Path, config: Wcs) -> None:
    """Write `wcs_of` to a FITS file."""
    out, fwhm_px = config.out, config.fwhm_px
    if out.exists() and not config.overwrite:
        raise InputError(f"{out}: exists; choose another --out or add --overwrite")
    names = " and ".join(path.name for path in maps_to_use(run_dir).values())
    of = "pixels" if fwhm_px is None else f"stars of FWHM {fwhm_px:g} px"
    write_distortion(wcs_of(run_dir, fwhm_px=fwhm_px), out, f"offsets of {of}, from {names}")
