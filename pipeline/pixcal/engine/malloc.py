"""Memory that a process keeps for its next task."""

import ctypes
import os

# From malloc.h, see mallopt(3).
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3

OF_THE_NANNY = "65536"  # what Dask's nanny gives its workers as MALLOC_TRIM_THRESHOLD_


def keep_freed_memory() -> None:
    """Let glibc's malloc reuse buffers in a worker of a Dask nanny.

    The nanny sets MALLOC_TRIM_THRESHOLD_, and any such setting stops malloc from adapting itself:
    each buffer of a chunk comes as fresh pages from the kernel and goes back at once, which
    multiplies the time of a sweep by 3 to 4. The limits set here are those that
    malloc would adapt to. What the owner of the worker has chosen stays as it is.
    """
    if os.environ.get("MALLOC_TRIM_THRESHOLD_") != OF_THE_NANNY:
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:  # another C library
        return
    mallopt(_MMAP_THRESHOLD, 32 << 20)
    mallopt(_TRIM_THRESHOLD, 64 << 20)
