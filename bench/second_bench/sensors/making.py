"""Make a sensor of a given kind, and write its frames."""

from pathlib import Path

import numpy as np
import yaml
from astropy.io import fits
from astropy.time import Time, TimeDelta

from second_bench.sensors.model import KINDS, LADDERS, Drawn, Sensor, ordinary

NIGHT = Time("2026-03-01T20:00:00")


def make(
    name: str,
    seed: int,
    shape: tuple[int, int],
    ladder: str | None = None,
    counts: tuple[int, int] = (0, 0),
) -> tuple[Sensor, Drawn]:
    """A sensor with a kind of fault, and the truth about it."""
    own = KINDS[name]
    rng = np.random.default_rng([seed, *name.encode()])
    # If the lamp changes with the exposure time, levels cannot be derived from it.
    ladder = ladder or LADDERS[seed % len(LADDERS)]
    sensor = ordinary(rng, shape, ladder, own.highest, counts, own.converter)
    drawn = own.change(sensor) or {}
    sensor.declared_gain /= 2**sensor.shift
    good = ~sensor.defects
    truth = {
        "kind": name,
        "seed": seed,
        "ladder": ladder,
        "bits": sensor.bits,
        "drawn": drawn,
        "causes": _causes(own.cause),
        "gain": sensor.gain / 2**sensor.shift,
        "declared_gain": sensor.declared_gain,
        "read_noise_e": float(
            np.sqrt(np.mean(sensor.read_noise_e[good] ** 2) + sensor.shared_e**2)
        ),
        "bias_adu": float(np.median(sensor.bias_adu)),
        "well_e": sensor.well_e,
        "top_e": sensor.top_e,
        "defects": np.flatnonzero(sensor.defects).tolist(),
        "unclear": np.flatnonzero(sensor.unclear).tolist(),
    }
    return sensor, truth


def _causes(cause: str) -> list[list[str]] | None:
    """Alternatives of each cause to name; None if the change is not a listed effect."""
    if cause == "?":
        return None
    return [one.split() for one in cause.split("+")] if cause else []


def write(sensor: Sensor, out: Path) -> None:
    """Write frames and ``acquisition.yaml`` into a new folder."""
    seconds = 0.0
    for number, (one, cube) in enumerate(sensor.frames()):
        folder = out / one.kind
        folder.mkdir(parents=True, exist_ok=True)
        header = fits.Header()
        header["DATE-OBS"] = (NIGHT + TimeDelta(seconds, format="sec")).isot
        header["EXPTIME"] = one.exptime_s
        fits.PrimaryHDU(cube, header).writeto(folder / f"{one.kind}_{number:03d}.fits")
        seconds += one.frames * (one.exptime_s + 1.0)
    described = {
        "schema": "pixcal/acquisition/1",
        "detector": {
            "name": "simulated camera",
            "pitch_um": 5.0,
            "gain_e_per_adu": float(f"{sensor.declared_gain:.6g}"),
            "read_noise_e": float(f"{np.median(sensor.read_noise_e):.3g}"),
        },
        "frames": {one.kind: [f"{one.kind}/*.fits"] for one in sensor.series},
    }
    (out / "acquisition.yaml").write_text(yaml.safe_dump(described, sort_keys=False))
