"""Frames that a camera delivers twice are named and left out; frames without noise are not."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_cut_frames import KINDS, frames, ingested

from pixcal.engine.run import Runtime
from pixcal.stages import reduce
from pixcal.stages.reduce.ingested import Ingested

FIRST = {2: 1, 5: 4, 8: 0}  # frame by the number of its repeat


@pytest.mark.parametrize("suffix", [".fits", ".fits.fz"])
def test_repeats_are_as_if_never_recorded(tmp_path: Path, suffix: str) -> None:
    taken = frames((41, 53))
    less = {kind: np.delete(cube, list(FIRST), axis=0) for kind, cube in taken.items()}
    for cube in taken.values():
        for again, first in FIRST.items():
            cube[again] = cube[first]
    found = []
    for name, cubes in (("repeats", taken), ("less", less)):
        run, manifest = ingested(tmp_path / name, cubes, suffix)
        named = [w for w in manifest.summary["warnings"] if "identical to an earlier one" in w]
        assert len(named) == (len(KINDS) if name == "repeats" else 0)
        assert all("(3 of 9)" in sentence for sentence in named)
        source = Ingested(run / "ingest")
        for array, reader in source.arrays.items():
            np.testing.assert_array_equal(reader.read(), less[array.partition("/")[0]])
        reduce.run(run, reduce.Config(), Runtime(cluster="sync", quiet=True))
        found.append(json.loads((run / "reduce/reduce.json").read_text()))
    assert found[0]["gain_e_per_adu"] == found[1]["gain_e_per_adu"]
    assert found[0]["read_noise_e"] == found[1]["read_noise_e"]


@pytest.mark.parametrize("kinds", [1, 4])
def test_frames_without_noise_are_no_repeats(tmp_path: Path, kinds: int) -> None:
    """As of a camera with noise below one code; several exposure levels may be in an array."""
    taken = frames((23, 31))
    for cube in taken.values():
        cube[:] = np.arange(len(cube))[:, None, None] % kinds + 100
        cube[:, 3, 4] = 700
    _, manifest = ingested(tmp_path / "same", taken)
    assert not [w for w in manifest.summary["warnings"] if "repeat" in w]
