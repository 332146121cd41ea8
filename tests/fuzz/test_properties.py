"""What is said holds for any header, any value at any key, any text of an option, any time."""

import gzip
import json
import math
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st

from pixcal.model.acquisition import Acquisition, load_acquisition
from pixcal.model.bench import Bench, load_bench
from pixcal.model.config import parse, to_plain
from pixcal.model.errors import InputError
from pixcal.storage.fits_in import inspect
from pixcal.storage.frame_file import FrameFile, SampleFormat
from pixcal.storage.frames import tabulate
from pixcal.storage.header_values import FIRST_MJD, LAST_MJD
from pixcal.storage.sources import SourceFile
from pixcal_cli.click_options import memory_size, region
from pixcal_cli.main import one_line

ROOT = Path(__file__).parents[2]
BLOCK = 2880


def check_line(error: InputError, begin: str, *names: str) -> None:
    """A refusal is one line that begins with the file and names one of some keys."""
    message = str(error)
    assert message.startswith(begin)
    assert len(message.splitlines()) == 1
    assert len(message) < 1200
    assert not names or any(name in message for name in names)


# Headers

KEYS = st.sampled_from(
    [
        "BITPIX",
        "NAXIS",
        "NAXIS1",
        "NAXIS2",
        "NAXIS3",
        "BSCALE",
        "BZERO",
        "BLANK",
        "EXPTIME",
        "MJD-OBS",
        "DATE-OBS",
        "TIME-OBS",
        "CCD-TEMP",
        "PCOUNT",
        "GCOUNT",
        "EXTEND",
    ]
)
printable = st.characters(min_codepoint=32, max_codepoint=126)
values = st.one_of(
    st.integers().map(str),
    st.floats().map(lambda x: repr(x).upper()),
    st.text(printable, max_size=70),
    st.text(printable, max_size=60).map(lambda text: f"'{text}'"),
    st.sampled_from(["T", "F", ""]),
)


@settings(max_examples=300)
@given(cards=st.lists(st.tuples(KEYS, values), max_size=4), trailing=st.binary(max_size=40))
def test_any_header_is_read_or_refused(
    cards: list[tuple[str, str]], trailing: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    head = {"SIMPLE": "T", "BITPIX": "16", "NAXIS": "2", "NAXIS1": "5", "NAXIS2": "7"}
    head |= dict(cards)
    text = "".join(f"{key:8}= {value:>20}"[:80].ljust(80) for key, value in head.items())
    raw = (text + "END".ljust(80)).ljust(BLOCK).encode("ascii")
    raw += bytes(BLOCK) + trailing
    file = tmp_path_factory.mktemp("fits") / "a.fits"
    file.write_bytes(raw)
    facts = file.stat()
    try:
        found = inspect(SourceFile(file, "a.fits", facts.st_size, facts.st_mtime_ns))
    except InputError as error:
        check_line(error, f"{file}: ")
        return
    assert found.offset + found.data_bytes <= len(raw)
    for number in (found.mjd, found.exptime_s, found.temperature_c):
        assert number is None or math.isfinite(number)


@pytest.mark.parametrize("extra", [b"", bytes(100), bytes(3 * BLOCK), b" " * BLOCK])
def test_fill_after_an_image_is_no_data(extra: bytes, tmp_path: Path) -> None:
    file = tmp_path / "a.fits"
    fits.PrimaryHDU(np.arange(35, dtype="i2").reshape(7, 5)).writeto(file)
    file.write_bytes(file.read_bytes() + extra)
    facts = file.stat()
    assert inspect(SourceFile(file, "a", facts.st_size, facts.st_mtime_ns)).shape == (1, 7, 5)


@pytest.mark.parametrize(("key", "there", "lie"), [("BITPIX", 16, 8), ("NAXIS2", 97, 40)])
@pytest.mark.parametrize("packed", [False, True])
def test_a_header_that_calls_for_too_little_is_refused(
    key: str, there: int, lie: int, packed: bool, tmp_path: Path
) -> None:
    file = tmp_path / "a.fits"
    fits.PrimaryHDU(np.arange(97 * 53, dtype="i2").reshape(97, 53)).writeto(file)
    raw = file.read_bytes()
    old = b"%-8s= %20d" % (key.encode(), there)
    assert old in raw
    raw = raw.replace(old, b"%-8s= %20d" % (key.encode(), lie))
    file.write_bytes(gzip.compress(raw) if packed else raw)
    facts = file.stat()
    with pytest.raises(InputError, match="the file holds more"):
        inspect(SourceFile(file, "a", facts.st_size, facts.st_mtime_ns))


def test_a_table_that_leads_back_to_itself_is_refused(tmp_path: Path) -> None:
    primary = "SIMPLE  =                    T", "BITPIX  = 8", "NAXIS   = 0", "END"
    table = "XTENSION= 'BINTABLE'", "BITPIX  = 8", "NAXIS   = 2", "NAXIS1  = 0", "NAXIS2  = 0"
    own = (*table, f"PCOUNT  = {-BLOCK}", "GCOUNT  = 1", "END")
    units = ("".join(f"{card:80}" for card in unit).ljust(BLOCK) for unit in (primary, own))
    file = tmp_path / "a.fits"
    file.write_bytes("".join(units).encode())
    with pytest.raises(InputError, match="PCOUNT is negative"):
        inspect(SourceFile(file, "a", file.stat().st_size, file.stat().st_mtime_ns))


# Configuration

junk = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=8,
)


