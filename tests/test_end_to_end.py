"""Acquisitions that another program wrote, taken from FITS frames to offset maps."""

import json

import numpy as np
import pytest

from pixcal.engine.run import Runtime
from pixcal.stages import allan, fit, ingest, reduce
from pixcal.storage.products import read_map

PRODUCTS = {"vertical": "delta_x", "horizontal": "delta_y"}


def calibrate(bench, folder):
    bench.write(folder / "acq")
    run = folder / "run"
    runtime = Runtime()
    ingest.run(folder / "acq", run, ingest.Config(), runtime)
    reduce.run(run, reduce.Config(), runtime)
    fit.run(run, fit.Config(), runtime)
    allan.run(run, allan.Config(), runtime)
    return run


@pytest.mark.parametrize(
    ("interfringe", "seed", "options"),
    [
        (5.0, 1, {}),
        (9.0, 2, {}),
        (5.0, 3, {"gain": 0.8, "response": 0.01, "laser_noise": 0.02, "visibility_noise": 0.03}),
    ],
)
def test_offsets_are_at_the_bound_and_their_errors_honest(
    make_bench, tmp_path, interfringe, seed, options
):
    """128 x 128 pixels, two sets; the error less the modes that no data can tell from the bench."""
    bench = make_bench(
        shape=(128, 128), frames=300, interfringe=interfringe, seed=seed, level=20_000.0, **options
    )
    run = calibrate(bench, tmp_path)
    result = json.loads((run / "products" / "allan.json").read_text())
    for name, product in PRODUCTS.items():
        data, sigma, mask, _ = read_map(run / "products" / f"{product}.fits")
        truth = bench.delta_x if name == "vertical" else bench.delta_y
        error = bench.without_modes(data - truth, name)
        assert np.nanstd(error) / bench.bound(name) < 1.03
        assert 0.96 < np.nanstd(error / sigma) < 1.04
        assert (mask > 0).mean() < 1e-3
        slope = result["sets"][name]
        assert abs(slope["slope"] + 0.5) < 4 * slope["slope_err"]
        assert slope["knee_frames"] is None
