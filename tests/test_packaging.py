"""What is packed for others: the wheel, the sdist, the citation."""

import tarfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest
import yaml
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

import pixcal

ROOT = Path(__file__).parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    (path,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("wheel")))
    return Path(path)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    (path,) = SdistBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("sdist")))
    return Path(path)


def names_in(folder: Path, *patterns: str) -> set[str]:
    """Files below a folder, by their names from there on."""
    found = [path for pattern in patterns for path in folder.rglob(pattern) if path.is_file()]
    return {path.relative_to(folder).as_posix() for path in found}


def test_the_wheel_holds_the_packages_their_types_and_the_sample(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    expected = names_in(ROOT / "pipeline", "*.py", "*.pyi", "*.j2", "*.css", "py.typed")
    expected |= names_in(ROOT / "cli", "*.py", "py.typed")
    expected |= names_in(ROOT / "bench", "*.py")
    expected |= {f"pixcal/samples/{name}" for name in names_in(ROOT / "data_samples", "*")}
    rest = {name for name in packed if ".dist-info/" not in name}
    assert rest == expected
    assert "pixcal/samples/demo/acquisition.yaml" in rest
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in packed)


def test_the_wheel_installs_the_command(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (file,) = [name for name in archive.namelist() if name.endswith("entry_points.txt")]
        text = archive.read(file).decode()
    assert text.split() == ["[console_scripts]", "pixcal", "=", "pixcal_cli.__main__:main"]


def test_a_wheel_can_be_built_from_the_sources(wheel: Path, sources: Path, tmp_path: Path) -> None:
    with tarfile.open(sources) as archive:
        # Before 3.11.4 there is none.
        safe: dict[str, Any] = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
        archive.extractall(tmp_path, **safe)
    (folder,) = tmp_path.iterdir()
    (again,) = WheelBuilder(str(folder)).build(directory=str(tmp_path / "again"))
    with zipfile.ZipFile(again) as second, zipfile.ZipFile(wheel) as first:
        assert second.namelist() == first.namelist()
        assert [f.CRC for f in second.infolist()] == [f.CRC for f in first.infolist()]
    # Who has the sources can test, build the documentation and cite.
    for name in ("Makefile", "mkdocs.yml", "CITATION.cff", "LICENSE", "tests/bench.yaml"):
        assert (folder / name).is_file()


def test_the_citation_is_that_of_this_version() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = PROJECT["project"]
    assert cited["version"] == project["version"] == pixcal.__version__
    assert cited["license"] == project["license"]
    assert cited["authors"] == project["authors"]
    assert cited["keywords"] == project["keywords"]
    assert {"cff-version", "message", "title"} <= cited.keys()


def test_the_changelog_has_a_section_for_this_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"## {pixcal.__version__} " in text
