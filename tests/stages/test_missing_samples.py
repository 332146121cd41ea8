"""Frames of real numbers may lack samples (NaN): these pixels are measured on other frames.

Of flats, on other levels: a pixel that is missing in one flat of the only level has no response.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from test_cut_frames import LEVELS, frames, ingested

from pixcal.engine.run import Runtime
from pixcal.model.flags import PixelFlag
from pixcal.stages import reduce
from pixcal.stages.ingest import stage as ingest
from pixcal.storage.cube_reader import ArrayReader


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
        flags = json.loads((run / "reduce/reduce.json").read_text())["flags"]
        maps = [ArrayReader(run / f"reduce/calibration.zarr/{m}").read() for m in ("bias", "flat")]
        found[name] = flags, maps, ArrayReader(run / "reduce/calibration.zarr/mask").read()
        taken[kind][which][where] = np.nan
    (flags, maps, _), (fewer, changed, mask) = found["whole"], found["lacking"]
    # A flat without any sample is left out, like one without light.
    lost = 25 * 37 if kind == "flat" and where[0].start else 0
    assert fewer["no_data"] == lost
    assert abs(fewer["good"] + lost - flags["good"]) < 0.01 * 41 * 53
    # The mean of nine frames with noise of 12 ADU moves by 12 / sqrt(72) ADU without one of them,
    # and by a ninth of 5 sigma if another sample is clipped.
    most = 6 * 12 / 72**0.5 + 5 * 12 / 9
    light = LEVELS["flat"] - LEVELS["bias"]
    for before, after, unit in zip(maps, changed, (1.0, light), strict=True):
        np.testing.assert_allclose(after[mask == 0], before[mask == 0], rtol=0, atol=most / unit)


def test_missing_samples_of_a_flat_are_told_from_saturated_ones(tmp_path: Path) -> None:
    taken = {name: cube.astype(np.float32) for name, cube in frames((41, 53)).items()}
    taken["flat"][3, 5:9, 7:11] = np.nan
    taken["flat"][4, 20:24, 30:36] = 9500
    run, _ = ingested(tmp_path / "both", taken)
    declared = "read_noise_e: 16.0"
    description = run.parent / "both" / "acquisition.yaml"
    limited = description.read_text().replace(declared, f"{declared}, saturation_adu: 9400")
    description.write_text(limited)
    ingest.run(run.parent / "both", run, ingest.Config(), Runtime(cluster="sync", quiet=True))
    reduce.run(run, reduce.Config(), Runtime(cluster="sync", quiet=True))
    mask = ArrayReader(run / "reduce/calibration.zarr/mask").read()
    assert (mask[5:9, 7:11] == PixelFlag.NO_DATA).all()
    assert (mask[20:24, 30:36] == PixelFlag.SATURATED).all()
    assert np.count_nonzero(mask & (PixelFlag.NO_DATA | PixelFlag.SATURATED)) == 16 + 24
