"""Input files that vanish or change while they are read."""

import os
import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from faults import Outcome
from faults.bench import Bench, line
from faults.damage import remove
from faults.forks import Command, pixcal

Change = Callable[[Path, random.Random], None]


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
    remove: "vanishes",
    cut: "is cut short",
    write_into: "is overwritten in part",
    replace: "is replaced",
}


def change(bench: Bench, how: Change, times: int, stage: str = "ingest") -> Outcome:
    """Change a file of the acquisition at a random moment of a stage, then put it back."""
    outcome = Outcome(f"input file {CHANGES[how]} during a command")
    rng = bench.rng(how.__name__, stage)
    while outcome.tried < times:
        acquisition, run = _fresh(bench, stage)
        name = rng.choice(_files(bench))
        command = Command(line(stage, acquisition, run))
        while command.process.is_alive() and not (run / ".lock").exists():
            time.sleep(0.001)  # until it knows its files
        time.sleep(rng.uniform(0, bench.seconds[stage] / 2))
        how(acquisition / name, rng)
        ended = command.end()
        if ended.code:
            ended.refused(2, f"{acquisition / name}: ")
            assert not (run / stage).exists()
            outcome.ends["refused by name; resumed with the file restored"] += 1
        else:
            outcome.ends["already read"] += 1
            bench.assert_same(run, stage)
        shutil.copy2(bench.acquisition / name, acquisition / name)
        pixcal(*line(stage, acquisition, run)).succeeded()
        bench.assert_same(run, stage)
    return outcome


def rot(bench: Bench, times: int) -> Outcome:
    """Flip a bit of a frame after it was ingested; its size and time stay."""
    outcome = Outcome("FITS file: one bit flipped between `ingest` and `reduce`")
    rng = bench.rng("rot")
    while outcome.tried < times:
        acquisition, run = _fresh(bench, "reduce")
        name = rng.choice(_files(bench))
        file, facts = acquisition / name, (acquisition / name).stat()
        body = bytearray(file.read_bytes())
        at = rng.randrange(8 * len(body))
        body[at >> 3] ^= 1 << (at & 7)
        file.write_bytes(body)
        os.utime(file, ns=(facts.st_atime_ns, facts.st_mtime_ns))
        ended = pixcal(*line("reduce", acquisition, run))
        if ended.code:
            ended.refused(2, f"{file}: its contents differ from those ingested")
            outcome.ends["refused by name; resumed with the file restored"] += 1
            shutil.copy2(bench.acquisition / name, file)
            pixcal(*line("reduce", acquisition, run)).succeeded()
        else:
            outcome.ends["outside the samples"] += 1
        bench.assert_same(run, "reduce")
    return outcome


def _files(bench: Bench) -> list[Path]:
    return [f.relative_to(bench.acquisition) for f in sorted(bench.acquisition.rglob("*.fits"))]


def _fresh(bench: Bench, stage: str) -> tuple[Path, Path]:
    """An acquisition of the same frames, and a run up to a stage of it."""
    acquisition = bench.folder / "changing"
    shutil.rmtree(acquisition, ignore_errors=True)
    shutil.copytree(bench.acquisition, acquisition)  # with the times of the files
    run = bench.copy("changed")
    if stage == "reduce":
        pixcal(*line("ingest", acquisition, run)).succeeded()
        (run / ".lock").unlink()
    return acquisition, run
