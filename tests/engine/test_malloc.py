"""Tasks do not fetch every buffer from the kernel anew."""

import os
import subprocess
import sys

import pytest

CODE = """
import resource
import numpy as np
from pixcal.engine.malloc import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        [np.ones(1 << 20) for _ in range(3)]  # of 8 MiB: 2048 pages
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

faults()
first = faults()
keep_freed_memory()
faults()
print(first, faults())
"""


@pytest.mark.parametrize(("setting", "kept"), [("65536", True), ("65537", False), ("", True)])
def test_buffers_are_reused_unless_the_user_has_chosen(setting: str, kept: bool) -> None:
    env = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "LD_PRELOAD"))}
    if setting:
        env["MALLOC_TRIM_THRESHOLD_"] = setting
    told = subprocess.run([sys.executable, "-c", CODE], env=env, capture_output=True, check=True)
    before, after = map(int, told.stdout.split())
    # Huge pages may make it fewer than one fault a page.
    if before < 1000:
        pytest.skip("this C library keeps what was freed, or pages are huge")
    assert (after < before / 10) == kept


ARRAYS = """
from threading import Thread
import numpy as np
from pixcal.engine.malloc import keep_arrays

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096

def simulation():
    made = [np.ones(50 << 20, np.uint8) for _ in range(3)]
    used.append(resident())

used = []
{first}
for _ in range(2):
    task = Thread(target=simulation)
    task.start()
    task.join()
print(resident() - used[0], used[1] - used[0])
"""


@pytest.mark.parametrize(("first", "kept"), [("keep_arrays()", True), ("", False)])
def test_arrays_of_simulations_serve_the_next_whichever_thread_made_them(
    first: str, kept: bool
) -> None:
    env = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "LD_PRELOAD"))}
    code = ARRAYS.replace("{first}", first)
    told = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, check=True)
    after, more = map(int, told.stdout.split())
    assert (after > -(50 << 20)) == kept
    assert more < 50 << 20
