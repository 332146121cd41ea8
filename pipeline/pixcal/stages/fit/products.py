"""The fit's products: what other programs read."""

from pathlib import Path

import numpy as np

from pixcal.model.errors import DamagedError
from pixcal.storage.artefact import read_json, write_json
from pixcal.storage.cube import ArrayReader
from pixcal.storage.products import Card, write_map


def published(run_dir: Path) -> bool:
    """Whether the products are there and are those of the present fit."""
    try:
        product = read_json(run_dir / "products" / "fit.json")
        same = product == read_json(run_dir / "fit" / "fit.json")
    except DamagedError:
        return False
    return same and all(
        (run_dir / "products" / f"{name}.fits").exists() for name in product["outputs"]
    )


def publish(run_dir: Path) -> None:
    """Write the products of a complete fit."""
    folder = run_dir / "fit"
    result = read_json(folder / "fit.json")
    cards: list[Card] = [
        ("PIXCALID", read_json(folder / "manifest.json")["key"], "key of the fit"),
        ("INDIGEST", result["input"], "digest of the acquisition"),
        ("MODEL", result["model"], "shape of the fringes"),
        ("NSETS", len(result["sets"]), "fringe sets used"),
    ]
    history = []
    for n, (name, facts) in enumerate(result["sets"].items(), start=1):
        cards += [
            (f"SET{n}", name, "name of the fringe set"),
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
    mask = ArrayReader(folder / "fit.zarr" / "mask").read()
    for name in result["outputs"]:
        data, sigma = (
            # In the byte order of FITS at once: whole maps are large.
            ArrayReader(folder / "fit.zarr" / array).read(out=np.empty(mask.shape, ">f4"))
            for array in (name, f"{name}_sigma")
        )
        write_map(run_dir / "products" / f"{name}.fits", data, sigma, mask, cards, history)
    for other in {"delta_x", "delta_y", "delta_fringe"} - set(result["outputs"]):
        (run_dir / "products" / f"{other}.fits").unlink(missing_ok=True)
    write_json(run_dir / "products" / "fit.json", result)
