"""Pure array mathematics: no files, no configuration, no scheduling.

Numba caches compiled kernels next to the code or in the user's cache, and refuses to import a
kernel if neither is writable: the cache then lasts as long as the process.
"""

import atexit
import shutil
import tempfile
from collections.abc import Callable
from typing import Any

import numba


def _probe() -> None:
    """Never called; it shows where the cache of compiled kernels can be written."""


try:
    numba.njit(cache=True)(_probe)
except RuntimeError:
    # Private to this process, because code that others could write there would be run.
    numba.config.CACHE_DIR = tempfile.mkdtemp(prefix="pixcal-")
    atexit.register(shutil.rmtree, numba.config.CACHE_DIR, ignore_errors=True)


Decorator = Callable[[Callable[..., Any]], Any]


def kernel(**options: Any) -> Decorator:
    """Compile a function, and cache it; it releases the interpreter lock."""
    decorate: Decorator = numba.njit(cache=True, nogil=True, no_cfunc_wrapper=True, **options)
    return decorate


def inner(**options: Any) -> Decorator:
    """Compile a function that only kernels call, as a part of them.

    It is neither cached separately nor callable from Python, which saves a tenth of the compiling
    time of large kernels.
    """
    decorate: Decorator = numba.njit(
        nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options
    )
    return decorate
