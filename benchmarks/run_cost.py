"""Processor time and peak memory of ``pixcal run``, of the second bench or of any acquisition.

Fails where the memory passes the limit that ``pixcal run`` plans for by default, or the processor
time passes that of the longest run allowed: 120 s on two cores.

    python benchmarks/run_cost.py ordinary:5 lag/traps:6 --strength 0.7
    python benchmarks/run_cost.py path/to/acq another/acq
    python benchmarks/run_cost.py all:7

``all:SEED`` is the ordinary bench and every effect of the second bench, known to pixcal or not.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pixcal.model.options import Running

LONGEST_S, CORES = 120.0, 2
BENCH = Path(__file__).parents[1] / "bench"


def made(case: str, strength: str, place: Path) -> Path:
    """An acquisition of the second bench, ``CASE:SEED``."""
    name, _, seed = case.rpartition(":")
    command = [sys.executable, "-m", "second_bench", name, "--seed", seed, "--strength", strength]
    command += ["--out", str(place / "acq"), "--truth", str(place / "truth.json")]
    subprocess.run(command, cwd=BENCH, check=True)
    return place / "acq"


def named(case: str) -> list[str]:
    """Cases of an argument."""
    name, _, seed = case.rpartition(":")
    if name != "all":
        return [case]
    command = [sys.executable, "-m", "second_bench", "--list", "--json"]
    listed = subprocess.run(command, cwd=BENCH, check=True, capture_output=True).stdout
    laws = [f"{law['effect']}/{law['name']}" for law in json.loads(listed)["laws"]]
    return [f"{one}:{seed}" for one in ("ordinary", *laws)]


def cost(case: str, strength: str) -> bool:
    """Run a case; whether it stays within its limits."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        acquisition = Path(case) if Path(case).is_dir() else made(case, strength, place)
        code = "from pixcal_cli.main import main; main()"
        command = [sys.executable, "-c", code, "run", str(acquisition), "--quiet"]
        begin = time.monotonic()
        with subprocess.Popen([*command, "--out", str(place / "run")], stdout=-3) as process:
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        found = json.loads((place / "run" / "products" / "diagnosis.json").read_text())
    seconds, peak = used.ru_utime + used.ru_stime, used.ru_maxrss << 10
    causes = ", ".join(cause["effect"] for cause in found["causes"]) or "none"
    print(
        f"{case}: {found['verdict']}, causes {causes}; {seconds:.0f} s of processor "
        f"time ({time.monotonic() - begin:.0f} s in all), {peak >> 20} MiB of the "
        f"{Running().memory >> 20} MiB planned for",
        flush=True,
    )
    within = seconds <= CORES * LONGEST_S and peak <= Running().memory
    return within and process.returncode == 0


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="+", metavar="CASE:SEED|all:SEED|ACQ")
    parser.add_argument("--strength", default="0.7")
    asked = parser.parse_args()
    cases = [one for case in asked.cases for one in named(case)]
    beyond = sum(not cost(case, asked.strength) for case in cases)
    return 1 if beyond else 0


if __name__ == "__main__":
    sys.exit(main())
