"""An acquisition and its truth on disk."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy.io import fits
from astropy.time import Time, TimeDelta
from numpy.typing import NDArray

from second_bench.model import MARGIN, TOP_ADU, WARM_UP, Bench, Run

NIGHT = Time("2026-03-01T20:00:00")
PER_FILE = 200
WINDOW = (..., slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))


def write_acquisition(
    bench: Bench, recorded: Iterable[tuple[Run, NDArray[np.uint16]]], out: Path
) -> None:
    """Write frames without their margin, and ``acquisition.yaml``, into a new folder."""
    out.mkdir(parents=True)
    for run, frames in recorded:
        (out / run.name).mkdir()
        for first in range(0, len(frames), PER_FILE):
            # Frames of darks and flats take longer by their exposure.
            longer = run.exptime_s if run.kind in ("dark", "flat") else 0.0
            seconds = run.start_s + (first + WARM_UP) * (bench.period_s + longer)
            header = fits.Header()
            if bench.stamped:
                header["DATE-OBS"] = (NIGHT + TimeDelta(seconds, format="sec")).isot
            if bench.stamped or run.kind == "dark":
                header["EXPTIME"] = run.exptime_s
            cube = np.ascontiguousarray(frames[first : first + PER_FILE][WINDOW])
            fits.PrimaryHDU(cube, header).writeto(out / run.name / f"{run.name}_{first:05d}.fits")
    (out / "acquisition.yaml").write_text(yaml.safe_dump(_described(bench), sort_keys=False))


def _described(bench: Bench) -> dict[str, Any]:
    kinds = {run.kind for run in bench.runs}
    return {
        "schema": "pixcal/acquisition/1",
        "detector": {
            "name": "second bench",
            "pitch_um": bench.pitch_um,
            "gain_e_per_adu": float(f"{bench.declared_gain:.5g}"),
            "read_noise_e": float(f"{np.median(bench.read_noise_e):.3g}"),
            "full_well_e": float(f"{bench.full_well_e:.3g}"),
            "saturation_adu": TOP_ADU,
        },
        "optics": {
            "wavelength_nm": bench.wavelength_nm,
            "distance_mm": bench.distance_mm,
            "frame_period_s": bench.period_s,
        },
        "frames": {
            **{kind: [f"{kind}/*.fits"] for kind in ("bias", "dark", "flat") if kind in kinds},
            "fringes": [
                {"name": s.name, "files": [f"{s.name}/*.fits"], "baseline_mm": list(s.declared_mm)}
                for s in bench.sets
            ],
        },
    }


def write_truth(file: Path, truth: dict[str, Any], bench: Bench) -> None:
    """Write the truth, including the offsets (px) of all written pixels."""
    maps = {
        name: [[round(float(v), 7) for v in row] for row in values[WINDOW]]
        for name, values in (("delta_x", bench.delta_x), ("delta_y", bench.delta_y))
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(truth | {"ordinary": bench.notes} | maps))
