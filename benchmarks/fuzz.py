"""Bad input in thousands of cases: ``python benchmarks/fuzz.py`` writes the table of docs/fuzz.md.

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
from collections.abc import Mapping
from pathlib import Path

from fuzzing.kinds import KINDS
from fuzzing.laws import SECONDS, Kind, judged

PAGE = Path(__file__).parents[1] / "docs" / "fuzz.md"
ADDRESS_SPACE = 16 << 30
"""A case that asks for more gets a MemoryError, not the machine."""


def template(message: str) -> str:
    """A message without its numbers, paths and quotations, to tell messages apart."""
    return re.sub(r"'[^']*'|/\S+|[-+]?\d[\d.e+-]*", "#", message)


def try_kind(kind: Kind, numbers: range, messages: Counter[str]) -> Counter[str]:
    """Outcomes of some cases of a kind; failures are printed as they come."""
    found: Counter[str] = Counter()
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
    return found


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
    """Run and print; 1 when a law was broken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", choices=list(KINDS), action="append")
    parser.add_argument("--case", type=int, help="this one only")
    parser.add_argument("--cases", type=int, help="of each kind")
    parser.add_argument("--messages", action="store_true", help="print the refusals")
    parser.add_argument("--write", action="store_true", help="write the table of docs/fuzz.md")
    asked = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    messages, tried = Counter[str](), {}
    for name in asked.kind or KINDS:
        begin = time.monotonic()
        numbers = range(asked.cases or KINDS[name].cases)
        if asked.case is not None:
            numbers = range(asked.case, asked.case + 1)
        found = try_kind(KINDS[name], numbers, messages)
        tried[KINDS[name].title] = found
        took = time.monotonic() - begin
        print(f"{row(KINDS[name].title, found)} {took:.1f} s", flush=True)
    total = sum(tried.values(), Counter())
    print(row("all", total))
    if asked.messages:
        print(*(f"{count:6d} {text}" for text, count in sorted(messages.items())), sep="\n")
    if asked.write:
        write_table(tried)
    return int(total["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main())
