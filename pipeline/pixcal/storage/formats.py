"""The kinds of artefacts and their formats.

A changed layout on disk is a new format; `docs/reference/run-directory.md` describes them all.
"""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ArtefactKind:
    """One kind of artefact, ``RUN/<name>``."""

    name: str
    format: int  # format that is written and read
    command: str  # command to make it, with `RUN` for the run directory
    earlier: tuple[int, ...] = ()  # earlier formats that can be read
    of_fringes: bool = True  # whether it requires fringes
    products: str = ""  # pattern of the files that are copied to ``RUN/products``

    def typed(self, run: Path) -> str:
        """The command for a run."""
        return f"pixcal {self.command}".replace("RUN", str(run))


STAGES = {
    stage.name: stage
    for stage in (
        ArtefactKind("ingest", 3, "ingest ACQ --out RUN", earlier=(1, 2), of_fringes=False),
        ArtefactKind("reduce", 2, "reduce RUN", earlier=(1,), of_fringes=False),
        ArtefactKind("sweep", 5, "fit RUN"),
        ArtefactKind("fit", 1, "fit RUN"),
        ArtefactKind("allan", 1, "allan RUN", products="allan.json"),
        ArtefactKind("crests", 1, "crests RUN", products="crests*.*"),
        ArtefactKind("diagnose", 7, "diagnose RUN", of_fringes=False, products="diagnosis.json"),
        ArtefactKind("corrected", 3, "fit RUN --with-diagnosis"),
        ArtefactKind("astrometry", 1, "astrometry RUN", products="astrometry.*"),
        ArtefactKind("report", 2, "report RUN", of_fringes=False, products="report.html"),
        # In separate directories.
        ArtefactKind("compare", 1, "compare RUN --out DIR"),
        ArtefactKind("simulate", 1, "simulate BENCH.yaml --out ACQ"),
        ArtefactKind("simulate-truth", 1, "simulate BENCH.yaml --out ACQ"),
    )
}
