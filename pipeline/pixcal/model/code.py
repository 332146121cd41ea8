"""Identity of the code of a result, an unfinished build or another process."""

import hashlib
from functools import cache
from pathlib import Path

import pixcal


@cache
def code_digest() -> str:
    """Digest (hex, 16 characters) of the program's own files, which may change between releases."""
    code = hashlib.sha256()
    root = Path(pixcal.__file__).parent
    for file in sorted(root.rglob("[a-z_]*.py")):
        code.update(f"{file.relative_to(root).as_posix()}\0".encode() + file.read_bytes())
    return code.hexdigest()[:16]
