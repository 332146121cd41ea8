"""FITS files that are damaged or have false headers: ingest is compared with astropy."""

import gzip
import io
import json
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from fuzzing.laws import RUNTIME, Broken, Case, Kind, describe_calibration, pixcal

CARD, BLOCK = 80, 2880
WHOLE = (0, 1, -1, 2, 3, 5, 7, 8, 16, 24, 32, 64, -32, -64, 255, 999, 65536, 2**31, 2**63, 10**18)
NUMBERS = (0.0, -1.0, 1e-300, 1e38, 1e300, 1e400, -1e308, 32768.0, 0.5, 1e-45)
WORDS = ("'abc'", "''", "T", "F", "NaN", "Inf", "-", "1.2.3", "(1,2)", "'it''s", "/", "1 / 2 / 3")
KEYS = (
    "SIMPLE",
    "BITPIX",
    "NAXIS",
    "NAXIS1",
    "NAXIS2",
    "NAXIS3",
    "EXTEND",
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
    "XTENSION",
    "ZIMAGE",
    "ZBITPIX",
    "ZNAXIS",
    "ZNAXIS1",
    "ZNAXIS2",
    "ZTILE1",
    "ZTILE2",
    "ZCMPTYPE",
    "ZSCALE",
    "ZZERO",
    "ZBLANK",
    "TFIELDS",
    "TFORM1",
    "TTYPE1",
    "END",
    "COMMENT",
    "CONTINUE",
    "HIERARCH a b",
    "OBJECT",
)
DATES = (
    "'2026-01-01T00:00:00'",
    "'0001-01-01T00:00:00'",
    "'9999-12-31T23:59:60'",
    "'2026-13-01'",
    "'2026-01-01T00:00:00+14:00'",
    "'10000-01-01T00:00:00'",
    "'31/12/99'",
    "'2026-001T00'",
    "'T'",
    "'2026-01-01T'",
    "1e300",
    "-1e300",
    "'２０２６-01-01T00:00:00'",
)


def _samples(case: Case) -> NDArray[Any]:
    dtype = np.dtype(str(case.pick("uint16", "int16", "uint8", "int32", "float32")))
    shape = tuple(int(n) for n in case.rng.integers(3, 60, 2))
    if case.rng.random() < 0.5:
        shape = (int(case.rng.integers(1, 6)), *shape)
    return np.asarray(case.rng.integers(0, 250, shape)).astype(dtype)


def _file(case: Case) -> bytes:
    """A good file: plain, gzipped, in tiles, or in an extension."""
    data, out = _samples(case), io.BytesIO()
    what = str(case.pick("plain", "plain", "plain", "gzip", "tiles", "extension"))
    if what == "tiles":
        options: dict[str, Any] = {"compression_type": "GZIP_1"}
        if data.dtype.kind == "f":
            options["quantize_level"] = 0
        hdu: Any = fits.CompImageHDU(data, **options)
    else:
        hdu = fits.ImageHDU(data) if what == "extension" else fits.PrimaryHDU(data)
    hdu.header["EXPTIME"] = 0.02
    hdu.header["DATE-OBS"] = "2026-01-01T00:00:00"
    hdus = [hdu] if what in ("plain", "gzip") else [fits.PrimaryHDU(), hdu]
    fits.HDUList(hdus).writeto(out)
    content = out.getvalue()
    return gzip.compress(content, 1) if what == "gzip" else content


def _unpacked(content: bytes) -> tuple[bytes, bool]:
    packed = content[:2] == b"\x1f\x8b"
    return (gzip.decompress(content) if packed else content), packed


def _value(case: Case, key: str) -> str:
    if key in ("DATE-OBS", "TIME-OBS", "MJD-OBS") and case.rng.random() < 0.7:
        return str(case.pick(*DATES))
    pools = (WHOLE, NUMBERS, WORDS)
    return str(case.pick(*pools[int(case.rng.integers(3))]))


