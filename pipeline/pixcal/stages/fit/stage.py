"""Offsets from the phases of the sweep: fit shapes, remove modes, combine sets, write products."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pixcal import __version__
from pixcal.engine.run import Runtime
from pixcal.model.config import result_options
from pixcal.model.errors import DamagedError
from pixcal.model.options import Fit as Config
from pixcal.stages.fit import sweep
from pixcal.stages.fit.fringe_set import describe, fit_sets
from pixcal.stages.fit.maps import write_maps
from pixcal.stages.fit.sweep import load_run
from pixcal.storage.artefact import Build
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.formats import STAGES
from pixcal.storage.header_values import date_of
from pixcal.storage.manifest import Manifest, read_json, write_json
from pixcal.storage.products import Card, ascii_text, is_whole, write_map
from pixcal.storage.stage import make, require, working


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Sweep every fringe set of a run if needed, fit it, and write the maps of the offsets."""
    with working(run_dir, "reduce"):
        swept = sweep.run(run_dir, config, runtime)
        body = partial(_fit_all, run_dir, swept, config, runtime)
        return make(
            run_dir,
            STAGES["fit"],
            result_options(config),
            {"sweep": swept.key},
            body,
            publish=lambda: publish(run_dir),
            published=lambda: published(run_dir),
        )


def _fit_all(run_dir: Path, swept: Manifest, config: Config, runtime: Runtime, made: Build) -> None:
    acquisition = load_run(run_dir)
    cubes = run_dir / "reduce" / "reduced.zarr"
    fitted = fit_sets(run_dir / "sweep", cubes, swept.summary["sets"], acquisition, config.model)
    totals = write_maps(made.folder / "fit.zarr", fitted, runtime)
    result = {
        "schema": "pixcal/fit/1",
        "pixcal": __version__,
        "input": require(run_dir, "ingest").key,
        "model": config.model,
        "sets": {f.name: describe(f, *totals.sets[f.name]) for f in fitted},
        "outputs": list(totals.outputs),
        "sets_chi2_reduced": totals.consistency,
    }
    write_json(made.folder / "fit.json", result)
    made.summary = result


# Products


def published(run_dir: Path, stage: str = "fit", facts: str = "fit.json", suffix: str = "") -> bool:
    """Whether a stage's products exist, are unaltered, and belong to its present artefact."""
    products = run_dir / "products"
    try:
        product = read_json(products / facts)
        same = product == read_json(run_dir / stage / facts)
    except DamagedError:
        return False
    return same and all(is_whole(products / f"{name}{suffix}.fits") for name in product["outputs"])


def publish(run_dir: Path) -> None:
    """Write the products of a complete fit."""
    result = read_json(run_dir / "fit" / "fit.json")
    header = header_of(run_dir, result, read_json(run_dir / "fit" / "manifest.json")["key"])
    publish_maps(run_dir, run_dir / "fit" / "fit.zarr", result["outputs"], header)
    write_json(run_dir / "products" / "fit.json", result)


Header = tuple[list[Card], list[str]]  # cards and HISTORY lines


def header_of(run_dir: Path, result: dict[str, Any], key: str) -> Header:
    """Header of the maps of a fit, from its ``fit.json``."""
    models = {facts["model"] for facts in result["sets"].values()}
    cards = [
        *_detector_cards(run_dir),
        ("PIXCALID", key, "key of the fit"),
        ("INDIGEST", result["input"], "digest of the acquisition"),
        ("MODEL", "+".join(sorted(models)), "shape of the fringes, as fitted"),
        ("MODELOPT", result["model"], "requested shape of the fringes"),
        ("NSETS", len(result["sets"]), "fringe sets used"),
    ]
    history = []
    for n, (name, facts) in enumerate(result["sets"].items(), start=1):
        cards += [
            (f"SET{n}", name, "name of the fringe set"),
            (f"MODEL{n}", facts["model"], "shape of the fringes, as fitted"),
            (f"NFRAME{n}", facts["frames"], "frames used"),
            (f"KX{n}", facts["kx"], "[rad/px] fringe vector along x at the centre"),
            (f"KY{n}", facts["ky"], "[rad/px] fringe vector along y at the centre"),
            (f"PSI{n}", facts["phase_at_origin_rad"], "[rad] fringe phase psi at x = y = 0"),
            (f"VIS{n}", facts["visibility"], "visibility, alpha / iota"),
            (f"NMODE{n}", len(facts["removed_modes"]), "modes removed from the set's map"),
        ]
        cards += [
            (f"M{n}_{m}", mode, "removed mode") for m, mode in enumerate(facts["removed_modes"], 1)
        ]
        history.append(f"set {name}: modes removed: {', '.join(facts['removed_modes'])}")
    return cards, history


def _detector_cards(run_dir: Path) -> list[Card]:
    """Cards on the detector, and on when its fringes were recorded (if the frames state it)."""
    detector = load_run(run_dir).detector
    cards: list[Card] = [
        ("DETECTOR", ascii_text(detector.name), "name of the detector"),
        ("PIXSIZE1", detector.pitch_um, "[um] pixel pitch along x"),
        ("PIXSIZE2", detector.pitch_um, "[um] pixel pitch along y"),
    ]
    tables = read_json(run_dir / "ingest" / "frames.json")
    stamps = [
        mjd
        for name, table in tables.items()
        if name.startswith("fringes/")
        for mjd in table.get("mjd", ())
        if mjd is not None
    ]
    if stamps:
        cards += [
            ("DATE-OBS", date_of(min(stamps)), "UTC of the first fringe frame"),
            ("MJD-OBS", min(stamps), "[d] the same as modified Julian date"),
        ]
    return cards


def publish_maps(
    run_dir: Path, group: Path, outputs: Sequence[str], header: Header, suffix: str = ""
) -> None:
    """Write the maps of ``fit.zarr`` or the like as FITS, and remove maps of an earlier fit."""
    for name in outputs:
        delta, sigma, mask = (
            ArrayReader(group / array) for array in (name, f"{name}_sigma", "mask")
        )
        write_map(run_dir / "products" / f"{name}{suffix}.fits", delta, sigma, mask, *header)
    for other in {"delta_x", "delta_y", "delta_fringe"} - set(outputs):
        (run_dir / "products" / f"{other}{suffix}.fits").unlink(missing_ok=True)
