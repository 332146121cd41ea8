"""Compiled kernels without a place to keep them."""

import os
import subprocess
import sys
from pathlib import Path

CODE = """
import sys
import numba
from numba.core import caching

# As where neither the package's folder nor the user's can be written.
caching.CacheImpl._locator_classes = [caching.UserProvidedCacheLocator]
import pixcal.kernels.robust
print(numba.config.CACHE_DIR)
"""


def test_a_folder_of_the_process_is_used_and_removed(tmp_path: Path) -> None:
    env = os.environ | {"TMPDIR": str(tmp_path), "NUMBA_CACHE_DIR": ""}
    found = subprocess.run(
        [sys.executable, "-c", CODE], env=env, capture_output=True, text=True, check=True
    )
    folder = Path(found.stdout.strip())
    assert folder.parent == tmp_path
    assert not folder.exists()


def test_elsewhere_it_is_left_to_numba() -> None:
    code = "import numba, pixcal.kernels; print(repr(numba.config.CACHE_DIR))"
    env = os.environ | {"NUMBA_CACHE_DIR": ""}
    found = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True
    )
    assert found.stdout.strip() == "''"
