"""Frames of real numbers may lack samples (NaN): their pixels are measured on the other frames."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_cut_frames import frames, ingested

from pixcal.engine.run import Runtime
from pixcal.stages import reduce
from pixcal.storage.cube import ArrayReader


@pytest.mark.parametrize("kind", ["bias", "flat"])
@pytest.mark.parametrize("which", [0, 1, -1])
@pytest.mark.parametrize("where", [(slice(5, 30), slice(3, 40)), (slice(None), slice(None))])
def test_a_frame_that_lacks_samples_costs_no_more_than_these(
    tmp_path: Path, kind: str, which: int, where: tuple[slice, slice]
) -> None:
    taken = {name: cube.astype(np.float32) for name, cube in frames((41, 53)).items()}
    found = {}
    for name in ("whole", "lacking"):
        run, _ = ingested(tmp_path / name, taken)
        reduce.run(run, reduce.Config(), Runtime(cluster="sync", quiet=True))
        gain = json.loads((run / "reduce/reduce.json").read_text())["gain_e_per_adu"]
        level = ArrayReader(run / "reduce/calibration.zarr/bias").read()
        found[name] = gain["used"], level
        taken[kind][which][where] = np.nan
    (gain, bias), (other, level) = found["whole"], found["lacking"]
    assert other == pytest.approx(gain, rel=0.1)
    assert np.isfinite(level).all()
    np.testing.assert_allclose(level, bias, atol=40)
