"""Error of the offsets against the truth of a simulated bench: ``python benchmarks/precision.py``.

Simulates a configuration frame by frame, takes it through the whole pipeline, and holds the maps
against the truth, the modes that no data can tell from the bench removed from both.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.io import fits

from pixcal.engine.run import Runtime
from pixcal.stages import fit, ingest, reduce, simulate
from pixcal.storage.products import read_map
from reproduction.maps import harmonics, plane, without

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", nargs="?", default=ROOT / "configs" / "precision.yaml", type=Path)
    config = parser.parse_args().config
    runtime = Runtime(quiet=False)
    with tempfile.TemporaryDirectory() as scratch:
        acq, run = Path(scratch) / "acq", Path(scratch) / "run"
        begin = time.monotonic()
        simulate.run(config, acq, simulate.Config(), runtime)
        ingest.run(acq, run, ingest.Config(), runtime)
        reduce.run(run, reduce.Config(), runtime)
        fit.run(run, fit.Config(), runtime)
        took = time.monotonic() - begin
        result = json.loads((run / "products" / "fit.json").read_text())
        truth = {
            name: np.asarray(fits.getdata(Path(scratch) / "acq-truth" / f"{name}.fits"), float)
            for name in ("delta_x", "delta_y")
        }
        print(f"{config}: {took:.0f} s")
        for name, facts in result["sets"].items():
            product = (
                "delta_fringe"
                if len(result["sets"]) == 1
                else "delta_x"
                if abs(facts["axis"][0]) > 0.7
                else "delta_y"
            )
            data, sigma, _, _ = read_map(run / "products" / f"{product}.fits")
            along = facts["axis"][0] * truth["delta_x"] + facts["axis"][1] * truth["delta_y"]
            lost = [plane(along.shape), harmonics(along.shape, (facts["kx"], facts["ky"]))]
            error = without(data - along, np.concatenate(lost))
            rms = float(np.nanstd(error))
            bound = facts["crb_median_px"]
            print(
                f"{name}: {facts['frames']} frames, {facts['interfringe_px']:.3f} px interfringe, "
                f"{facts['model']}: rms error {rms:.3e} px, Cramér-Rao bound {bound:.3e} px, "
                f"ratio {rms / bound:.3f}, error / SIGMA {float(np.nanstd(error / sigma)):.3f}"
            )


if __name__ == "__main__":
    main()
