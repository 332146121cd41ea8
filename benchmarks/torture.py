"""Faults survived: ``make torture`` does them all and writes docs/appendix/torture.md.

``--only kill`` runs those whose name matches the expression, ``--share 0.1`` a tenth of each; the
table is written only by a complete run. The last line is "all survived", or lists the failures.
"""

import argparse
import os
import re
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path

from faults import Outcome, clocks, damage, full_disk, inputs, kills, places, processes, workers
from faults.bench import STAGES, Bench, make_bench

PAGE = Path(__file__).parents[1] / "docs" / "appendix" / "torture.md"
BEGIN, END = "<!-- torture: begin -->", "<!-- torture: end -->"
HEAD = "| fault | times | outcome |\n|---|---|---|"
SEED = 20261121

ARTEFACTS = ("ingest", "reduce", "sweep", "fit")

HOW_OFTEN = {damage.flip_a_bit: 40, damage.remove: 8, damage.cut: 4, damage.zero: 4}

Trial = Callable[[], Outcome]


def trials(bench: Bench, share: float) -> dict[str, Trial]:
    """All that is tried, by name."""

    def n(count: int) -> int:
        return max(1, round(share * count))

    found: dict[str, Trial] = {}
    mount = full_disk.can_mount(bench.folder)
    for stage in STAGES:
        found[f"kill {stage}"] = partial(kills.kill, bench, stage, n(40))
        found[f"ctrl-c {stage}"] = partial(kills.interrupt, bench, stage, n(10))
        found[f"loading {stage}"] = partial(kills.loading, bench, stage, n(20))
        found[f"full disk {stage}"] = partial(full_disk.at_writes, bench, stage, n(30))
        if mount:
            found[f"small disk {stage}"] = partial(full_disk.on_small_disks, bench, stage, n(6))
    for artefact in ARTEFACTS:
        for what, do in (("metadata", damage.metadata), ("chunks", damage.chunks)):
            for how, times in HOW_OFTEN.items():
                name = f"{how.__name__} {what} {artefact}"
                found[name] = partial(do, bench, artefact, how, n(times))
    flip = damage.flip_a_bit
    for stage in STAGES:
        found[f"unfinished {stage}"] = partial(damage.unfinished, bench, stage, flip, n(12))
    found["products"] = partial(damage.products, bench, flip, n(6))
    found["processes"] = partial(processes.together, bench, n(12))
    for change in inputs.CHANGES:
        for stage in ("ingest", "reduce"):
            name = f"inputs {change.__name__} {stage}"
            found[name] = partial(inputs.change, bench, change, n(6), stage)
    found["inputs rot"] = partial(inputs.rot, bench, n(20))
    for jump in clocks.JUMPS:
        found[f"clock {jump.__name__}"] = partial(clocks.jump, bench, jump)
    found["read-only"] = partial(places.read_only, bench)
    found["names"] = partial(places.hard_names, bench, places.NAMES)
    for stage in STAGES:
        for do_to in (workers.killed, workers.starved):
            name = f"worker {do_to.__name__} {stage}"
            found[name] = partial(_on_a_cluster, do_to, bench, stage, n(2))
    return found


def _on_a_cluster(
    do: Callable[[Bench, str, str, int], Outcome], bench: Bench, stage: str, times: int
) -> Outcome:
    with workers.cluster() as address:
        return do(bench, address, stage, times)


def write_table(outcomes: list[Outcome]) -> None:
    """Put a row for each fault between the marks of the page: all steps and artefacts together."""
    ends: dict[str, Counter[str]] = {}
    for outcome in outcomes:
        ends.setdefault(outcome.fault, Counter()).update(outcome.ends)
    rows = [Outcome(fault, ended).row() for fault, ended in ends.items()]
    text = PAGE.read_text(encoding="utf-8")
    table = "\n".join([BEGIN, HEAD, *rows, END])
    text = re.sub(f"{BEGIN}.*{END}", lambda _: table, text, flags=re.DOTALL)
    PAGE.write_text(text, encoding="utf-8")


@lru_cache
def _trials(folder: Path, share: float) -> dict[str, Trial]:
    """All trials, on a bench of this process."""
    return trials(make_bench(Path(tempfile.mkdtemp(dir=folder)), SEED), share)


def _tried(folder: Path, share: float, name: str) -> tuple[Outcome, float, str]:
    """Outcome of a trial, its seconds, and its failure."""
    begun = time.monotonic()
    try:
        outcome, wrong = _trials(folder, share)[name](), ""
    except Exception as error:
        outcome, wrong = Outcome(name), f"{traceback.format_exc()}{error!r:.2000}"
    return outcome, time.monotonic() - begun, wrong


def main() -> int:
    """Do the trials."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="those whose name this expression finds")
    parser.add_argument("--share", type=float, default=1.0, help="of the usual numbers")
    jobs = max(1, len(os.sched_getaffinity(0)))
    parser.add_argument("--jobs", type=int, default=jobs, help="at a time [default: all cores]")
    options = parser.parse_args()
    outcomes: list[Outcome] = []
    failed: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        every = trials(Bench(folder, folder, folder, {}), options.share)
        names = [name for name in every if re.search(options.only, name)]
        try_one = partial(_tried, folder, options.share)
        with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
            for name, (outcome, took, wrong) in zip(names, pool.map(try_one, names), strict=True):
                if wrong:
                    failed.append(name)
                    print(f"FAILED {name}\n{wrong}", flush=True)
                else:
                    outcomes.append(outcome)
                    print(f"{outcome.row()} <!-- {name}, {took:.0f} s -->", flush=True)
    if not failed and not options.only and options.share == 1:
        write_table(outcomes)
    print(f"not survived: {', '.join(failed)}" if failed else "all survived")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
