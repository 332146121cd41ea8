"""Every block of code in the documentation is run or read; links and commands exist.

A block with a title (``yaml title="night/acquisition.yaml"``) is a file that the reader writes.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from pixcal.model.acquisition import SCHEMA as ACQUISITION
from pixcal.model.acquisition import Acquisition
from pixcal.model.bench import SCHEMA as BENCH
from pixcal.model.bench import Bench
from pixcal.model.config import parse
from pixcal.model.yaml_file import read_yaml
from pixcal_cli.main import cli

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
SHELL = ("bash", "console")
DATA = ("yaml", "json")
READ_ONLY = ("", "text")
NOT_RUN = re.compile(r"(make|git clone|cd|source|pip install) ")
"""Lines that need a clone or a network; the targets of make are looked up."""
WARM = Path(__file__).with_name("warm.py")
DEMO = "pixcal run data_samples/demo --out demo"


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: Path
    line: int
    language: str
    text: str
    title: str = ""
    """File that the reader writes it to."""

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
    fence, language, title, start = "", "", "", 0
    lines: list[str] = []
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        mark = re.match(r'\s*(`{3,})\s*(\w*)(?:\s+title="([^"]+)")?\s*$', line)
        if not fence and mark:
            fence, language, title, start, lines = mark[1], mark[2], mark[3] or "", number, []
        elif fence and line.strip() == fence:
            found.append(Block(page, start, language, "\n".join(lines) + "\n", title))
            fence = ""
        elif fence:
            lines.append(line)
    assert not fence, f"{page}:{start}: the block is not closed"
    return found


BLOCKS = [block for page in PAGES for block in blocks_of(page)]
PAGES_TO_RUN = [p for p in PAGES if any(b.language in (*SHELL, "python") for b in blocks_of(p))]


def targets() -> set[str]:
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """A directory where the documentation's commands find what they name."""
    for name in ("configs", "data_samples", "docs", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


@pytest.fixture(scope="session")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with ``pixcal`` and ``python`` that begin at once: see `WARM`."""
    folder = tmp_path_factory.mktemp("warm")
    with subprocess.Popen([sys.executable, WARM, folder], stdout=subprocess.PIPE) as server:
        assert server.stdout is not None
        assert server.stdout.readline() == b"ready\n"
        yield folder
        server.terminate()


Shell = Callable[[str, Path], str]


@pytest.fixture(scope="session")
def shell(programs: Path) -> Shell:
    """Run lines as a user with the environment on the path; returns stdout."""
    folders = [str(programs), str(Path(sys.executable).parent), os.environ["PATH"]]

    def run(script: str, folder: Path) -> str:
        with subprocess.Popen(
            ["bash", "-euo", "pipefail", "-c", script],
            cwd=folder,
            env=os.environ | {"PATH": os.pathsep.join(folders)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as process:
            try:
                printed, complaints = process.communicate(timeout=600)
            except subprocess.TimeoutExpired:
                # With all that it has started, in the background too.
                os.killpg(process.pid, signal.SIGTERM)
                raise
        assert process.returncode == 0, complaints
        return printed

    return run


@pytest.fixture(scope="session")
def demo(shell: Shell, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The run of `make demo`, made once, and what it printed."""
    folder = tmp_path_factory.mktemp("demo")
    (folder / "data_samples").symlink_to(ROOT / "data_samples")
    return folder / "demo", shell(f"{DEMO} --quiet", folder)


def test_the_blocks_are_found() -> None:
    readme = blocks_of(ROOT / "README.md")
    assert {"bash", "yaml"} <= {block.language for block in readme}
    assert "make demo" in [line for block in readme for line in block.commands()]


@pytest.mark.parametrize("block", BLOCKS, ids=str)
def test_a_block_says_what_it_is(block: Block) -> None:
    assert block.language in (*SHELL, *DATA, *READ_ONLY, "python")
    if block.language in READ_ONLY:
        assert not re.search(r"^(\$ |pixcal |make )", block.text, re.MULTILINE)


def run_block(block: Block, folder: Path, shell: Shell) -> None:
    """Do what a reader does: write the file, type the commands, run the program."""
    if block.title:
        file = folder / block.title
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(block.text, encoding="utf-8")
    elif block.language in SHELL:
        for line in block.commands():
            if line.startswith("make "):
                assert set(line.split()[1:]) <= targets(), line
        shell("\n".join(line for line in block.commands() if not NOT_RUN.match(line)), folder)
    elif block.language == "python":
        (folder / "block.py").write_text(block.text, encoding="utf-8")
        shell("python block.py", folder)


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES_TO_RUN, ids=lambda page: page.name)
def test_the_blocks_of_a_page_run_one_after_the_other(
    page: Path, workspace: Path, shell: Shell, request: pytest.FixtureRequest
) -> None:
    blocks = blocks_of(page)
    if any(line in (DEMO, "make demo") for block in blocks for line in block.commands()):
        # The command has nothing left to do: the same is not calibrated for every page.
        shutil.copytree(request.getfixturevalue("demo")[0], workspace / "demo")
    for block in blocks:
        run_block(block, workspace, shell)


@pytest.mark.long
def test_pages_show_what_the_demo_prints(demo: tuple[Path, str]) -> None:
    """All words and lines; numbers may differ in their last digits from machine to machine.

    The page of the reference shows all of it, the first page the lines on the maps to use.
    """

    def words(text: str) -> list[list[str]]:
        return [re.sub(r"-?\d[\d.]*(e-\d+)?", "#", line).split() for line in text.splitlines()]

    (command,) = re.findall(r"^demo:.*\n\t\$\(BIN\)/(.*)$", (ROOT / "Makefile").read_text(), re.M)
    assert command == DEMO
    page = ROOT / "docs/reference/terminal-output.md"
    (whole,), (first,) = (
        [b.text for b in blocks_of(p) if b.language == "text"] for p in (page, ROOT / "README.md")
    )
    assert words(demo[1].strip()) == words(whole)
    assert first in whole


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
def test_a_page_is_read_in_a_few_minutes(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert sum(any(c.isalpha() for c in word) for word in text.split()) < 900


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
