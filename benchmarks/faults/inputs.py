"""Input files that vanish or change while they are read."""

import os
import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from faults import Outcome
from faults.bench import Bench, line
from faults.forks import Command, pixcal

Change = Callable[[Path, random.Random], None]


def vanish(file: Path, rng: random.Random) -> None:
    """Remove a file."""
    file.unlink()


def cut(file: Path, rng: random.Random) -> None:
    """Cut a file short."""
    os.truncate(file, rng.randrange(file.stat().st_size))


def write_into(file: Path, rng: random.Random) -> None:
    """Overwrite some bytes; the size stays."""
    with file.open("r+b") as handle:
        handle.seek(rng.randrange(2880, file.stat().st_size - 8))
        handle.write(b"pixcal!!")


def replace(file: Path, rng: random.Random) -> None:
    """Put another file of the same size in its place."""
    other = file.with_name("other.tmp")
    other.write_bytes(file.read_bytes()[::-1])
    other.replace(file)


CHANGES = {
    vanish: "vanishes",
    cut: "is cut short",
    write_into: "is overwritten in part",
    replace: "is replaced",
}


def change(bench: Bench, how: Change, times: int, seed: int) -> Outcome:
    """Change a file of the acquisition at a random moment of ingest, then put it back."""
    outcome = Outcome(f"an input file {CHANGES[how]} while `ingest` runs")
    rng = random.Random(f"{how.__name__} {seed}")
    acquisition = bench.folder / "changing"
    files = [f.relative_to(bench.acquisition) for f in sorted(bench.acquisition.rglob("*.fits"))]
    while outcome.tried < times:
        shutil.rmtree(acquisition, ignore_errors=True)
        shutil.copytree(bench.acquisition, acquisition)  # with the times of the files
        run = bench.copy("changed")
        name = rng.choice(files)
        command = Command(line("ingest", acquisition, run))
        while command.process.is_alive() and not (run / ".lock").exists():
            time.sleep(0.001)  # until it knows its files
        time.sleep(rng.uniform(0, bench.seconds["ingest"] / 2))
        how(acquisition / name, rng)
        ended = command.end()
        if ended.code:
            ended.refused(2, f"{acquisition / name}: ")
            assert not (run / "ingest").exists()
            outcome.ends["named, exit 2; with the file restored resumed, bit-identical"] += 1
        else:
            outcome.ends["after all was read: bit-identical"] += 1
            bench.assert_same(run, "ingest")
        shutil.copy2(bench.acquisition / name, acquisition / name)
        pixcal(*line("ingest", acquisition, run)).succeeded()
        bench.assert_same(run, "ingest")
    return outcome
