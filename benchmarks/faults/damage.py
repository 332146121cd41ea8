"""Flipped bits in stored data, missing files, and truncated files."""

import random
import re
import shlex
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from faults import Outcome
from faults.bench import STAGES, Bench
from faults.forks import Command, pixcal
from pixcal.model.errors import DamagedError
from pixcal.storage.cube_reader import ArrayReader

OWNERS = {"ingest": "ingest", "reduce": "reduce", "sweep": "fit", "fit": "fit"}
"""The command that makes each artefact."""
READERS = {"ingest": "reduce", "reduce": "fit", "sweep": "fit", "fit": "allan"}
"""The next command that reads it."""

Damage = Callable[[Path, random.Random], None]
Trial = Callable[[Bench, str, Damage, int], Outcome]


def flip_a_bit(file: Path, rng: random.Random) -> None:
    """Flip a random bit of a file."""
    body = bytearray(file.read_bytes())
    at = rng.randrange(8 * len(body))
    body[at >> 3] ^= 1 << (at & 7)
    _replace(file, bytes(body))


def remove(file: Path, rng: random.Random) -> None:
    """Remove a file."""
    file.unlink()


def cut(file: Path, rng: random.Random) -> None:
    """Keep no more than the beginning of a file."""
    body = file.read_bytes()
    _replace(file, body[: rng.randrange(len(body))])


def zero(file: Path, rng: random.Random) -> None:
    """A file of the same size without content, as a power failure may leave it."""
    _replace(file, bytes(file.stat().st_size))


def _replace(file: Path, body: bytes) -> None:
    file.unlink()  # a hard link: the reference keeps its own
    file.write_bytes(body)


WORDS = {
    flip_a_bit: "one bit flipped",
    remove: "removed",
    cut: "cut short",
    zero: "overwritten with zeros",
}


def _some(
    bench: Bench, artefact: str, times: int, rng: random.Random, *, chunks: bool
) -> list[str]:
    """Some files of an artefact: chunks of arrays, or others."""
    folder = bench.reference / artefact
    names = (f.relative_to(folder).as_posix() for f in sorted(folder.rglob("*")) if f.is_file())
    found = [name for name in names if ("/c/" in name) == chunks]
    return rng.sample(found, min(times, len(found)))


def metadata(bench: Bench, artefact: str, damage: Damage, times: int) -> Outcome:
    """Damage files beside the chunks: the next command names them; their own repairs them."""
    outcome = Outcome(f"metadata file: {WORDS[damage]}")
    rng = bench.rng(artefact, damage.__name__)
    for name in _some(bench, artefact, times, rng, chunks=False):
        run = _ready(bench, artefact)
        damage(run / artefact / name, rng)
        told = name.removesuffix("/chunks.npy").removesuffix("/zarr.json")
        if name == "manifest.json" and damage is remove:
            told = "not there yet; run '"
        if artefact != "sweep":  # made and read by one command, which mends it at once
            ended = pixcal(*bench.command(READERS[artefact], run))
            ended.refused(2, f"pixcal {OWNERS[artefact]}", told)
        _mended(bench, run, artefact)
        outcome.ends["refused by name; rebuilt by its command"] += 1
    return outcome


def chunks(bench: Bench, artefact: str, damage: Damage, times: int) -> Outcome:
    """Damage chunks: they are refused when read, and never used."""
    outcome = Outcome(f"chunk: {WORDS[damage]}")
    rng = bench.rng(artefact, damage.__name__)
    for name in _some(bench, artefact, times, rng, chunks=True):
        run = _ready(bench, artefact)
        damage(run / artefact / name, rng)
        stored = run / artefact / name.partition("/c/")[0]
        with pytest.raises(DamagedError, match=re.escape(f"{artefact}/{name}")):
            ArrayReader(stored).read()
        ended = pixcal(*bench.command(READERS[artefact], run))
        if ended.code == 0:
            # What was made beside the damage is what is made without it.
            if artefact != READERS[artefact]:
                bench.assert_same(run, READERS[artefact])
            outcome.ends["not read by the next command"] += 1
            continue
        ended.refused(2, name, f"pixcal {OWNERS[artefact]}")
        (advised,) = re.findall(r"make it again with '(.*)'", ended.err)
        _type(bench, advised)
        _mended(bench, run, artefact)
        outcome.ends["refused by name; rebuilt by its command"] += 1
    return outcome


def products(bench: Bench, damage: Damage, times: int) -> Outcome:
    """Damage the FITS maps: the fit writes them again although it is up to date."""
    outcome = Outcome(f"FITS map: {WORDS[damage]}")
    rng = bench.rng("products", damage.__name__)
    for number in range(times):
        run = bench.copy("damaged", "ingest", "reduce", "sweep", "fit", "products")
        damage(run / "products" / ("delta_x.fits", "delta_y.fits")[number % 2], rng)
        pixcal(*bench.command("fit", run)).succeeded()
        bench.assert_same(run, *STAGES)
        outcome.ends["written again"] += 1
    return outcome


def unfinished(bench: Bench, stage: str, damage: Damage, times: int) -> Outcome:
    """Kill a command, damage its unfinished build, and resume."""
    outcome = Outcome(f"file of an unfinished build: {WORDS[damage]}")
    rng = bench.rng("unfinished", stage, damage.__name__)
    while outcome.tried < times:
        run = bench.before(stage, "unfinished")
        command = Command(bench.command(stage, run))
        while command.process.is_alive() and not any(run.glob(".partial/*/*")):
            time.sleep(0.001)
        time.sleep(rng.uniform(0, 0.7) * bench.seconds[stage])
        command.send(signal.SIGKILL)
        command.end()
        left = [f for f in sorted(run.glob(".partial/**/*")) if f.is_file()]
        left = [f for f in left if f.stat().st_size and not f.name.endswith(".aside")]
        if not left:
            continue
        chunks = [f for f in left if "/c/" in f.as_posix()]
        damage(rng.choice(chunks if chunks and outcome.tried % 2 == 0 else left), rng)
        refused = 0
        for again in STAGES[STAGES.index(stage) :]:
            while (ended := pixcal(*bench.command(again, run))).code:
                refused += 1
                assert refused < 4, ended.err
                ended.refused(2)
                if advised := re.findall(r"make it again with '(.*)'", ended.err):
                    _type(bench, advised[0])
        bench.assert_same(run, *STAGES)
        end = "refused by name; rebuilt" if refused else "resumed"
        outcome.ends[end] += 1
    return outcome


def _type(bench: Bench, line: str) -> None:
    """Do what a message advises."""
    pixcal(*shlex.split(line.replace("ACQ", str(bench.acquisition)))[1:]).succeeded()


def _ready(bench: Bench, artefact: str) -> Path:
    """A run up to an artefact, without that of the next command."""
    order = ["ingest", "reduce", "sweep", "fit"]
    return bench.copy("damaged", *order[: order.index(artefact) + 1])


def _mended(bench: Bench, run: Path, artefact: str) -> None:
    """Run the command of the artefact: all results must be as without damage."""
    pixcal(*bench.command(OWNERS[artefact], run)).succeeded()
    bench.assert_same(run, OWNERS[artefact])
    assert not list(run.rglob("damage.json"))
