"""Every block of code in the documentation is run or read; links and commands exist."""

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from pixcal.model.acquisition import SCHEMA as ACQUISITION
from pixcal.model.acquisition import Acquisition
from pixcal.model.bench import SCHEMA as BENCH
from pixcal.model.bench import Bench
from pixcal.model.config import parse, read_yaml
from pixcal_cli.main import cli

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
SHELL = ("bash", "console")
DATA = ("yaml", "json")
READ_ONLY = ("", "text")
NOT_RUN = re.compile(r"(make|git clone|cd|source) ")
"""Lines that need a clone of their own; the targets of make are looked up."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: Path
    line: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    def commands(self) -> list[str]:
        """Shell lines: all of a bash block, what follows ``$`` in a console block."""
        lines = self.text.splitlines()
        if self.language == "console":
            return [line[2:] for line in lines if line.startswith("$ ")]
        return [line for line in lines if line and not line.startswith("#")]


def blocks_of(page: Path) -> list[Block]:
    found: list[Block] = []
    fence, language, start = "", "", 0
    lines: list[str] = []
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        mark = re.match(r"\s*(`{3,})\s*(\S*)\s*$", line)
        if not fence and mark:
            fence, language, start, lines = mark[1], mark[2], number, []
        elif fence and line.strip() == fence:
            found.append(Block(page, start, language, "\n".join(lines)))
            fence = ""
        elif fence:
            lines.append(line)
    assert not fence, f"{page}:{start}: the block is not closed"
    return found


BLOCKS = [block for page in PAGES for block in blocks_of(page)]
PAGES_WITH_SHELL = [p for p in PAGES if any(b.language in SHELL for b in blocks_of(p))]


def targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """A directory where the documentation's commands find what they name."""
    for name in ("configs", "data_samples", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


def shell(script: str, folder: Path) -> str:
    """Run lines as a user with the environment on the path; returns stdout."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    found = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=folder,
        env=os.environ | {"PATH": path},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    return found.stdout


def test_the_blocks_are_found() -> None:
    readme = blocks_of(ROOT / "README.md")
    assert {"bash", "yaml"} <= {block.language for block in readme}
    assert "make demo" in [line for block in readme for line in block.commands()]


@pytest.mark.parametrize("block", BLOCKS, ids=str)
def test_a_block_says_what_it_is(block: Block) -> None:
    assert block.language in (*SHELL, *DATA, *READ_ONLY, "python")
    if block.language in READ_ONLY:
        assert not re.search(r"^(\$ |pixcal |make )", block.text, re.MULTILINE)


@pytest.mark.parametrize("page", PAGES_WITH_SHELL, ids=lambda page: page.name)
def test_shell_blocks_run(page: Path, workspace: Path) -> None:
    lines = [c for b in blocks_of(page) if b.language in SHELL for c in b.commands()]
    for line in lines:
        if line.startswith("make "):
            assert set(line.split()[1:]) <= targets(), line
    shell("\n".join(line for line in lines if not NOT_RUN.match(line)), workspace)


def test_the_readme_shows_what_the_demo_prints(workspace: Path) -> None:
    """All words and lines; numbers may differ in their last digits from machine to machine."""

    def words(text: str) -> list[list[str]]:
        return [re.sub(r"-?\d[\d.]*(e-\d+)?", "#", line).split() for line in text.splitlines()]

    (command,) = re.findall(r"^demo:.*\n\t\$\(BIN\)/(.*)$", (ROOT / "Makefile").read_text(), re.M)
    (shown,) = (b.text for b in blocks_of(ROOT / "README.md") if b.language == "text")
    assert words(shell(f"{command} --quiet", workspace).strip()) == words(shown)


def test_python_blocks_run(workspace: Path) -> None:
    for block in (b for b in BLOCKS if b.language == "python"):
        (workspace / "block.py").write_text(block.text, encoding="utf-8")
        shell("python block.py", workspace)


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language in DATA], ids=str)
def test_a_data_block_is_read(block: Block, tmp_path: Path) -> None:
    if block.language == "json":
        json.loads(block.text)
        return
    file = tmp_path / "block.yaml"
    file.write_text(block.text, encoding="utf-8")
    data = read_yaml(file)
    kinds = {ACQUISITION: Acquisition, BENCH: Bench}
    if "schema" in data:
        parse(kinds[data["schema"]], data, str(block))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if "://" not in link:
            assert (page.parent / link).exists(), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_commands_named_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert set(re.findall(r"`pixcal ([a-z]+)", text)) <= set(cli.commands)
    assert set(re.findall(r"`make ([a-z-]+)", text)) <= targets()


def test_the_readme_names_every_command() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert set(re.findall(r"`pixcal ([a-z]+)", text)) == set(cli.commands)
