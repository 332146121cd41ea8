"""The second bench owes nothing to pixcal, nor pixcal to it."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
BENCH = sorted((ROOT / "bench/second_bench").rglob("*.py"))
PIXCAL = sorted(
    file
    for folder in ("pipeline", "cli", "bench/blind_examination")
    for file in (ROOT / folder).rglob("*.py")
)


def imported(file: Path) -> Iterator[str]:
    """Packages that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (name.name.split(".")[0] for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: imports are absolute"
            yield (node.module or "").split(".")[0]


def test_the_bench_imports_nothing_of_pixcal() -> None:
    assert len(BENCH) > 10
    for file in BENCH:
        used = set(imported(file))
        assert not {name for name in used if name.startswith("pixcal")}, file
        # What could import by name.
        assert not used & {"importlib", "runpy", "subprocess"}, file
        assert "__import__" not in file.read_text(encoding="utf-8"), file


@pytest.mark.long
def test_pixcal_imports_nothing_of_the_bench() -> None:
    assert [file for file in PIXCAL if "second_bench" in set(imported(file))] == []


@pytest.mark.long
def test_no_module_of_pixcal_is_loaded_with_the_bench() -> None:
    told = "import sys, second_bench.__main__, second_bench.camera; print(*sorted(sys.modules))"
    loaded = subprocess.run(
        [sys.executable, "-c", told], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "second_bench.camera" in loaded
    assert not [name for name in loaded if name.split(".")[0] in ("pixcal", "pixcal_cli")]
