"""A Dask cluster as a user starts one: a scheduler, and workers under a nanny, on loopback."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from distributed import Client

from pixcal.engine.run import Runtime

CLI = [sys.executable, "-m", "dask"]
WORKERS = 2
THREADS = 2
MEMORY_MIB = 1200


@dataclass
class Cluster:
    """A cluster and its processes."""

    address: str
    scheduler: "subprocess.Popen[bytes]"
    workers: "subprocess.Popen[bytes]"

    @property
    def runtime(self) -> Runtime:
        return Runtime(self.address)

    def pids(self) -> list[int]:
        """Process numbers of the workers, once all are there."""
        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(WORKERS, timeout=60)
            return list(client.run(os.getpid).values())

    def stop(self) -> None:
        """End what still runs, the workers first: they wait for a scheduler that is gone."""
        for process in (self.workers, self.scheduler):
            if process.poll() is None:
                process.terminate()
                process.wait(timeout=30)


def start(folder: Path) -> Cluster:
    """Start a cluster whose processes work in another folder than the tests."""
    env = os.environ | {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1"}
    file = folder / "scheduler.json"

    def run(*args: str) -> "subprocess.Popen[bytes]":
        with (folder / f"{args[0]}.log").open("wb") as log:
            return subprocess.Popen([*CLI, *args], cwd=folder, env=env, stdout=log, stderr=log)

    scheduler = run(
        "scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--dashboard-address",
        "127.0.0.1:0",
        "--scheduler-file",
        str(file),
    )
    workers = run(
        "worker",
        "--scheduler-file",
        str(file),
        "--host",
        "127.0.0.1",
        "--no-dashboard",
        "--nworkers",
        str(WORKERS),
        "--nthreads",
        str(THREADS),
        "--memory-limit",
        f"{MEMORY_MIB}MiB",
    )
    made = Cluster("", scheduler, workers)
    deadline = time.monotonic() + 60
    while not made.address:
        try:
            with Client(scheduler_file=str(file), set_as_default=False, timeout=5) as client:
                client.wait_for_workers(WORKERS, timeout=60)
                made.address = client.scheduler.address
        except (OSError, ValueError):
            if time.monotonic() > deadline:
                made.stop()
                pytest.fail((folder / "scheduler.log").read_text())
            time.sleep(0.2)
    return made


# It takes time even where it waits.
@pytest.fixture(scope="package")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """Two workers of two threads, with little memory."""
    made = start(tmp_path_factory.mktemp("cluster"))
    yield made
    made.stop()


@pytest.fixture
def another_cluster(tmp_path: Path) -> Iterator[Cluster]:
    """One to be broken."""
    made = start(tmp_path)
    yield made
    made.stop()
