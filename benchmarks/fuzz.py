"""Bad input in thousands of cases, and the table of docs/appendix/fuzz.md.

``--kind NAME --case N`` repeats one case, ``--messages`` prints every refusal.
"""

import argparse
import faulthandler
import os
import re
import resource
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from fuzzing.kinds import KINDS
from fuzzing.laws import SECONDS, Kind, judged

PAGE = Path(__file__).parents[1] / "docs" / "appendix" / "fuzz.md"
PART = 20
"""Cases that a process tries at a time."""
ADDRESS_SPACE = 16 << 30
"""A case that asks for more gets a MemoryError, not the machine."""


def template(message: str) -> str:
    """A message without its numbers, paths and quotations, to tell messages apart."""
    return re.sub(r"'[^']*'|/\S+|[-+]?\d[\d.e+-]*", "#", message)


def try_kind(kind: Kind, numbers: range) -> tuple[Counter[str], Counter[str], float]:
    """Outcomes of some cases of a kind, messages, and seconds; failures are printed at once."""
    found, messages, begin = Counter[str](), Counter[str](), time.monotonic()
    stderr = os.fdopen(os.dup(2), "w")
    for number in numbers:
        # For what no signal interrupts.
        faulthandler.dump_traceback_later(3 * SECONDS, exit=True, file=stderr)
        verdict = judged(kind, number)
        found[verdict.outcome] += 1
        if verdict.outcome == "failed":
            print(f"FAILED --kind {kind.name} --case {number}: {verdict.why}", flush=True)
        elif verdict.why:
            messages[template(verdict.why)] += 1
    faulthandler.cancel_dump_traceback_later()
    stderr.close()
    return found, messages, time.monotonic() - begin


def limit_memory() -> None:
    """Of the process that tries cases."""
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))


def try_part(part: tuple[str, range]) -> tuple[Counter[str], Counter[str], float]:
    """As `try_kind`, in another process."""
    return try_kind(KINDS[part[0]], part[1])


def try_all(
    numbers: Mapping[str, range], jobs: int
) -> tuple[dict[str, Counter[str]], Counter[str]]:
    """Outcomes by the title of their kind, printed as each is done, and all messages."""
    parts = [(name, part) for name, cases in numbers.items() for part in split(cases)]
    messages, tried, seconds = Counter[str](), dict[str, Counter[str]](), Counter[str]()
    context = get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=limit_memory) as pool:
        left = Counter(name for name, _ in parts)
        for (name, _), (found, said, took) in zip(parts, pool.map(try_part, parts), strict=True):
            title = KINDS[name].title
            tried[title] = tried.get(title, Counter()) + found
            messages += said
            seconds[name] += took
            left[name] -= 1
            if not left[name]:
                print(f"{row(title, tried[title])} {seconds[name]:.1f} s", flush=True)
    return tried, messages


def split(cases: range) -> Sequence[range]:
    """Parts of the cases of a kind, so that all cores are busy to the end."""
    return [cases[at : at + PART] for at in range(0, len(cases), PART)]


def row(title: str, found: Counter[str]) -> str:
    """A line of the table."""
    numbers = (found.total(), found["refused"], found["truthful"], found["failed"])
    return f"| {title} | " + " | ".join(map(str, numbers)) + " |"


def write_table(tried: Mapping[str, Counter[str]]) -> None:
    """Put the outcomes of some kinds, by title, into the table of the documentation."""
    text = PAGE.read_text(encoding="utf-8")
    head, table, rest = re.split(
        r"(?<=\|---\|---\|---\|---\|---\|\n)((?:\|.*\n)*)", text, maxsplit=1
    )
    outcomes: dict[str, Counter[str]] = {}
    for line in table.splitlines():
        title, _, refused, truthful, failed = line.strip("| ").split(" | ")
        numbers = {"refused": refused, "truthful": truthful, "failed": failed}
        outcomes[title] = Counter({name: int(number) for name, number in numbers.items()})
    outcomes |= tried
    known = [kind.title for kind in KINDS.values() if kind.title in outcomes]
    rows = [row(title, outcomes[title]) for title in known]
    total = sum((outcomes[title] for title in known), Counter())
    table = "\n".join([*rows, row("all", total)])
    PAGE.write_text(f"{head}{table}\n{rest}", encoding="utf-8")


def main() -> int:
    """Run and print; 1 if a rule was broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", choices=list(KINDS), action="append")
    parser.add_argument("--case", type=int, help="this one only")
    parser.add_argument("--cases", type=int, help="of each kind")
    jobs = len(os.sched_getaffinity(0))
    parser.add_argument("--jobs", type=int, default=jobs, help="processes [default: all cores]")
    parser.add_argument("--messages", action="store_true", help="print the refusals")
    parser.add_argument("--write", action="store_true", help="write docs/appendix/fuzz.md")
    asked = parser.parse_args()
    numbers = {name: range(asked.cases or KINDS[name].cases) for name in asked.kind or KINDS}
    if asked.case is not None:
        numbers = {name: range(asked.case, asked.case + 1) for name in numbers}
    begin = time.monotonic()
    tried, messages = try_all(numbers, asked.jobs)
    total = sum(tried.values(), Counter())
    print(f"{row('all', total)} {time.monotonic() - begin:.0f} s")
    if asked.messages:
        print(*(f"{count:6d} {text}" for text, count in sorted(messages.items())), sep="\n")
    if asked.write:
        write_table(tried)
    return int(total["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main())
