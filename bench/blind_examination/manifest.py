"""The public manifest of an examination: ``blind.json`` next to its cases."""

from dataclasses import dataclass
from pathlib import Path

from blind_examination.draw import Examination
from pixcal.model.config import parse, to_plain
from pixcal.model.errors import InputError
from pixcal.storage.manifest import read_json, write_json

SCHEMA = "pixcal/blind/2"
FILE = "blind.json"
RUNS = "runs"
EXAMINATION = 1000  # lowest seed of examinations; lower ones are for development


@dataclass(frozen=True)
class ExaminationManifest:
    """Contents of an examination, without the truth."""

    schema: str
    purpose: str  # examination or development
    size: str
    commitment: str  # to the truth
    without: tuple[str, ...]  # effect of each case that is not a candidate

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the cases, in order."""
        return tuple(case_name(n) for n in range(len(self.without)))


def case_name(number: int) -> str:
    """Folder of a case."""
    return f"case-{number + 1:04d}"


def purpose_of(seed: int) -> str:
    """Purpose of cases drawn with a seed."""
    return "examination" if seed >= EXAMINATION else "development"


def write_manifest(folder: Path, examination: Examination, commitment: str) -> None:
    """Write the manifest into the folder of the cases."""
    without = tuple(truth.left_out for truth in examination.truths)
    purpose = purpose_of(examination.seed)
    manifest = ExaminationManifest(SCHEMA, purpose, examination.size, commitment, without)
    write_json(folder / FILE, to_plain(manifest))


def read_manifest(folder: Path) -> ExaminationManifest:
    """Read the manifest; InputError if there is none."""
    file = folder / FILE
    if not file.is_file():
        raise InputError(f"{file}: not found; give a directory that 'pixcal blind make' wrote")
    return parse(ExaminationManifest, read_json(file), str(file))
