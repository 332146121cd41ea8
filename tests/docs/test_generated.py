"""What is generated in the documentation is up to date, and the site holds all pages."""

import re
from pathlib import Path

import pytest
import yaml

from doc_pages import DOCS, FILES, LAYERS, TABLES, commands_of, filled
from documentation.layers import PACKAGES, picture
from documentation.stub import STUB, stub

ROOT = Path(__file__).parents[2]
PAGES = sorted(DOCS.rglob("*.md"))
SITE = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_generated_blocks_are_up_to_date(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert text.count("<!-- file:") == len(FILES.findall(text))
    assert text.count("<!-- keys:") == len(TABLES.findall(text))
    assert filled(text) == text, "run 'make doc-pages'"


def test_the_pages_of_commands_show_each_of_them_once() -> None:
    pages = sorted((DOCS / "reference").glob("commands*.md"))
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    assert sorted(re.findall(r"^## (pixcal .+)$", text, re.MULTILINE)) == sorted(commands_of())
    assert "Usage: pixcal run [OPTIONS] ACQ" in text


def test_the_picture_of_the_layers_is_up_to_date() -> None:
    assert LAYERS.read_text(encoding="utf-8") == picture(), "run 'make doc-pages'"


def test_type_checkers_are_told_the_options_that_there_are() -> None:
    assert STUB.read_text(encoding="utf-8") == stub(), "run 'make doc-pages'"


def closure(edges: set[tuple[str, str]]) -> set[tuple[str, str]]:
    while more := {(a, d) for a, b in edges for c, d in edges if b == c} - edges:
        edges = edges | more
    return edges


def test_the_picture_of_the_layers_is_true() -> None:
    """Its arrows, followed on, lead to all that is imported, and each arrow is an import."""
    drawn = set(
        re.findall(r'data-from="(\w+)" data-to="(\w+)"', LAYERS.read_text(encoding="utf-8"))
    )
    imported = set()
    for package, folder in PACKAGES.items():
        for file in folder.rglob("*.py"):
            first = file.relative_to(folder).parts[0]
            whole = package != "pixcal"
            own = package if whole else first
            if (folder / first).is_dir() or whole:
                text = file.read_text(encoding="utf-8")
                found = re.findall(r"^\s*(?:from|import) pixcal\.(\w+)", text, re.MULTILINE)
                found += re.findall(r"^\s*from pixcal import (\w+)$", text, re.MULTILINE)
                found += re.findall(r"^\s*(?:from|import) (blind_examination)", text, re.MULTILINE)
                imported |= {(own, other) for other in found if other != own}
    imported = {(a, b) for a, b in imported if b in PACKAGES or (PACKAGES["pixcal"] / b).is_dir()}
    assert drawn <= imported
    assert closure(drawn) == closure(imported)
    boxes = set(re.findall(r">(\w+)</text>", LAYERS.read_text(encoding="utf-8")))
    assert boxes == {name for edge in imported for name in edge}


def pages_of(nav: object) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav
    return [page for part in parts for page in pages_of(part)]  # type: ignore[attr-defined]


def test_every_page_is_in_the_navigation_once() -> None:
    listed = pages_of(SITE["nav"])
    there = {page.relative_to(DOCS).as_posix() for page in PAGES}
    # The table of effects links to their pages.
    there -= {page for page in there if page.startswith(SITE["not_in_nav"].strip())}
    assert sorted(listed) == sorted(set(listed)), "a page is listed twice"
    assert set(listed) == there, "mkdocs.yml: nav and docs/ differ"


def test_the_site_needs_no_network() -> None:
    """No fonts and scripts of others; it opens from a folder."""
    assert SITE["theme"]["font"] is False
    assert SITE["use_directory_urls"] is False
    assert not [script for script in SITE.get("extra_javascript", []) if "://" in str(script)]