@cache
def plain(cls: type) -> Any:
    if cls is Acquisition:
        return to_plain(load_acquisition(ROOT / "data_samples" / "demo"))
    return to_plain(load_bench(ROOT / "tests" / "bench.yaml"))


def places(data: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if not isinstance(data, (dict, list)):
        return [at]
    items = data.items() if isinstance(data, dict) else enumerate(data)
    inner = [place for key, value in items for place in places(value, (*at, key))]
    return [at, *inner] if at else inner


@pytest.mark.long
@pytest.mark.parametrize("cls", [Acquisition, Bench])
@settings(max_examples=200)
@given(data=st.data(), value=junk)
def test_any_value_at_any_key_is_read_or_refused_by_its_key(
    cls: type, data: st.DataObject, value: Any
) -> None:
    described = json.loads(json.dumps(plain(cls)))
    at = data.draw(st.sampled_from(places(described)))
    inner = described
    for key in at[:-1]:
        inner = inner[key]
    inner[at[-1]] = value
    try:
        config = parse(cls, described, "file.yaml")
    except InputError as error:
        check_line(error, "file.yaml: ", *(key for key in at if isinstance(key, str)))
        return
    json.dumps(to_plain(config), allow_nan=cls is Bench)  # effects are read later
    assert parse(cls, to_plain(config), "file.yaml") == config or cls is Bench


# Times and options

stamps = st.none() | st.floats(FIRST_MJD, LAST_MJD)


@given(
    times=st.lists(
        st.tuples(st.integers(1, 4), stamps, st.none() | st.floats(0, 1e300)),
        min_size=1,
        max_size=6,
    ),
    period=st.none() | st.floats(1e-9, 1e9),
)
def test_any_stamps_give_every_frame_a_finite_time(times: list[Any], period: float | None) -> None:
    files = [
        FrameFile(
            SourceFile(Path(f"{n}.fits"), f"{n}.fits", 1, 1),
            "plain",
            0,
            0,
            (planes, 7, 5),
            SampleFormat(16),
            mjd=mjd,
            exptime_s=exptime,
        )
        for n, (planes, mjd, exptime) in enumerate(times)
    ]
    frames, _ = tabulate("bias", files, period)
    assert len(frames) == sum(planes for planes, _, _ in times)
    assert all(math.isfinite(frame.time_s) for frame in frames)


@given(st.text(max_size=30))
def test_any_text_of_an_option_is_understood_or_refused(text: str) -> None:
    for reader in (memory_size, region):
        with suppress(click.BadParameter):
            reader(text)


@given(st.text())
def test_any_message_becomes_one_line_of_a_terminal(text: str) -> None:
    assert one_line(text).isprintable()


def test_a_long_value_is_cut_in_its_middle() -> None:
    line = one_line("--model " + "x" * 10_000 + ": unknown")
    assert line.startswith("--model xxx")
    assert line.endswith("x: unknown")
    assert len(line) < 400
