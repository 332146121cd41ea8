"""The globs of an acquisition: every mistake is named by its key and file."""

import os
from pathlib import Path

import pytest

from pixcal.model.acquisition import Frames, FringeScan
from pixcal.model.errors import InputError
from pixcal.storage.sources import SourceFile, find_sources, fingerprint


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("bias/a.fits", "bias/b.fits", "flat/ü 1.fits", "v/f1.fits", "v/f2.fits"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(name)
    return tmp_path


def find(folder: Path, **kinds: tuple[str, ...]) -> dict[str, list[str]]:
    fringes = (FringeScan("v", kinds.pop("v"), (6.0, 0.0)),) if "v" in kinds else ()
    found = find_sources(Frames(**kinds, fringes=fringes), folder / "acquisition.yaml")
    return {array: [s.name for s in sources] for array, sources in found.items()}


def test_arrays_and_their_files(folder: Path) -> None:
    (folder / "bias/._a.fits").write_text("left by another system")
    (folder / "bias/old.fits").mkdir()
    twice = ("v/f2*", "v/*", "./v/f1.fits")
    assert find(folder, bias=("bias/*.fits",), flat=("**/ü*",), v=twice) == {
        "bias": ["bias/a.fits", "bias/b.fits"],
        "flat": ["flat/ü 1.fits"],
        "fringes/v": ["v/f1.fits", "v/f2.fits"],
    }


def test_link_to_a_file_elsewhere_is_followed(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "disk.data").write_text("x")
    (folder / "dark").mkdir()
    (folder / "dark/a.fits").symlink_to(tmp_path / "disk.data")
    assert find(folder, dark=("dark/*",)) == {"dark": ["dark/a.fits"]}


@pytest.mark.parametrize(
    ("kinds", "words"),
    [
        ({"bias": ("../*.fits",)}, ["frames.bias[0]", "'../*.fits'", "leaves the folder"]),
        ({"bias": ("bias/*", "x/../*")}, ["frames.bias[1]", "'x/../*'"]),
        ({"bias": ("/etc/*",)}, ["bias[0]", "'/etc/*'", "relative"]),
        ({"v": ("v/*.fit",)}, ["frames.fringes[0].files[0]", "'v/*.fit'", "matches no file"]),
        ({"bias": ("bias/*",), "dark": ("*/a.fits",)}, ["bias/a.fits", "frames.dark", "twice"]),
        ({"flat": ("v/f1*",), "v": ("v/*",)}, ["v/f1.fits", "frames.flat", "frames.fringes[0]"]),
    ],
)
def test_bad_globs(folder: Path, kinds: dict[str, tuple[str, ...]], words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        find(folder, **kinds)
    for word in words:
        assert word in str(caught.value)


def test_bad_files(folder: Path) -> None:
    (folder / "bias/c.fits").touch()
    with pytest.raises(InputError, match=r"bias/c\.fits: empty \(0 bytes\); copy it again"):
        find(folder, bias=("bias/*",))
    (folder / "bias/c.fits").unlink()
    (folder / "bias/c.fits").symlink_to(folder / "gone")
    with pytest.raises(InputError, match=r"bias/c\.fits: cannot be read"):
        find(folder, bias=("bias/*",))
    (folder / "bias/c.fits").unlink()
    os.link(folder / "bias/a.fits", folder / "bias/c.fits")
    with pytest.raises(InputError, match=r"bias/c\.fits: the file is listed twice.*bias/a\.fits"):
        find(folder, bias=("bias/*",))
    (folder / "bias/c.fits").unlink()
    os.mkfifo(folder / "bias/c.fits")
    with pytest.raises(InputError, match=r"bias/c\.fits: not a regular file"):
        find(folder, bias=("bias/*",))


def test_fingerprint_tells_names_sizes_and_times() -> None:
    one = SourceFile(Path("/x/a"), "a", 10, 20)
    same = SourceFile(Path("/elsewhere/a"), "a", 10, 20)
    assert fingerprint([one]) == fingerprint([same])
    others = [
        SourceFile(one.path, "b", 10, 20),
        SourceFile(one.path, "a", 11, 20),
        SourceFile(one.path, "a", 10, 21),
    ]
    digests = {fingerprint([s]) for s in [one, *others]} | {fingerprint([one, one])}
    assert len(digests) == 5
