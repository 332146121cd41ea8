"""Directories that cannot be written, and paths that are hard to spell."""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from faults import Outcome
from faults.bench import STAGES, Bench, line
from faults.forks import pixcal

NOBODY = 65534

NAMES = (
    "with two  spaces",
    "Übung größer",
    "夜の実験",
    "-starts-like-an-option",
    'quote\'s "and" [brackets] {a,b}*?',
    "100%s $HOME `x` #1",
    "new\nline",
    "a" * 200,
)


def _as_nobody(home: Path) -> None:
    """Root may write anywhere, so become another user."""
    os.environ["HOME"] = str(home)
    if os.getuid() == 0:
        os.setgroups([])
        os.setgid(NOBODY)
        os.setuid(NOBODY)


@contextmanager
def _read_only(folder: Path) -> Iterator[None]:
    modes = {f: f.stat().st_mode for f in (folder, *folder.rglob("*")) if f.is_dir()}
    for up in folder.parents:
        if up.owner() == folder.owner() and not up.stat().st_mode & 0o005:
            up.chmod(up.stat().st_mode | 0o055)
    for place in modes:
        place.chmod(0o555)
    try:
        yield
    finally:
        for place, mode in modes.items():
            place.chmod(mode)


def read_only(bench: Bench) -> Outcome:
    """Every command on a run directory that cannot be written, new or not."""
    outcome = Outcome("read-only directory")
    before = partial(_as_nobody, bench.folder / "no home")
    for number, stage in enumerate((*STAGES, "allan")):
        run = bench.copy("read only", *(*STAGES, "allan")[:number])
        with _read_only(run):
            ended = pixcal(*bench.command(stage, run), before=before)
            ended.refused(2, str(run), "Permission denied")
        outcome.ends["one line, exit 2"] += 1
        assert not (run / stage).exists()
    with _read_only(bench.reference):
        new = bench.reference / "new"
        ended = pixcal(*line("ingest", bench.acquisition, new), before=before)
        ended.refused(2, str(new), "Permission denied")
        outcome.ends["one line, exit 2"] += 1
    run = bench.copy("from read only")
    run.chmod(0o777)
    with _read_only(bench.acquisition):
        for stage in STAGES:
            pixcal(*bench.command(stage, run), before=before).succeeded()
    bench.assert_same(run, *STAGES)
    outcome.ends["not written to"] += 1
    return outcome


def hard_names(bench: Bench, names: Sequence[str]) -> Outcome:
    """The whole chain below directories with odd names."""
    outcome = Outcome("paths with spaces, quotes, other alphabets")
    for name in names:
        folder = bench.folder / "names" / name
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(bench.acquisition, folder / f"ACQ {name}"[:250], copy_function=shutil.copy2)
        acquisition, run = folder / f"ACQ {name}"[:250], folder / f"RUN {name}"[:250]
        for stage in STAGES:
            ended = pixcal(*line(stage, acquisition, run)).succeeded()
            assert str(run) in ended.out
        bench.assert_same(run, *STAGES)
        pixcal("fit", run / "nowhere").refused(2)
        outcome.ends["same result"] += 1
    return outcome
