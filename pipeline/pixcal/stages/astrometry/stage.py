"""``pixcal astrometry``: how much the maps improve star centroids.

docs/reference/products-other.md describes ``astrometry.json``; ``astrometry.zarr`` holds maps
of errors.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pixcal import __version__
from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime
from pixcal.estimators.star_centroids import Star
from pixcal.model.acquisition import Acquisition
from pixcal.model.arrays import F64
from pixcal.model.config import result_options
from pixcal.model.errors import InputError
from pixcal.model.options import Astrometry as Config
from pixcal.report.astrometry_figures import AstrometryView, astrometry_figure
from pixcal.report.drawing import png
from pixcal.stages.astrometry import stars
from pixcal.stages.astrometry.detector import (
    BAND,
    Component,
    DegenerateModes,
    PixelPositions,
    free_from_modes,
    open_components,
)
from pixcal.stages.astrometry.stars import ErrorMaps, Telescope
from pixcal.stages.astrometry.summary import TARGET_PX, axis_facts, table
from pixcal.stages.fitted_shape import fitted_shape
from pixcal.stages.tiles import centred
from pixcal.storage.artefact import Build
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import Manifest, file_digest, read_json, write_json
from pixcal.storage.stage import make, read_acquisition, working

SCHEMA = "pixcal/astrometry/1"

CURVE = np.geomspace(1e4, 1e12, 49)  # electrons of the curve of errors
DETAIL = 128  # side of the part of the error maps that is shown in full resolution, px
FIGURE_BYTES = 160 << 20  # Matplotlib and one figure
_BYTES_PER_PIXEL = 180  # peak of a task per pixel (measured)
_BYTES_PER_PIXEL_AND_MODE = 13  # additional per mode if there is a truth (measured)
_BYTES_PER_FITTED_MODE = 28  # peak of a task of the modes' fit, per pixel and mode (measured)
# peak of a task of the stars, per pixel of a star's windows (measured)
_BYTES_PER_WINDOW_PIXEL = 200


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Compare centroids on a perfect grid with centroids on the maps in ``RUN/products``."""
    with working(run_dir, "fit") as inputs:
        acquisition = read_acquisition(run_dir)
        telescope = Telescope(
            config.diameter_m,
            config.focal_length_m,
            config.wavelength_nm,
            config.obscuration,
            acquisition.detector.pitch_um,
        )
        fit = read_json(run_dir / "fit" / "fit.json")
        components = open_components(run_dir, fit, config.truth)
        for component in components:
            inputs[component.delta.path.name] = file_digest(component.delta.path)
            for _, image in component.truth:
                inputs[f"truth/{image.path.name}"] = file_digest(image.path)
        shape = components[0].delta.shape

        def body(made: Build) -> None:
            modes = None
            if config.truth is not None:
                sets = (fitted_shape(run_dir, s, acquisition, shape) for s in fit["sets"].values())
                modes = DegenerateModes(shape, tuple(sets))
            _measure(made, components, modes, acquisition, telescope, config, runtime)

        options = result_options(config) | {"truth": None}
        return make(run_dir, STAGES["astrometry"], options, inputs, body)


def _measure(
    made: Build,
    components: list[Component],
    modes: DegenerateModes | None,
    acquisition: Acquisition,
    telescope: Telescope,
    config: Config,
    runtime: Runtime,
) -> None:
    shape = components[0].delta.shape
    observed = _star(telescope, config, acquisition, shape)
    need = planned(shape, modes.number if modes else 0, observed.side, config)
    runtime = within_memory("astrometry", *need, runtime)
    removed = None
    if modes is not None:
        components, removed = free_from_modes(components, modes, runtime)
    detector = PixelPositions(tuple(components), config.seed)
    maps = stars.error_maps(made.folder / "astrometry.zarr", detector, observed, runtime)
    if not maps.places.any():
        raise InputError(
            f"{components[0].delta.path}: masked pixels leave no place for a star and its window "
            f"of {observed.side} px; try a smaller --window"
        )
    errors = stars.observe(detector, observed, config, runtime)
    result = {
        "schema": SCHEMA,
        "pixcal": __version__,
        "detector": {
            "pixels": "the maps plus random errors of size SIGMA" if detector.drawn else "truth",
            "truth": None if config.truth is None else str(config.truth),
            "shape": list(shape),
            "places": int(maps.places.sum()),
            "modes_removed_px": removed,
        },
        "telescope": telescope.facts(),
        "stars": {
            "number": config.stars,
            "positions": config.positions,
            "positions_used": int(np.isfinite(errors).all(axis=(2, 3)).sum()),
            "dither_px": config.dither_px,
            "electrons": config.electrons,
            "background_e": config.background_e,
            "window_px": observed.side,
            "seed": config.seed,
            "exposures": stars.exposures(observed.psf, config.electrons, acquisition.detector),
            "read_noise_e": acquisition.detector.read_noise_e,
        },
        "axes": _axes(detector, observed, errors, maps, telescope),
    }
    result["warnings"] = [*_warnings(result)]
    write_json(made.folder / "astrometry.json", result)
    photons = _photon_noise(observed, config.background_e / config.electrons, acquisition)
    view = _view(result, detector, observed, maps, np.stack([CURVE, photons]))
    (made.folder / "astrometry.png").write_bytes(png(astrometry_figure(view)))
    made.summary = {"warnings": result["warnings"]}


