"""Where compiled kernels are kept: beside the code or with the user, else as long as the process.

Numba takes the first of the two that can be written, and refuses to import a kernel when there is
none: pixcal installed read-only for a user without a home could do nothing.
"""

import atexit
import shutil
import tempfile

import numba


def _probe() -> None:
    """Never called: only where it would be kept matters."""


def settle() -> None:
    """Give Numba a folder when it finds none."""
    try:
        numba.njit(cache=True)(_probe)
    except RuntimeError:
        # Of this process alone: what others could write there would be run.
        numba.config.CACHE_DIR = tempfile.mkdtemp(prefix="pixcal-")
        atexit.register(shutil.rmtree, numba.config.CACHE_DIR, ignore_errors=True)
