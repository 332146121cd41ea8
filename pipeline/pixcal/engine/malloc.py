"""Settings of malloc to keep freed memory for the next task."""

import ctypes
import os
from contextlib import suppress

# From malloc.h, see mallopt(3): sizes (bytes) above which free memory is returned and arrays are
# mapped separately; number of arenas.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8

NANNY_THRESHOLD = "65536"  # MALLOC_TRIM_THRESHOLD_ that Dask's nanny sets for its workers


def keep_freed_memory() -> None:
    """Let glibc's malloc reuse buffers in a worker of a Dask nanny."""
    # The nanny sets MALLOC_TRIM_THRESHOLD_, which stops malloc from adapting: fresh pages for each
    # chunk make a sweep 3 to 4 times slower. The limits here are those that malloc would adapt to.
    if os.environ.get("MALLOC_TRIM_THRESHOLD_") == NANNY_THRESHOLD:
        _mallopt({_MMAP_THRESHOLD: 32 << 20, _TRIM_THRESHOLD: 64 << 20})


def keep_arrays() -> None:
    """Let malloc reuse the arrays of a simulation: fresh pages would take a fifth of the time."""
    _mallopt({_MMAP_THRESHOLD: 512 << 20, _TRIM_THRESHOLD: 1 << 30, _ARENA_MAX: 1})


def _mallopt(options: dict[int, int]) -> None:
    with suppress(AttributeError):  # Other C libraries lack this function.
        for option, value in options.items():
            ctypes.CDLL(None).mallopt(option, value)
