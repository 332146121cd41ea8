"""Places of cubes: a local folder, or a folder at a URL that fsspec supports."""

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from pixcal.model.errors import InputError, PixcalError, RemoteError, reason_of
from pixcal.storage.memory import MemoryPath

# package to install for a protocol, if its name differs
_EXTRAS = {"s3": "pixcal[s3]", "s3a": "pixcal[s3]", "gs": "gcsfs", "gcs": "gcsfs", "az": "adlfs"}


@dataclass(frozen=True)
class UrlPath:
    """A file or folder at a URL, with the part of `pathlib.Path` that the reader of a cube needs.

    It holds only the URL, so that it can be sent anywhere; the process that opens it has the
    settings.
    """

    url: str  # such as `s3://bucket/prefix`, without a slash at its end

    def __str__(self) -> str:
        return self.url

    def __truediv__(self, name: str) -> "UrlPath":
        return UrlPath(f"{self.url}/{name}")

    @property
    def name(self) -> str:
        """Last part of the URL."""
        return self.url.rpartition("/")[2]

    @property
    def parent(self) -> "UrlPath":
        """The folder it is in."""
        return UrlPath(self.url.rpartition("/")[0])

    def filesystem(self) -> tuple[Any, str]:
        """File system of fsspec that the URL belongs to, and its path there."""
        # fsspec keeps its file systems, one for each thread and process that asks.
        from fsspec.core import url_to_fs  # here: cubes on this machine do not need it

        with explained(self.url):
            located: tuple[Any, str] = url_to_fs(self.url)
        return located

    def read_bytes(self, most: int | None = None) -> bytes:
        """Content of a file, ``most`` bytes of it; FileNotFoundError, or RemoteError if unknown."""
        system, path = self.filesystem()
        with explained(self.url):
            content: bytes = system.cat_file(path, start=None if most is None else 0, end=most)
        return content


Local = Path | MemoryPath  # a file or folder of this process or machine
Place = Local | UrlPath  # a file or folder, here or at a URL


@contextmanager
def explained(url: str) -> Iterator[None]:
    """Turn errors of a file-system driver into one line that names the URL.

    FileNotFoundError (with ``strerror``, ``filename``) if it does not exist; else RemoteError.
    """
    try:
        yield
    except (PixcalError, MemoryError):
        raise
    except FileNotFoundError as error:
        message = reason_of(error)
        # Some messages hold only the path, which the URL already gives.
        reason = message if " " in message else os.strerror(errno.ENOENT)
        raise FileNotFoundError(errno.ENOENT, reason, url) from error
    except ImportError as error:
        scheme = url.partition("://")[0]
        package = _EXTRAS.get(scheme, f"what fsspec needs for {scheme}")
        raise RemoteError(
            f"{url}: a package is missing ({error}); pip install '{package}'"
        ) from error
    except Exception as error:  # each driver has its own errors
        raise RemoteError(
            f"{url}: {reason_of(error):.300}; check the URL, the endpoint, the credentials "
            "(AWS_…, FSSPEC_…) and the network, and run again"
        ) from error


def parse_place(text: str) -> Place:
    """Parse a user's folder: a path, made absolute, or a URL without password."""
    scheme, is_url, rest = text.partition("://")
    if not is_url:
        if not text or re.match(r"[A-Za-z][A-Za-z0-9+.-]+:", text):
            raise InputError(f"--cubes {text!r}: not a folder; write a path or s3://bucket/prefix")
        return Path(os.path.abspath(text))  # noqa: PTH100 (resolve() would follow links)
    if scheme in ("file", "local"):
        if not rest.startswith("/"):
            raise InputError(f"--cubes {text}: not absolute; write {scheme}:///folder")
        return Path(os.path.abspath(rest))  # noqa: PTH100
    if not re.fullmatch(r"[a-z][a-z0-9+._-]*", scheme):
        raise InputError(f"--cubes {text}: {scheme!r} is not a protocol; write s3://bucket/prefix")
    if not rest.strip("/") or re.search(r"[\s*?\[\]#]", rest):
        raise InputError(
            f"--cubes {text}: no bucket or folder, or one with spaces, '*', '?', '#', '[' or ']'; "
            "write s3://bucket/prefix"
        )
    if "@" in urlsplit(text).netloc and ":" in urlsplit(text).netloc.partition("@")[0]:
        raise InputError(
            f"--cubes {scheme}://…: holds a password; put it into the environment or the "
            "configuration of fsspec"
        )
    return UrlPath(text.rstrip("/"))
