"""Error of the offsets against the truth of a simulated bench: ``python benchmarks/precision.py``.

Simulates a configuration frame by frame, takes it through the whole pipeline, and compares the maps
with the truth after removal of the degenerate modes from both.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from pixcal.engine.run import Runtime
from pixcal.model.bench import load_bench
from reproduction.lab import Scene, facts, read_set

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", nargs="?", default=ROOT / "configs" / "precision.yaml", type=Path)
    config = parser.parse_args().config
    with tempfile.TemporaryDirectory() as scratch:
        begin = time.monotonic()
        scene = Scene.simulate(Path(scratch), load_bench(config), Runtime(quiet=False))
        run = scene.fit()
        print(f"{config}: {time.monotonic() - begin:.0f} s")
        for name in (scan.name for scan in scene.bench.frames.fringes):
            told = facts(run, name)
            delta, sigma = read_set(run, name, "delta", "sigma")
            errors = scene.truth(name).errors(delta)
            rms, bound = float(np.nanstd(errors)), told["crb_median_px"]
            print(
                f"{name}: {told['frames']} frames, {told['interfringe_px']:.3f} px interfringe, "
                f"{told['model']}: rms error {rms:.3e} px, Cramér-Rao bound {bound:.3e} px, "
                f"ratio {rms / bound:.3f}, error / SIGMA {float(np.nanstd(errors / sigma)):.3f}"
            )


if __name__ == "__main__":
    main()
