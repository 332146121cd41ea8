"""A study of many acquisitions, two at a time, that goes on where it was interrupted."""

import json
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import Any

from pixcal.engine.run import Runtime, run_tasks

Result = dict[str, Any]


def run_study(
    examine: Callable[[Any], Result],
    cases: Sequence[Hashable],
    case_of: Callable[[Result], Hashable],
    out: Path,
) -> list[Result]:
    """Results of all cases, kept in ``out`` as lines of JSON; those there are not repeated."""
    out.parent.mkdir(parents=True, exist_ok=True)
    out.touch()
    results = [json.loads(line) for line in out.read_text("utf-8").splitlines()]
    known = set(map(case_of, results))
    pending = [case for case in cases if case not in known]
    with out.open("a", encoding="utf-8") as lines:

        def keep(_: int, result: Result) -> None:
            results.append(result)
            print(json.dumps(result), file=lines, flush=True)

        runtime = Runtime(cluster="processes", quiet=False)
        run_tasks(examine, pending, runtime, label="acquisitions", done=keep)
    return results