def _cards(case: Case, content: bytes) -> bytes:
    """Cards changed, removed, doubled, added, or random, in the header of some unit."""
    plain, packed = _unpacked(content)
    text = bytearray(plain)
    starts = [m.start() for m in re.finditer(rb"(SIMPLE  |XTENSION)= ", plain)]
    start = starts[int(case.rng.integers(len(starts)))]
    end = start
    while plain[end : end + 8] != b"END     ":
        end += CARD
    for _ in range(int(case.rng.integers(1, 4))):
        at = start + CARD * int(case.rng.integers((end - start) // CARD))
        key = str(case.pick(*KEYS))
        there = [n for n in range(start, end, CARD) if plain[n : n + 8] == f"{key:8.8}".encode()]
        if there and case.rng.random() < 0.9:
            at = there[0]
        kind = str(case.pick("value", "value", "value", "value", "remove", "double", "rubbish"))
        if kind == "remove":
            card = b" " * CARD
        elif kind == "double":
            other = start + CARD * int(case.rng.integers((end - start) // CARD))
            card = bytes(plain[other : other + CARD])
        elif kind == "rubbish":
            card = case.rng.integers(0, 256, CARD).astype(np.uint8).tobytes()
        else:
            card = f"{key:8.8}= {_value(case, key):>20}".encode().ljust(CARD)[:CARD]
        text[at : at + CARD] = card
    return gzip.compress(bytes(text), 1) if packed else bytes(text)


def _lie(case: Case, content: bytes) -> bytes:
    """A BITPIX, NAXIS or length that disagrees with the data."""
    plain, packed = _unpacked(content)
    found = list(re.finditer(rb"(Z?BITPIX|Z?NAXIS\d?|PCOUNT|GCOUNT) *= +(-?\d+)", plain))
    one = found[int(case.rng.integers(len(found)))]
    old = int(one[2])
    new = case.pick(*WHOLE, old + 1, old - 1, 2 * old, old // 2, 10 * old)
    card = b"%-8s= %20d" % (one[1], int(str(new)))
    text = plain[: one.start()] + card[:30] + plain[one.start() + 30 :]
    return gzip.compress(text, 1) if packed else text


def _length(case: Case, content: bytes) -> bytes:
    """Cut anywhere, or with something after the end; empty now and then."""
    if case.rng.random() < 0.6:
        return content[: int(case.rng.integers(len(content) + 1))]
    tail = case.rng.integers(0, 256, int(10 ** case.rng.uniform(0, 5))).astype(np.uint8).tobytes()
    return content + bytes(case.pick(tail, bytes(len(tail)), content, b"XTENSION" + tail))


def _flipped(case: Case, content: bytes) -> bytes:
    """Some bytes changed, anywhere."""
    text = bytearray(content)
    for at in case.rng.integers(0, len(text), int(10 ** case.rng.uniform(0, 2))):
        text[at] = int(case.rng.integers(256))
    return bytes(text)


def _rubbish(case: Case, _content: bytes) -> bytes:
    """No FITS file at all, or one that only begins so."""
    rubbish = case.rng.integers(0, 256, int(10 ** case.rng.uniform(0, 5))).astype(np.uint8)
    head = case.pick(b"", b"\x1f\x8b", b"SIMPLE  =                    T", b"SIMPLE", b"\x89PNG")
    return bytes(head) + rubbish.tobytes()


def _bomb(case: Case, _content: bytes) -> bytes:
    """Headers that announce far more data than present, and streams that unpack to far more."""
    bitpix = int(str(case.pick(8, 16, -32, 32)))
    lengths = case.rng.integers(1, 10, 3)
    lengths[int(case.rng.integers(3))] = int(10 ** case.rng.uniform(4, 15))
    extension = case.rng.random() < 0.3
    cards = [
        "SIMPLE  =                    T",
        "BITPIX  =                    8",
        "NAXIS   = 0",
        "END",
    ]
    head = "".join(f"{c:80}" for c in cards).ljust(BLOCK) if extension else ""
    first = "XTENSION= 'BINTABLE'" if extension else cards[0]
    own = [first, f"BITPIX  = {bitpix:20d}", f"NAXIS   = {3:20d}"]
    own += [f"NAXIS{n + 1}  = {int(m):20d}" for n, m in enumerate(lengths)]
    own += [f"PCOUNT  = {int(str(case.pick(0, -BLOCK, 10**15))):20d}", "GCOUNT  = 1", "END"]
    body = "".join(f"{c:80}" for c in own)
    content = (head + body.ljust(-(-len(body) // BLOCK) * BLOCK)).encode()
    zeros = bytes(int(case.pick(0, 3 * BLOCK, 8 << 20)))
    packed = case.rng.random() < 0.5
    return gzip.compress(content + zeros, 1) if packed else content + zeros[: 3 * BLOCK]


def _ingested(case: Case, spoil: Any) -> None:
    """One bad file, ingested alone or with a good one of the same kind."""
    content = _file(case)
    acq, run = case.folder / "acq", case.folder / "run"
    acq.mkdir()
    (acq / "a.fits").write_bytes(spoil(case, content))
    beside = case.rng.random() < 0.3
    if beside:
        (acq / "b.fits").write_bytes(content)
    describe_calibration(acq, bias=["*.fits"])
    pixcal("ingest", acq, "--out", run, *RUNTIME, names=["a.fits", "b.fits"])
    if spoil is not _bomb:  # which are too much for astropy
        _check(acq, run)
    pixcal("reduce", run, *RUNTIME, names=[str(run)])


def _check(acq: Path, run: Path) -> None:
    """Compare the ingested frames with those that astropy reads."""
    from pixcal.stages.reduce.ingested import Ingested

    source = Ingested(run / "ingest")
    reader, used = source.arrays["bias"], source.tables["bias"]
    table = json.loads((run / "ingest" / "frames.json").read_text())["bias"]
    for column in ("mjd", "exptime_s", "temperature_c", "time_s"):
        if not all(v is None or np.isfinite(v) for v in table[column]):
            raise Broken(f"{column} is not finite")
    if np.any(np.diff(table["time_s"]) < 0) and not _warned(run):
        raise Broken("frames are not in the order of time")
    frames = reader.read()
    # Without frames that repeat another one, as those of an equal file beside it.
    for frame, name, plane in zip(frames, used["file"], used["plane"], strict=True):
        theirs = _astropy(acq / name)
        if theirs is None:
            continue  # astropy gives up on some headers that are clear enough
        planes = theirs.reshape(-1, *theirs.shape[-2:])
        with np.errstate(over="ignore", invalid="ignore"):
            same = np.asarray(planes[plane]).astype(frames.dtype)
        if same.shape != frame.shape or not np.array_equal(same, frame, equal_nan=True):
            raise Broken(f"{name}: plane {plane} is not what astropy reads")


def _warned(run: Path) -> bool:
    manifest = json.loads((run / "ingest" / "manifest.json").read_text())
    return bool(manifest["summary"]["warnings"])


def _astropy(path: Path) -> NDArray[Any] | None:
    try:
        with warnings.catch_warnings(), fits.open(path, memmap=False) as hdus:
            warnings.simplefilter("ignore")
            for hdu in hdus:
                if hdu.is_image and hdu.data is not None and hdu.data.size:
                    return np.asarray(hdu.data)
    except Exception:
        return None
    return None


def _kind(name: str, title: str, spoil: Any, cases: int = 400) -> Kind:
    return Kind(name, title, lambda case: _ingested(case, spoil), cases)


KINDS = [
    _kind("cards", "FITS headers: cards missing, repeated, contradictory, garbage", _cards),
    _kind("lies", "FITS headers: wrong BITPIX, NAXIS, size", _lie),
    _kind("length", "FITS files truncated or extended", _length),
    _kind("flipped", "FITS files with changed bytes", _flipped),
    _kind("rubbish", "files other than FITS", _rubbish),
    _kind("bombs", "FITS headers and gzip streams that announce too much data", _bomb, 200),
]
