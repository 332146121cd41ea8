"""The site builds without a warning and shows what the pages say; where `make docs` was run."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import pytest

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack
from pixcal.kernels.beams import Light, LightMaps
from pixcal.kernels.scene import DetectorMaps, FrameStates
from pixcal.simulation.recording import Recording

for library in ("mkdocs", "material", "mkdocstrings_handlers.python", "latex2mathml"):
    pytest.importorskip(library, reason="the group 'docs' is not installed")

HOLD = (Evidence, FringeEvidence, Stack, Recording, DetectorMaps, FrameStates, Light, LightMaps)
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    found = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    return folder


def test_formulas_are_drawn_by_the_browser(site: Path) -> None:
    text = (site / "explanation/mathematics.html").read_text(encoding="utf-8")
    assert text.count("<math") > 20
    assert "arithmatex" not in text


def test_the_reference_holds_the_docstrings(site: Path) -> None:
    text = (site / "reference/python.html").read_text(encoding="utf-8")
    for name in ("calibrate", "open_run", "delta_x", "baselines_mm", "sample_acquisition"):
        assert name in text


def test_the_reference_says_what_evidence_frames_and_maps_hold(site: Path) -> None:
    text = (site / "reference/python.html").read_text(encoding="utf-8")
    for shown in HOLD:
        for field in dataclasses.fields(shown):
            name = f"{shown.__module__}.{shown.__name__}.{field.name}"
            assert field.name.startswith("_") or f'id="{name}"' in text, name
    assert "variance of a sample" in text


def test_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe)[^>]* src="?([^" >]+)', text)
        loaded += re.findall(r'<link[^>]* rel="stylesheet"[^>]* href="?([^" >]+)', text)
        assert not [name for name in loaded if "://" in name], page.name


def test_links_inside_the_site_lead_somewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        if page.name == "404.html":
            continue
        links = re.findall(r'<a [^>]*href="([^"#:]+)[#"]', page.read_text(encoding="utf-8"))
        for link in set(links):
            assert (page.parent / link).exists(), f"{page.name}: {link}"
