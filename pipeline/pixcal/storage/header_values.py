"""Facts in FITS headers: numbers, exposure time, temperature, time stamp.

Descriptive values may be missing or in any format, and are then None. Missing values that are
needed to read the data (`integer`) are an error.
"""

import math
import re
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from typing import Any

from astropy.io import fits

FIRST_MJD, LAST_MJD = -678_575, 2_973_482  # days of the years 1 to 9999
_MJD_EPOCH = datetime(1858, 11, 17, tzinfo=UTC)
DAY_S = 86400.0

_CARD = 80  # characters
_SMALL = {"m": 1e-3, "milli": 1e-3, "u": 1e-6, "micro": 1e-6}  # of a second
_UNIT = re.compile(r"\b(m|milli|u|micro)?s(?:ecs?|econds?)?\b")


class Header:
    """Values and comments of a header by keyword; of a repeated keyword, the first."""

    def __init__(self, cards: Iterable[tuple[str, Any, str]]) -> None:
        self._cards: dict[str, tuple[Any, str]] = {}
        for keyword, entry, comment in cards:
            self._cards.setdefault(keyword, (entry, comment))

    @classmethod
    def of_text(cls, text: str) -> "Header":
        """From the cards of a file."""
        return cls(_card(text[n : n + _CARD]) for n in range(0, len(text), _CARD))

    def __contains__(self, key: str) -> bool:
        return key in self._cards

    def get(self, key: str, default: Any = None) -> Any:
        """Value of a key; VerifyError when its card does not parse."""
        entry = self._cards.get(key, (default, ""))[0]
        if isinstance(entry, fits.VerifyError):
            raise fits.VerifyError(*entry.args)
        return entry

    def comment(self, key: str) -> str:
        """Comment of a key."""
        return self._cards[key][1]


# Cached: most cards are equal in all files, and astropy takes a millisecond per header.
@lru_cache(maxsize=4096)
def _card(text: str) -> tuple[str, Any, str]:
    card = fits.Card.fromstring(text)
    try:
        entry = card.value
        return card.keyword, None if isinstance(entry, fits.card.Undefined) else entry, card.comment
    except fits.VerifyError as error:
        return card.keyword, error, ""


def integer(header: Header, key: str, default: int | None = None) -> int:
    """Whole number of a key; ValueError when it is something else."""
    entry = header.get(key, default)
    if isinstance(entry, bool) or not isinstance(entry, int):
        raise ValueError(
            f"header key {key} is missing or not a whole number; copy the file again, or remove it"
        )
    return entry


def value(header: Header, key: str, default: Any = None) -> Any:
    """Value of a key; None when its card does not parse."""
    try:
        return header.get(key, default)
    except fits.VerifyError:
        return None


def number(header: Header, key: str, default: float | None = None) -> float | None:
    """Finite number of a key; None when it is something else."""
    entry = value(header, key, default)
    try:
        result = math.nan if isinstance(entry, bool) else float(entry)
    except (ValueError, TypeError):
        return None
    return result if math.isfinite(result) else None


def _numbers(headers: tuple[Header, ...], *keys: str) -> Iterator[tuple[float, str]]:
    """Finite numbers of some keys, and their comments in lower case."""
    for key in keys:
        for header in headers:
            if (parsed := number(header, key)) is not None:
                yield parsed, header.comment(key).lower()


def exposure_s(headers: tuple[Header, ...]) -> float | None:
    """Exposure time (s) from EXPTIME, else EXPOSURE, converted if the comment has another unit."""
    for time, comment in _numbers(headers, "EXPTIME", "EXPOSURE"):
        if time >= 0:
            # The first unit counts: "seconds, to 1 ms" are seconds.
            unit = _UNIT.search(comment)
            return time * (_SMALL[unit[1]] if unit and unit[1] else 1.0)
    return None


def temperature_c(headers: tuple[Header, ...]) -> float | None:
    """Temperature in degrees Celsius, converted from kelvin if the comment says so."""
    keys = ("CCD-TEMP", "DET-TEMP", "TEMPERAT", "CCDTEMP", "TEMP")
    for degrees, comment in _numbers(headers, *keys):
        return degrees + -273.15 if "[k]" in comment or "kelvin" in comment else degrees
    return None


def time_stamp_mjd(headers: tuple[Header, ...]) -> float | None:
    """Time stamp from MJD-OBS if it is a date, else from DATE-OBS if it has the time of day."""
    for mjd, _ in _numbers(headers, "MJD-OBS"):
        if FIRST_MJD <= mjd <= LAST_MJD:
            return mjd
    for header in headers:
        text, clock = value(header, "DATE-OBS"), value(header, "TIME-OBS")
        if isinstance(text, str) and "T" not in text and isinstance(clock, str):
            text = f"{text}T{clock}"
        if isinstance(text, str) and "T" in text:
            try:
                moment = datetime.fromisoformat(text.strip())
            except ValueError:
                continue
            if moment.tzinfo is None:
                moment = moment.replace(tzinfo=UTC)
            return (moment - _MJD_EPOCH).total_seconds() / DAY_S
    return None


def date_of(mjd: float) -> str:
    """UTC date and time of a modified Julian date in ``DATE-OBS`` format, to the millisecond."""
    return (_MJD_EPOCH + timedelta(days=mjd)).isoformat("T", "milliseconds").partition("+")[0]
