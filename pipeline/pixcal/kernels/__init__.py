"""Pure array mathematics: no files, no configuration, no scheduling.

Numba keeps compiled kernels beside the code or with the user, and refuses to import a kernel where
neither can be written: they are then kept as long as the process lives.
"""

import atexit
import shutil
import tempfile
from collections.abc import Callable
from typing import Any

import numba


def _probe() -> None:
    """Never called: only where it would be kept matters."""


try:
    numba.njit(cache=True)(_probe)
except RuntimeError:
    # Of this process alone: what others could write there would be run.
    numba.config.CACHE_DIR = tempfile.mkdtemp(prefix="pixcal-")
    atexit.register(shutil.rmtree, numba.config.CACHE_DIR, ignore_errors=True)


Decorator = Callable[[Callable[..., Any]], Any]


def kernel(**options: Any) -> Decorator:
    """Compile a function, and keep it; other threads run while it does."""
    decorate: Decorator = numba.njit(cache=True, nogil=True, no_cfunc_wrapper=True, **options)
    return decorate


def inner(**options: Any) -> Decorator:
    """Compile a function that only kernels call, as a part of them.

    It is neither cached nor callable from Python by itself; compiling large kernels takes a tenth
    less time so.
    """
    decorate: Decorator = numba.njit(
        nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options
    )
    return decorate
