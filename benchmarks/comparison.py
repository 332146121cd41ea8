"""``pixcal fit`` and its alternatives on the same data: ``make bench``.

One fringe set is simulated in three ways: ideal, with realistic laser and pixels, and with moving
fringes. Each is ingested and reduced once; each method then fits the same reduced cube, warm, in a
separate process. The errors are those of the phases against the simulated truth, over the
Cramér-Rao bound for the same frames. The alternatives assume straight fringes: above some 400
pixels (``--size``), the curvature adds to their errors.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from comparators.measure import METHODS, PIXCAL, Task, cost_apart
from pixcal.engine.run import Runtime
from pixcal.model.acquisition import load_acquisition
from pixcal.model.bench import load_bench
from pixcal.stages.fitted_shape import nominal_vector
from pixcal.storage.products import read_map
from reproduction.lab import Scene
from truth import PLANE, Truth

ROOT = Path(__file__).parents[1]
NAME = "vertical"
MOVING = {"contrast_noise": {"vibration_rad": 0.0, "polarisation": 0.03, "polarisation_s": 0.0}}
TILT_RAD = 0.01  # rms, edge to edge, along each axis
SCENARIOS: dict[str, tuple[dict[str, float], dict[str, float], dict[str, Any]]] = {
    "steady laser, even light, equal pixels": (
        {"prnu_rms": 0.0},
        {"beam_radius_mm": 1e5},
        {"intensity_noise": {"rms": 0.0}},
    ),
    "laser noise 2 %, pixels unequal by 1 %": ({}, {}, {}),
    "the same, visibility changing by 3 %, fringes tilting by 1e-2 rad across": ({}, {}, MOVING),
}
"""What each changes in the bench: detector, optics, effects."""

NOTES = """\
time: from the reduced cube on disk, warm, to the phases of all pixels; the fastest of {repeat} goes
  after a first one, which loads compiled code (pixcal's took {first:.1f} s). read: of it, until the
  frames are float64 in memory; pixcal decodes as it goes. GB/s: of 16-bit samples. Part of pixcal's
  time, that of its scout, does not grow with the window.
  curve_fit was run on {pixels} pixels, on one core, and that time is scaled to all pixels.
memory: at most, above the {imports:.0f} MiB of an interpreter with all imports. The others hold the
  cube and more, {others:.1f} bytes a sample: at 8320 x 5456 pixels x 10,000 frames {tera:.1f} TB.
error: rms over the bound, less the seven modes that such data leave open; good to {chance:.1%}
  ({chance_pixels:.1%} for curve_fit). as given: less piston and slopes only, so that fringes in the
  map count as errors (pixcal's own map lacks four fringe modes of the true one)."""


def bench(folder: Path, scenario: str, size: int, frames: int) -> Path:
    """Bench file of a scenario on a square window."""
    config = yaml.safe_load((ROOT / "configs" / "precision.yaml").read_text())
    detector, optics, effects = SCENARIOS[scenario]
    config["detector"] |= {"shape": [size, size], **detector}
    config["optics"] |= {"visibility": 0.95, **optics}
    config["frames"]["fringes"][0]["count"] = frames
    config["effects"] |= effects
    if effects is MOVING:
        config["effects"]["fringe_jitter"] = {"rms": [TILT_RAD / size] * 2}
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def measure(
    method: str, folder: Path, truth: Truth, options: argparse.Namespace
) -> dict[str, float]:
    """Time and memory of a method, in a separate process, and its error."""
    described, run = load_acquisition(folder / "acq"), folder / "run"
    vector, noise = nominal_vector(described, NAME), described.detector.read_noise_e
    cost, phase = cost_apart(method, Task(run, NAME, vector, noise, options.pixels), options.repeat)
    if phase is not None:
        offsets = truth.offsets(phase)
    else:
        offsets = read_map(run / "products" / "delta_fringe.fits")[0].astype(float)
    return cost | {
        "pixels": int(np.isfinite(offsets).sum()),
        "error_over_bound": truth.error(offsets) / truth.bound,
        "error_as_given_over_bound": truth.error(offsets, PLANE) / truth.bound,
    }


def compare(scenario: str, options: argparse.Namespace) -> dict[str, Any]:
    """All methods on one scenario: the bound in px, and the cost and error of each."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        source = load_bench(bench(folder, scenario, options.size, options.frames))
        scene = Scene.simulate(folder, source, Runtime())
        scene.reduced()
        truth = scene.truth(NAME)
        rows = {method: measure(method, folder, truth, options) for method in METHODS}
    return {"bound_px": truth.bound, "methods": rows}


def table(found: dict[str, Any], samples: int) -> str:
    """The methods of a scenario as lines of text."""
    rows = found["methods"]
    reference = rows[PIXCAL]["seconds"]
    lines = [
        f"{'':31}{'time':>9}{'read':>8}{'times':>9}{'':>8}{'memory':>9}{'error':>8}{'as':>8}",
        f"{'':31}{'s':>9}{'s':>8}{'pixcal':>9}{'GB/s':>8}{'MiB':>9}{'/bound':>8}{'given':>8}",
    ]
    for method, row in rows.items():
        seconds = row["seconds"]
        lines.append(
            f"{method:31}{seconds:9.2f}{row['reading_seconds']:8.2f}{seconds / reference:9.2f}"
            f"{2e-9 * samples / seconds:8.3f}{row['memory_bytes'] / 2**20:9.0f}"
            f"{row['error_over_bound']:8.3f}{row['error_as_given_over_bound']:8.2f}"
        )
    return "\n".join(lines)


def notes(results: dict[str, Any], samples: int, repeat: int) -> str:
    """Meaning of the columns, and numbers derived from them."""
    rows = [found["methods"] for found in results.values()]
    each = min(r["memory_bytes"] for m in rows for name, r in m.items() if name != PIXCAL) / samples
    fewest = min(r["pixels"] for m in rows for r in m.values())
    return NOTES.format(
        repeat=repeat,
        first=max(m[PIXCAL]["first_seconds"] for m in rows),
        pixels=fewest,
        imports=max(r["imports_bytes"] for m in rows for r in m.values()) / 2**20,
        others=each,
        tera=each * 8320 * 5456 * 10_000 * 1e-12,
        chance=rows[0][PIXCAL]["pixels"] ** -0.5 * 0.5**0.5,
        chance_pixels=fewest**-0.5 * 0.5**0.5,
    )


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=256, help="pixels along each side")
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--pixels", type=int, default=500, help="pixels that curve_fit is run on")
    parser.add_argument("--repeat", type=int, default=2, help="goes, of which the fastest counts")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args()
    samples = options.size**2 * options.frames
    print(
        f"pixcal fit and others, {options.size} x {options.size} pixels x {options.frames} frames"
    )
    results = {}
    for scenario in SCENARIOS:
        results[scenario] = compare(scenario, options)
        print(f"\n{scenario}; bound {results[scenario]['bound_px']:.3e} px")
        print(table(results[scenario], samples), flush=True)
    print(f"\n{notes(results, samples, options.repeat)}")
    if options.json:
        options.json.write_text(json.dumps({"samples": samples, "scenarios": results}, indent=1))


if __name__ == "__main__":
    main()
