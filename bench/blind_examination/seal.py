"""The sealed file: the truth of an examination, and the public commitment to it.

The commitment is a SHA-256 of the truth with a random salt that only the sealed file has: it
reveals nothing, and nobody can change the truth afterwards.
"""

import hashlib
import json
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from blind_examination.draw import Examination
from pixcal.model.bench import Bench
from pixcal.model.config import parse, to_plain
from pixcal.model.errors import InputError
from pixcal.storage.manifest import read_json, write_json

SCHEMA = "pixcal/blind-truth/3"


@dataclass(frozen=True)
class Sealed:
    """Contents of a sealed file."""

    schema: str
    salt: str
    examination: Examination
    benches: tuple[Bench, ...]  # of the cases


def write_seal(path: Path, examination: Examination, benches: tuple[Bench, ...]) -> str:
    """Write the truth, readable by its owner only; returns the commitment."""
    plain = to_plain(Sealed(SCHEMA, secrets.token_hex(32), examination, benches))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, plain)
    path.chmod(0o600)
    return _commitment(plain)


def read_seal(path: Path, commitment: str) -> Sealed:
    """Open a sealed file; InputError if it is missing, or does not match the commitment."""
    if not path.is_file():
        raise InputError(
            f"--sealed {path}: not found; give the file that 'pixcal blind make' wrote"
        )
    plain = read_json(path)
    if not isinstance(plain, dict) or plain.get("schema") != SCHEMA:
        raise InputError(f"--sealed {path}: not a sealed file of 'pixcal blind make'; give another")
    if _commitment(plain) != commitment:
        raise InputError(
            f"--sealed {path}: not the truth of these cases, or altered since; give the file that "
            "was written with them"
        )
    return parse(Sealed, plain, str(path))


def _commitment(plain: Any) -> str:
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()
