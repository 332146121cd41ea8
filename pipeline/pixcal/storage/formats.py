"""The kinds of artefacts and the format that each is written in, said once.

Another layout on the disk is another format; `docs/reference/run-directory.md` describes them all.
"""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Stage:
    """What makes one kind of artefact, ``RUN/<name>``."""

    name: str
    format: int  # that is written, and read
    command: str  # what the user types to have it made, `RUN` standing for the run directory
    earlier: tuple[int, ...] = ()  # formats that are read as well
    of_fringes: bool = True  # whether there is none of an acquisition without fringes

    def typed(self, run: Path) -> str:
        """The command for a run."""
        return f"pixcal {self.command}".replace("RUN", str(run))


STAGES = {
    stage.name: stage
    for stage in (
        Stage("ingest", 2, "ingest ACQ --out RUN", earlier=(1,), of_fringes=False),
        Stage("reduce", 1, "reduce RUN", of_fringes=False),
        Stage("sweep", 4, "fit RUN"),
        Stage("fit", 1, "fit RUN"),
        Stage("allan", 1, "allan RUN"),
        Stage("crests", 1, "crests RUN"),
        Stage("diagnose", 6, "diagnose RUN", of_fringes=False),
        Stage("corrected", 2, "fit RUN --with-diagnosis"),
        Stage("astrometry", 1, "astrometry RUN"),
        Stage("report", 2, "report RUN", of_fringes=False),
        # In directories of their own.
        Stage("compare", 1, "compare RUN --out DIR"),
        Stage("simulate", 1, "simulate BENCH.yaml --out ACQ"),
        Stage("simulate-truth", 1, "simulate BENCH.yaml --out ACQ"),
    )
}
