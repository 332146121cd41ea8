"""Deliberate faults, and what must be true afterwards.

Each module holds one kind of fault: a function that repeats it a given number of times and returns
an `Outcome`, or raises AssertionError if something was lost or a result changed. The tests do each
a few times (tests/torture), ``make torture`` many times (benchmarks/torture.py).
"""

from collections import Counter
from dataclasses import dataclass, field


@dataclass
class Outcome:
    """Outcome of one kind of fault."""

    fault: str  # what was done, without the step or the artefact that it was done to
    ends: Counter[str] = field(default_factory=Counter)  # how often it ended how

    @property
    def tried(self) -> int:
        """How often it was done."""
        return self.ends.total()

    def row(self) -> str:
        """A row of the table in the documentation."""
        told = "; ".join(f"{end}: {count}" for end, count in self.ends.most_common())
        return f"| {self.fault} | {self.tried} | {told} |"
