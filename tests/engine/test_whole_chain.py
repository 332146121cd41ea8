"""All stages, wherever their tasks run: the same bits, also when something dies half-way."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from astropy.io import fits

from pixcal.engine.run import Runtime
from pixcal.stages import allan, crests, fit, ingest, reduce, simulate
from pixcal.stages.tiles import STRIP

HOW_IT_RAN = {"chunks_read", "passes"}
"""What differs with the runtime: other processes do not share what the scout keeps in memory."""
OF_A_MANIFEST = {"files", "seal", "acquisition"}
"""Digests of files that hold such counts, and where the FITS files are from there."""


Chain = Callable[[Runtime], Path]


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    """Simulate a bench on a window of four uneven tiles and take it through all stages."""
    config = yaml.safe_load((Path(__file__).parents[1] / "bench.yaml").read_text())
    config["detector"]["shape"] = [137, 150]
    folders: list[Path] = []

    def run(runtime: Runtime) -> Path:
        folders.append(tmp_path_factory.mktemp("chain"))
        (folders[-1] / "bench.yaml").write_text(yaml.safe_dump(config))
        here = Path.cwd()
        os.chdir(folders[-1])
        try:
            # Relative, as users write them. The acquisition of the first: keys hold times of files.
            simulate.run(Path("bench.yaml"), Path("acq"), simulate.Config(), runtime)
            first, out = Path(os.path.relpath(folders[0] / "acq")), Path("run")
            ingest.run(first, out, ingest.Config(), runtime)
            reduce.run(out, reduce.Config(), runtime)
            fit.run(out, fit.Config(), runtime)
            allan.run(out, allan.Config(), runtime)
            crests.run(out, crests.Config(paths=4), runtime)
        finally:
            os.chdir(here)
        return folders[-1]

    return run


def without(data: Any, keys: set[str]) -> Any:
    if isinstance(data, dict):
        return {k: without(v, keys) for k, v in data.items() if k not in keys}
    return [without(v, keys) for v in data] if isinstance(data, list) else data


def contents(folder: Path) -> Iterator[tuple[str, Any]]:
    """Every file with what it says, but for times of writing and counts of readings."""
    for file in sorted(f for f in folder.rglob("*") if f.is_file()):
        name = str(file.relative_to(folder))
        if "/tiles/" in name:
            continue
        if file.suffix == ".json" and "zarr.json" not in name:
            own = OF_A_MANIFEST if file.name == "manifest.json" else set()
            yield name, without(json.loads(file.read_text()), HOW_IT_RAN | own)
        elif file.suffix == ".fits":
            with fits.open(file) as hdus:
                yield name, [None if hdu.data is None else hdu.data.tobytes() for hdu in hdus]
        else:
            yield name, file.read_bytes()


def assert_same(one: Path, other: Path) -> None:
    a, b = dict(contents(one)), dict(contents(other))
    assert a.keys() == b.keys()
    assert [name for name in a if a[name] != b[name]] == []


@pytest.fixture(scope="module")
def expected(chain: Chain) -> Path:
    return chain(Runtime("sync"))


@pytest.mark.long
@pytest.mark.parametrize("place", ["threads", "processes", "cluster"])
def test_the_same_bits_wherever_it_runs(
    chain: Chain, expected: Path, place: str, request: Any
) -> None:
    if place == "cluster":
        runtime = request.getfixturevalue("cluster").runtime
    else:
        runtime = Runtime(place, workers=3 if place == "threads" else 2)
    found = chain(runtime)
    assert len(list((found / "run" / "products").iterdir())) >= 5
    for part in ("acq", "run"):
        assert_same(expected / part, found / part)


# Deaths in the middle of a fit


@pytest.fixture(scope="module")
def reduced(make_bench: Any, write_reduced: Any, tmp_path_factory: Any) -> Path:
    """A reduced run of 20 tiles."""
    bench = make_bench(shape=(4 * 128 - 9, 5 * 128 - 60), frames=40, sets={"vertical": (6.0, 0.0)})
    run: Path = write_reduced(bench, tmp_path_factory.mktemp("reduced") / "run")
    return run


@pytest.fixture(scope="module")
def fitted(reduced: Path) -> Path:
    return fitted_copy(reduced, "fitted", Runtime("sync"))


def copy_of(reduced: Path, name: str) -> Path:
    run = reduced.with_name(name)
    for part in ("ingest", "reduce"):
        shutil.copytree(reduced / part, run / part)
    return run


def fitted_copy(reduced: Path, name: str, runtime: Runtime) -> Path:
    run = copy_of(reduced, name)
    fit.run(run, fit.Config(model="paraxial"), runtime)
    return run


def tiles_noted(run: Path) -> list[str]:
    """Row and column of the strips of tiles that are noted as done in the sweep, ``row,column``."""
    lines = [
        json.loads(line)["done"]
        for journal in run.glob(".partial/sweep-*/journal.jsonl")
        for line in journal.read_text().splitlines()
        if line.endswith("}")
    ]
    first = [re.findall(r"\d+", line.partition(":")[2]) for line in lines if "," in line]
    return [f"{row},{int(column) // STRIP}" for row, column in first]


def written(run: Path) -> dict[str, int]:
    """When the phases of each strip were written."""
    found = {}
    for file in run.glob("**/sweep.zarr/vertical/phase/c/*/*"):
        found[f"{file.parent.name},{file.name}"] = file.stat().st_mtime_ns
    return found


def wait_for_tiles(run: Path, number: int) -> None:
    deadline = time.monotonic() + 60
    while len(tiles_noted(run)) < number:
        assert time.monotonic() < deadline
        time.sleep(0.002)


@pytest.mark.long
def test_a_killed_worker_costs_its_tiles_and_no_others(
    cluster: Any, reduced: Path, fitted: Path
) -> None:
    run = copy_of(reduced, "killed")
    victim = cluster.pids()[0]
    facts: dict[str, Any] = {}

    def kill() -> None:
        wait_for_tiles(run, 3)
        os.kill(victim, signal.SIGKILL)
        facts.update(noted=tiles_noted(run), written=written(run))

    killer = threading.Thread(target=kill)
    killer.start()
    fit.run(run, fit.Config(model="paraxial"), cluster.runtime)
    killer.join()
    assert victim not in cluster.pids()
    assert 3 <= len(facts["noted"]) < 8, "in the middle of it"
    ended = written(run)
    assert len(ended) == 8, "4 rows of 5 tiles, in strips of up to 4"
    assert {tile: ended[tile] for tile in facts["noted"]} == {
        tile: facts["written"][tile] for tile in facts["noted"]
    }
    assert_same(fitted / "products", run / "products")


@pytest.mark.long
def test_a_lost_scheduler_ends_in_one_line_and_the_fit_is_resumed(
    another_cluster: Any, reduced: Path, fitted: Path
) -> None:
    run, cluster = copy_of(reduced, "lost"), another_cluster
    command = [sys.executable, "-c", "from pixcal_cli.main import main; main()", "fit", str(run)]
    command += ["--model", "paraxial", "--quiet", "--cluster", cluster.address]
    with subprocess.Popen(command, stdout=-1, stderr=-1, text=True) as process:
        wait_for_tiles(run, 2)
        cluster.scheduler.kill()
        out, err = process.communicate(timeout=60)
    cluster.stop()
    noted, before = tiles_noted(run), written(run)
    assert process.returncode == 1
    assert err == (
        f"pixcal: --cluster {cluster.address}: the connection to the scheduler was lost; "
        "run the same command again to resume\n"
    )
    assert out == ""
    fit.run(run, fit.Config(model="paraxial"), Runtime("sync"))
    ended = written(run)
    assert {tile: ended[tile] for tile in noted} == {tile: before[tile] for tile in noted}
    assert_same(fitted / "products", run / "products")
