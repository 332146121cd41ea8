"""Errors that a user can correct: one line that names the file, the key or the option."""

from collections.abc import Iterator
from contextlib import contextmanager


class PixcalError(Exception):
    """Anything that the command line reports without a traceback."""


class InputError(PixcalError):
    """A file, key or option is wrong; the message names it and the remedy (exit code 2)."""


class DamagedError(InputError):
    """A file written by pixcal is missing or altered: ``path``, and ``what`` is wrong with it.

    ``advice`` is how to repair it; code that knows the run gives the exact command.
    """

    def __init__(self, path: object, what: str) -> None:
        super().__init__(str(path), what)
        self.path = str(path)
        self.advice = "run the command that wrote it again"

    def __str__(self) -> str:
        return f"{self.path}: {self.args[1]}; {self.advice}"


def reason_of(error: BaseException) -> str:
    """What an exception says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def naming(place: str) -> Iterator[None]:
    """Add the place to an input error; errors of damaged files already name it."""
    try:
        yield
    except DamagedError:
        raise
    except InputError as error:
        raise InputError(f"{place}: {error}") from error


class PlanError(InputError):
    """The work does not fit the allowed memory; the message has both numbers."""


class RemoteError(InputError):
    """A URL cannot be used, perhaps temporarily; data written there remain valid."""


class ClusterError(PixcalError):
    """Workers or their scheduler were lost; finished work is kept (exit code 1)."""
