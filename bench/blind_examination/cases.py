"""``pixcal blind make``: acquisitions whose effects are withheld, and the truth in a sealed file.

Only the samples depend on the truth. Folders, files, their sizes and headers, the frames and the
bench are the same as with any other effect; all file times are equal; and all cases are copied into
place at the end, one after the other, so that a file's creation time does not reveal how long its
case took to make.
"""

import os
import secrets
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from blind_examination.benches import LAYOUTS
from blind_examination.draw import Examination, Truth, draw_examination
from blind_examination.manifest import EXAMINATION, case_name, write_manifest
from blind_examination.options import MakeConfig
from blind_examination.seal import write_seal
from blind_examination.second import record_second
from pixcal.effects import parse_effects
from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect
from pixcal.stages.simulate import acquire
from pixcal.storage.lock import lock
from pixcal.storage.manifest import digest

MOMENT = datetime(2026, 1, 1, tzinfo=UTC).timestamp()  # time of every file
MAX_SEED = 10**17


def make(out: Path, sealed: Path, config: MakeConfig, runtime: Runtime) -> Examination:
    """Make an examination: the cases in ``out``, when all are complete, the truth in ``sealed``.

    InputError if an output exists already, or the truth would lie inside the cases.
    """
    _check(out, sealed, config)
    seed = EXAMINATION + secrets.randbelow(MAX_SEED) if config.seed is None else config.seed
    examination = draw_examination(config.cases, seed, config.size, config.bench)
    write_examination(out, sealed, examination, runtime)
    return examination


def write_examination(out: Path, sealed: Path, examination: Examination, runtime: Runtime) -> None:
    """Write cases, manifest and seal."""
    benches = tuple(examination.bench(n) for n in range(len(examination.truths)))
    partial_ones = f".{out.name}.partial-"
    key = digest(repr(examination), repr(benches))[:16]
    aside = out.with_name(partial_ones + key)
    with lock(aside):
        items = list(zip(range(len(benches)), benches, examination.truths, strict=True))
        run_tasks(partial(_case, aside, examination.size), items, runtime, label="cases")
        made = aside / "made"
        shutil.rmtree(made, ignore_errors=True)
        for name in map(case_name, range(len(benches))):
            shutil.copytree(aside / name, made / name)
        write_manifest(made, examination, write_seal(sealed, examination, benches))
        for path in sorted(made.rglob("*"), reverse=True):
            os.utime(path, (MOMENT, MOMENT))
        out.parent.mkdir(parents=True, exist_ok=True)
        made.rename(out)
    for stale in out.parent.glob(f"{partial_ones}*"):
        shutil.rmtree(stale)


def _check(out: Path, sealed: Path, config: MakeConfig) -> None:
    if config.size not in LAYOUTS:
        raise InputError(f"--size {config.size}: not one of {', '.join(LAYOUTS)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: not empty; choose another directory")
    if sealed.exists():
        raise InputError(f"--sealed {sealed}: already exists; choose another file")
    if sealed.resolve().is_relative_to(out.resolve()):
        raise InputError(f"--sealed {sealed}: inside {out}; keep the truth apart from the cases")


def _case(folder: Path, size: str, item: tuple[int, Bench, Truth]) -> None:
    number, bench, truth = item
    final = folder / case_name(number)
    if final.exists():
        return
    made = folder / f".{final.name}.aside"
    shutil.rmtree(made, ignore_errors=True)
    if truth.second is not None:
        folder.mkdir(parents=True, exist_ok=True)
        record_second(truth.second, LAYOUTS[size], made)
    else:
        made.mkdir(parents=True)
        acquire(bench, effects_of(truth, bench), made, Runtime(cluster="sync"))
    made.rename(final)


def effects_of(truth: Truth, bench: Bench) -> tuple[Effect, ...]:
    """The library's effects of a case, checked for consistency with its bench."""
    plain = {d.effect: d.parameters for d in truth.drawn}
    effects = parse_effects(plain, "blind")
    for effect in effects:
        effect.check(replace(bench, effects=plain))
    return effects
