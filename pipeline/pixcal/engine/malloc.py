"""Settings of malloc to keep freed memory for the next task."""

import ctypes
import os
from contextlib import suppress
from functools import cache

# From malloc.h, see mallopt(3): sizes (bytes) above which free memory is returned and arrays are
# mapped separately; number of arenas.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8

NANNY_THRESHOLD = "65536"  # MALLOC_TRIM_THRESHOLD_ that Dask's nanny sets for its workers


@cache
def keep_freed_memory() -> None:
    """Let glibc's malloc reuse buffers, unless the user chose its settings."""
    # Otherwise it returns what a chunk took as soon as the chunk is written, and fetches fresh
    # pages for the next. Where Dask's nanny set the variable, malloc does not even adapt, and a
    # sweep takes 3 to 4 times as long. These limits are the largest to which it adapts.
    if os.environ.get("MALLOC_TRIM_THRESHOLD_", NANNY_THRESHOLD) == NANNY_THRESHOLD:
        _mallopt({_MMAP_THRESHOLD: 32 << 20, _TRIM_THRESHOLD: 64 << 20})


def keep_arrays() -> None:
    """Let malloc reuse the arrays of a simulation: fresh pages would take a fifth of the time."""
    keep_freed_memory()  # Has no effect later.
    _mallopt({_MMAP_THRESHOLD: 512 << 20, _TRIM_THRESHOLD: 1 << 30, _ARENA_MAX: 1})


def _mallopt(options: dict[int, int]) -> None:
    with suppress(AttributeError):  # Other C libraries lack this function.
        for option, value in options.items():
            ctypes.CDLL(None).mallopt(option, value)
