"""The example notebook runs from its first cell to its last, and is kept without outputs."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
FILE = ROOT / "docs" / "tutorials" / "first-light.ipynb"
NOTEBOOK: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
CELLS = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]


def test_it_is_a_notebook_without_outputs() -> None:
    assert (NOTEBOOK["nbformat"], NOTEBOOK["nbformat_minor"]) == (4, 5)
    ids = [cell["id"] for cell in NOTEBOOK["cells"]]
    assert len(set(ids)) == len(ids)
    for cell in CELLS:
        assert cell["outputs"] == []
        assert cell["execution_count"] is None
    assert FILE.stat().st_size < 20_000


@pytest.mark.long
def test_its_cells_run_one_after_the_other(tmp_path: Path) -> None:
    """Each as a notebook does it: the value of its last line is shown."""
    program = (
        "import ast, json, sys\n"
        "names = {}\n"
        "for source in json.load(sys.stdin):\n"
        "    *first, last = ast.parse(source).body\n"
        "    exec(compile(ast.Module(first, []), 'cell', 'exec'), names)\n"
        "    if isinstance(last, ast.Expr):\n"
        "        shown = eval(compile(ast.Expression(last.value), 'cell', 'eval'), names)\n"
        "        getattr(shown, '_repr_png_', lambda: None)()\n"
        "        print(shown)\n"
        "    else:\n"
        "        exec(compile(ast.Module([last], []), 'cell', 'exec'), names)\n"
    )
    found = subprocess.run(
        [sys.executable, "-W", "error::DeprecationWarning:pixcal", "-c", program],
        input=json.dumps(["".join(cell["source"]) for cell in CELLS]),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    assert (tmp_path / "demo" / "products" / "report.html").is_file()
    assert len(re.findall(r"times the bound", found.stdout)) == 2
    assert found.stdout.count("Picture()") == 2
    shutil.rmtree(tmp_path / "demo")
