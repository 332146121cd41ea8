"""Dask workers that are killed, or run out of memory, in the middle of a command."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
from distributed import Client

from faults import Outcome
from faults.bench import Bench
from faults.forks import Command

MEMORY_MIB = 900
ALLOWED = 1
"""Workers that may die at a task before its run ends."""


@contextmanager
def cluster() -> Iterator[str]:
    """A scheduler and two workers under a nanny on this machine; yields the address."""
    env = os.environ | {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": str(ALLOWED)}
    begun: list[subprocess.Popen[bytes]] = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "scheduler.json")

        def start(*args: str) -> None:
            command = [sys.executable, "-m", "dask", *args, "--scheduler-file", str(file)]
            log = subprocess.DEVNULL
            begun.append(subprocess.Popen(command, cwd=folder, env=env, stdout=log, stderr=log))

        start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        start(
            "worker",
            "--host",
            "127.0.0.1",
            "--no-dashboard",
            "--nworkers",
            "2",
            "--nthreads",
            "1",
            "--memory-limit",
            f"{MEMORY_MIB}MiB",
        )
        try:
            while not file.exists():
                time.sleep(0.05)
            address: str = json.loads(file.read_text())["address"]
            yield address
        finally:
            for process in reversed(begun):
                process.terminate()
                process.wait(30)


def _starve(megabytes: int) -> None:
    """Allocate memory and write to it, like a leak; it is never freed."""
    import threading

    # In a thread: who asks for it does not wait until the worker dies.
    threading.Thread(target=_leak, args=(megabytes,), daemon=True).start()


def _leak(megabytes: int) -> None:
    held = [b"x" * (1 << 20) for _ in range(megabytes)]
    time.sleep(60)
    del held


def killed(bench: Bench, address: str, stage: str, times: int) -> Outcome:
    """Kill a worker when the first tasks of a command are done."""
    outcome = Outcome("Dask worker killed")
    rng = bench.rng("killed", stage)

    def kill(client: Client, command: Command, run: Path) -> None:
        pids = list(client.run(os.getpid).values())
        _wait_for_work(command, run)
        os.kill(rng.choice(pids), signal.SIGKILL)

    return _disturbed(bench, address, stage, times, kill, outcome)


def starved(bench: Bench, address: str, stage: str, times: int) -> Outcome:
    """Let a worker lose its memory to something else: its nanny kills it."""
    outcome = Outcome("Dask worker short of memory")
    rng = bench.rng("starved", stage)

    def starve(client: Client, command: Command, run: Path) -> None:
        chosen = rng.choice(list(client.scheduler_info(n_workers=-1)["workers"]))
        client.run(_starve, MEMORY_MIB, workers=[chosen])

    return _disturbed(bench, address, stage, times, starve, outcome)


def _disturbed(
    bench: Bench,
    address: str,
    stage: str,
    times: int,
    disturb: Callable[[Client, Command, Path], None],
    outcome: Outcome,
) -> Outcome:
    tried = 0
    while outcome.tried < times:
        tried += 1
        assert tried < 5 * times, "the commands are over before the workers die"
        run = bench.before(stage, f"{stage}-workers")
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            before = set(client.run(os.getpid).values())
            command = Command([*bench.command(stage, run), "--cluster", address])
            disturb(client, command, run)
            ended = command.end()
            in_time = any(not psutil.pid_exists(pid) for pid in before)
            _wait_for_death(before)
        if ended.code:
            ended.refused(1, "run the same command again to resume")
        bench.assert_resumed(run, stage)
        if in_time:
            end = "one line, exit 1; resumed" if ended.code else "tasks done by other workers"
            outcome.ends[end] += 1
    return outcome


def _wait_for_work(command: Command, run: Path) -> None:
    """Wait until a step is noted as done, so that tasks are running."""
    while command.process.is_alive() and not any(run.glob(".partial/*/journal.jsonl")):
        time.sleep(0.001)


def _wait_for_death(pids: set[int]) -> None:
    deadline = time.monotonic() + 60
    while all(psutil.pid_exists(pid) for pid in pids):
        assert time.monotonic() < deadline, "no worker died"
        time.sleep(0.05)
