"""Kernels of the diagnosis, compiled by another process while a first run reads its frames."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pixcal.engine.run import Runtime
from pixcal.kernels import KEPT
from pixcal.kernels.normals import _fill


@contextmanager
def compiled_ahead(runtime: Runtime) -> Iterator[None]:
    """Context beside which kernels are compiled, if there are none yet and there is a core free.

    A process, for Numba compiles in one thread at a time, and mostly holds Python's lock.
    """
    # It costs a tenth more processor time: on a busy machine that is lost.
    busy = os.getloadavg()[0] > runtime.n_workers - 1
    if not KEPT or busy or runtime.n_workers < 2 or _compiled_before():
        yield
        return
    quiet = subprocess.DEVNULL
    command = [sys.executable, "-m", __name__]
    with subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet) as other:
        try:
            yield
        finally:
            other.terminate()


def _compiled_before() -> bool:
    # Which of Numba's folders it is differs from one installation to another.
    return any(Path(_fill.stats.cache_path).glob("normals._fill-*.nbi"))
