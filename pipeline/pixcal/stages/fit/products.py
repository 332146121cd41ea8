"""The fit's products: what other programs read."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pixcal.model.errors import DamagedError
from pixcal.stages.fit.sweep import load_run
from pixcal.storage.cube import ArrayReader
from pixcal.storage.fits_facts import date_of
from pixcal.storage.manifest import read_json, write_json
from pixcal.storage.products import Card, is_whole, write_map


def published(run_dir: Path, stage: str = "fit", facts: str = "fit.json", suffix: str = "") -> bool:
    """Whether a stage's products are there, unaltered, and are those of its present artefact."""
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
    key = read_json(run_dir / "fit" / "manifest.json")["key"]
    cards, history = header_of(run_dir, result, key)
    publish_maps(run_dir, run_dir / "fit" / "fit.zarr", result["outputs"], cards, history)
    write_json(run_dir / "products" / "fit.json", result)


def header_of(run_dir: Path, result: dict[str, Any], key: str) -> tuple[list[Card], list[str]]:
    """Cards and HISTORY lines of the maps of a fit, from its ``fit.json``."""
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
    """Which detector it is, and when its fringes were recorded (where the frames say)."""
    detector = load_run(run_dir).detector
    cards: list[Card] = [
        ("DETECTOR", detector.name, "name of the detector"),
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
    run_dir: Path,
    group: Path,
    outputs: Sequence[str],
    cards: list[Card],
    history: list[str],
    suffix: str = "",
) -> None:
    """Write the maps of ``fit.zarr`` or the like as FITS, and remove those of another fit."""
    for name in outputs:
        delta, sigma, mask = (
            ArrayReader(group / array) for array in (name, f"{name}_sigma", "mask")
        )
        product = run_dir / "products" / f"{name}{suffix}.fits"
        write_map(product, delta, sigma, mask, cards, history)
    for other in {"delta_x", "delta_y", "delta_fringe"} - set(outputs):
        (run_dir / "products" / f"{other}{suffix}.fits").unlink(missing_ok=True)
