"""Errors that a user can mend: one line that names the file, the key or the option."""

from collections.abc import Iterator
from contextlib import contextmanager


class PixcalError(Exception):
    """Anything that the command line reports without a traceback."""


class InputError(PixcalError):
    """A file, key or option is wrong; the message says which and what mends it (exit code 2)."""


class DamagedError(InputError):
    """Something that pixcal wrote is missing or altered, and what ``message`` says of ``path``.

    ``advice`` is how to repair it; code that knows the run gives the exact command.
    """

    def __init__(self, message: str, path: object = "") -> None:
        super().__init__(message)
        self.path = str(path)
        self.advice = "run the command that wrote it again"

    def __str__(self) -> str:
        return f"{self.args[0]}; {self.advice}"


@contextmanager
def naming(place: str) -> Iterator[None]:
    """Name the place of an error of the input; what is damaged has a name already."""
    try:
        yield
    except DamagedError:
        raise
    except InputError as error:
        raise InputError(f"{place}: {error}") from error


class PlanError(InputError):
    """The work does not fit the memory allowed; the message holds both numbers."""


class RemoteError(InputError):
    """A place at a URL cannot be used, or not now; what was written there is not in doubt."""


class ClusterError(PixcalError):
    """Workers or their scheduler were lost; what was done is kept (exit code 1)."""
