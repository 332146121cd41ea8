"""A cluster whose hosts share no address and no cubes, and of which one is lost."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parents[2] / "benchmarks" / "cluster.py"


@pytest.mark.long
def test_a_host_that_vanishes_costs_no_bit_of_the_result() -> None:
    done = subprocess.run(
        [sys.executable, PROGRAM, "--size", "300", "--frames", "150"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "vanishes" in done.stdout
    assert "4 products, the same to the bit" in done.stdout
