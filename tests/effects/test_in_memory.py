"""Frames in memory: reduced and fitted without a file, with what the stages find in files."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from on_disk import evidence_on_disk

from pixcal.engine.run import Runtime
from pixcal.model.bench import Bench
from pixcal.model.config import to_plain
from pixcal.model.options import Sweep
from pixcal.stages import ingest, reduce, simulate
from pixcal.stages.diagnose.parts import NO_BATCHES, RawFrames, RunFrames, run_in_memory, take
from pixcal.stages.diagnose.parts import evidence_of as evidence_of_part
from pixcal.stages.diagnose.windows import whole_of
from pixcal.stages.evidence import evidence_of
from pixcal.stages.reduce.black_cut_off import Black, CutOff
from pixcal.stages.reduce.ingested import Ingested
from pixcal.storage.stage import read_acquisition

SYNC = Runtime(cluster="sync")

ROUNDING_RAD = float(np.spacing(np.float32(np.pi)))
"""Phases are float32: with batches and without they are summed in another order."""
ROUNDED = ("delta", "sigma", "free", "theta", "k", "free_covariance")
"""What follows from phases."""


@pytest.fixture(scope="module")
def raw(
    tmp_path_factory: pytest.TempPathFactory, make_effect_bench: Callable[..., Bench]
) -> RawFrames:
    """Frames of a window of more than one chunk that is no multiple of any."""
    changes = {"frames.fringes.0.count": 71, "frames.fringes.1.count": 67}
    bench = make_effect_bench(changes | {"detector.shape": [133, 61]})
    folder = tmp_path_factory.mktemp("frames")
    (folder / "bench.yaml").write_text(yaml.safe_dump(to_plain(bench)))
    simulate.run(folder / "bench.yaml", folder / "acq", simulate.Config(), SYNC)
    run = folder / "run"
    ingest.run(folder / "acq", run, ingest.Config(), SYNC)
    ingested = Ingested(run / "ingest")
    half = {name: np.arange(3, a.shape[0]) for name, a in ingested.arrays.items()}
    part = whole_of(ingested.shape)
    dtypes = {name: array.dtype for name, array in ingested.arrays.items()}
    frames = RunFrames(read_acquisition(run), ingested.tables, dtypes, reduce.Config())
    return take(ingested, frames, half, part)


@pytest.mark.quick(1)
@pytest.mark.parametrize("sweep", [Sweep(), NO_BATCHES], ids=["with batches", "without"])
def test_frames_in_memory_are_reduced_and_fitted_as_those_in_files(
    raw: RawFrames, sweep: Sweep, tmp_path: Path
) -> None:
    expected = evidence_on_disk(raw, tmp_path)
    run = run_in_memory(raw, sweep)
    found = evidence_of(run)
    for name in ("bias", "dark_rate", "flat", "good"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    for name in ("gain", "read_noise", "amplifier_noise", "neighbours", "saturation_adu"):
        assert getattr(found, name) == getattr(expected, name)
    for own, other in zip(found.stacks, expected.stacks, strict=True):
        np.testing.assert_array_equal(own.adu, other.adu)
    assert len(found.fringes) == 2
    for name, own_set in found.fringes.items():
        other_set = expected.fringes[name]
        for field in (f.name for f in fields(own_set)):
            one, other = getattr(own_set, field), getattr(other_set, field)
            if sweep == NO_BATCHES and field in ROUNDED:
                scale = np.hypot(*own_set.k) if field == "delta" else 1.0
                if field in ("delta", "sigma", "free"):
                    np.testing.assert_allclose(one, other, rtol=0, atol=ROUNDING_RAD / scale)
            else:
                np.testing.assert_array_equal(one, other, err_msg=field)


def test_halves_that_come_with_an_evidence_are_those_of_its_samples(raw: RawFrames) -> None:
    run = run_in_memory(raw)
    for one in evidence_of(run, within=((7, 5), (150, 80))).fringes.values():
        assert (one.origin, one.window) == ((7, 5), (150, 80))
        # Samples that are cut are no longer those the halves came from.
        anew = replace(one).halves
        assert anew is not one.halves
        for own, other in zip(one.halves, anew, strict=True):
            for value, expected in zip(own, other, strict=True):
                np.testing.assert_allclose(value, expected, rtol=1e-4, atol=1e-7)


def test_nothing_is_written(
    raw: RawFrames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor are the frames copied: those that are read are those that were given."""
    monkeypatch.chdir(tmp_path)
    run = run_in_memory(raw)
    assert list(tmp_path.iterdir()) == []
    assert (run / "ingest" / "raw.zarr" / "bias").array.values is raw.arrays["bias"]


def test_a_part_is_reduced_with_the_black_of_the_whole_run(raw: RawFrames) -> None:
    """Few frames tell a cut-off, or noise of darks that is off the curve, less surely."""
    whole = Black({"bias": CutOff(3.0, 0.01, 2.0)}, without_dark=True)
    _, ny, nx = raw.arrays["bias"].shape
    part = (0, ny), (0, nx)
    found = evidence_of_part(replace(raw, black=whole), part, (ny, nx))
    assert (found.lowest_adu, found.without_dark) == (3.0, True)
    own = evidence_of_part(raw, part, (ny, nx))
    assert (own.lowest_adu, own.without_dark) == (None, False)
