"""Flats without light, of a closed shutter or a lamp that is off, are named and left out."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_cut_frames import LEVELS, frames, ingested

from pixcal.engine.run import Runtime
from pixcal.model.errors import InputError
from pixcal.stages import reduce
from pixcal.stages.reduce.ingested import Ingested


def test_a_flat_without_light_is_as_if_never_recorded(tmp_path: Path) -> None:
    taken, less = frames((41, 53)), frames((41, 53))
    taken["flat"][4] = taken["bias"][3] + 3
    less["flat"] = np.delete(less["flat"], 4, axis=0)
    found = []
    for name, cubes in (("unlit", taken), ("less", less)):
        run, _ = ingested(tmp_path / name, cubes)
        source = Ingested(run / "ingest")
        assert source.arrays["flat"].shape[0] == len(source.tables["flat"]["plane"]) == 8
        np.testing.assert_array_equal(source.arrays["flat"].read(), less["flat"])
        reduce.run(run, reduce.Config(), Runtime(cluster="sync", quiet=True))
        found.append(json.loads((run / "reduce/reduce.json").read_text()))
    unlit, whole = found
    assert unlit["gain_e_per_adu"] == whole["gain_e_per_adu"]
    assert unlit["flags"] == whole["flags"]
    (named,) = [w for w in unlit["warnings"] if "without light are left out (1 of 9)" in w]
    assert "flat.fits" in named
    assert "frames.dark" in named
    assert not [w for w in whole["warnings"] if "without light" in w]


def test_faint_flats_are_lit(tmp_path: Path) -> None:
    taken = frames((41, 53))
    rng = np.random.default_rng(7)
    # Of half the noise of a sample above that without light, it is left out; of twice, it is not.
    for n, level in ((2, 6), (5, 24)):
        taken["flat"][n] = rng.normal(LEVELS["bias"] + level, 12, (41, 53)).round()
    run, _ = ingested(tmp_path / "faint", taken)
    assert Ingested(run / "ingest").tables["flat"]["plane"] == [0, 1, 3, 4, 5, 6, 7, 8]


def test_flats_that_hold_no_light_at_all_are_refused(tmp_path: Path) -> None:
    taken = frames((41, 53))
    taken["flat"] = taken["bias"][::-1].copy()
    run, _ = ingested(tmp_path / "closed", taken)
    assert len(Ingested(run / "ingest").tables["flat"]["plane"]) == 9
    with pytest.raises(InputError, match="the flats hold no light"):
        reduce.run(run, reduce.Config(), Runtime(cluster="sync", quiet=True))


def test_unsigned_flats_written_as_signed_are_refused_by_name(tmp_path: Path) -> None:
    taken = {name: cube.astype(np.int16) for name, cube in frames((41, 53)).items()}
    taken["flat"] = (taken["flat"].astype(np.uint16) + 26000).astype(np.int16)
    run, _ = ingested(tmp_path / "wrapped", taken)
    with pytest.raises(InputError, match=r"flat\.fits: .* as unsigned .*BZERO = 32768"):
        reduce.run(run, reduce.Config(), Runtime(cluster="sync", quiet=True))