def _photon_noise(observed: Star, share: float, acquisition: Acquisition) -> list[float]:
    """Photon noise (px, mean of both axes) of `CURVE`; ``share``: background over the star."""
    others = (
        stars.star(observed.psf, observed.half, n, share * n, acquisition.detector) for n in CURVE
    )
    return [float(np.sqrt(np.mean(other.bound() ** 2))) for other in others]


def _star(
    telescope: Telescope, config: Config, acquisition: Acquisition, shape: tuple[int, int]
) -> Star:
    """The star to observe, whose window must fit maps of a shape (y, x)."""
    psf, half = telescope.psf(config.window)
    observed = stars.star(psf, half, config.electrons, config.background_e, acquisition.detector)
    if observed.side > min(shape):
        by_itself = "" if config.window else " (the default for --wavelength and --diameter)"
        raise InputError(
            f"--window: {observed.side} px{by_itself} do not fit maps of {shape[1]} × {shape[0]} "
            f"px (x × y); give an odd number up to {min(shape)}"
        )
    return observed


def planned(shape: tuple[int, int], modes: int, side: int, config: Config) -> tuple[int, int]:
    """Bytes of a task and of this process: detector (y, x), stars in windows of ``side`` px."""
    per_pixel = _BYTES_PER_PIXEL + _BYTES_PER_PIXEL_AND_MODE * modes
    reach = min(int(2 * config.dither_px) + 1, max(shape)) + side
    task = max(
        (stars.tile_side(shape)[0] + side) ** 2 * per_pixel,
        reach**2 * per_pixel + config.positions * side**2 * _BYTES_PER_WINDOW_PIXEL,
        BAND * shape[1] * modes * _BYTES_PER_FITTED_MODE,
    )
    # All errors of the stars, and their copies while they are averaged.
    return task, FIGURE_BYTES + 4 * 8 * 12 * config.stars * config.positions


def _axes(
    detector: PixelPositions, observed: Star, errors: F64, maps: ErrorMaps, telescope: Telescope
) -> dict[str, Any]:
    bounds = np.sqrt((detector.axes**2) @ observed.bound() ** 2)
    facts = {}
    for n, component in enumerate(detector.components):
        rng = np.random.default_rng([detector.seed, 3, n])
        facts[component.name] = axis_facts(
            errors[..., n], float(bounds[n]), telescope.uas_per_px, drawn=detector.drawn, rng=rng
        )
        perfect, measured = maps.mean_square[:, n]
        perfect -= 2 * measured if detector.drawn else 0.0
        facts[component.name]["everywhere"] = {
            "perfect_px": float(np.sqrt(perfect)) if perfect > 0 else None,
            "measured_px": float(np.sqrt(measured)) if np.isfinite(measured) else None,
        }
    return facts


def _warnings(result: Mapping[str, Any]) -> Iterator[str]:
    stars = result["stars"]
    lost = stars["number"] * stars["positions"] - stars["positions_used"]
    if lost:
        yield f"{lost} positions are too close to masked pixels and were left out"
    for name, axis in result["axes"].items():
        gain = axis["floor"]["gain"]["value"]
        if axis["floor"]["perfect"]["px"] is None:
            yield (
                f"{name}: the offsets of the pixels are below the errors of the maps, so these "
                "maps do not improve centroids; take more frames"
            )
        elif gain is not None and gain < 1:
            yield (
                f"{name}: the errors of the maps exceed the offsets, so these maps make centroids "
                "worse"
            )
    if "fringe" in result["axes"]:
        yield (
            "offsets are known along one axis only; those along the other axis also move stars, "
            "but are assumed to be zero here"
        )
    if result["detector"]["modes_removed_px"] is None:
        yield (
            "without --truth, the maps are assumed to have random errors of SIGMA and "
            "no systematic errors"
        )


def _view(
    result: dict[str, Any], detector: PixelPositions, observed: Star, maps: ErrorMaps, photons: F64
) -> AstrometryView:
    y, x = centred(detector.shape, DETAIL)
    return AstrometryView(
        result=result,
        target_px=TARGET_PX,
        table=table(result),
        photons=photons,
        weights=stars.core_weights(observed, detector.axes)[0],
        detail=stars.place_errors(detector, observed, y, x)[:, 0],
        detail_at=(y[0], x[0]),
        rms=np.sqrt(np.mean(maps.rms**2, axis=1)),
        block=maps.block,
    )
