"""Ingest to maps on a cluster that loses a host, against one machine: ``make cluster``.

Each host is a network namespace with its own address or, if the system does not allow that, an
address of the loopback range. The cubes are in an S3 store (moto) at another address. Frames and
run directory are on a disk shared by all, as docs/how-to/clusters.md requires. In the middle of the
sweep one host loses its link and its processes.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import boto3
from botocore.exceptions import BotoCoreError

from pixcal.storage.manifest import JOURNAL
from workload import Workload

PROGRAMS = Path(sys.executable).parent
PORT = 8786
STORE_PORT = 9000
PATIENCE_S = 300.0
SILENCE = "15 s"
"""After which the scheduler gives up a worker that it does not hear from."""
HOSTS = ("host1", "host2")
PREFIX = "pixcal"


@dataclass
class Host:
    """One machine of the cluster."""

    address: str  # where it listens
    prefix: Sequence[str] = ()  # what runs a command there
    unplug: Callable[[], object] = lambda: None  # takes it off the network
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def start(self, *command: str, quiet: bool = True) -> subprocess.Popen[bytes]:
        """Start one of the environment's programs in a new session."""
        program, *arguments = command
        process = subprocess.Popen(
            [*self.prefix, PROGRAMS / program, *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL if quiet else None,
            start_new_session=True,
        )
        self.processes.append(process)
        return process

    def kill(self) -> None:
        """End all processes of this host."""
        for process in self.processes:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def vanish(self) -> None:
        """Lose the link, then the processes, so that no other host is told that they ended."""
        self.unplug()
        self.kill()


def ip(*arguments: str) -> None:
    """Change the network of this machine (iproute2)."""
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


@contextmanager
def namespaces(names: Sequence[str]) -> Iterator[list[Host]]:
    """Hosts in network namespaces, joined by a bridge; the first is the machine itself."""
    bridge, net = f"{PREFIX}{os.getpid() % 100000}", f"10.231.{os.getpid() % 250}"
    hosts = [Host(f"{net}.1")]
    with ExitStack() as undo:
        ip("link", "add", bridge, "type", "bridge")
        undo.callback(ip, "link", "del", bridge)
        ip("addr", "add", f"{net}.1/24", "dev", bridge)
        ip("link", "set", bridge, "up")
        for number, name in enumerate(names, start=2):
            space, link = f"{bridge}-{name}", f"{bridge}-{number}"
            ip("netns", "add", space)
            undo.callback(ip, "netns", "del", space)
            ip("link", "add", link, "type", "veth", "peer", "name", "eth0", "netns", space)
            ip("link", "set", link, "master", bridge, "up")
            ip("-n", space, "addr", "add", f"{net}.{number}/24", "dev", "eth0")
            for device in ("lo", "eth0"):
                ip("-n", space, "link", "set", device, "up")
            hosts.append(
                Host(
                    f"{net}.{number}",
                    ("ip", "netns", "exec", space),
                    lambda link=link: ip("link", "set", link, "down"),
                )  # type: ignore[misc]
            )
        yield hosts


@contextmanager
def network(names: Sequence[str], *, loopback: bool) -> Iterator[list[Host]]:
    """The store's host, and others with given names; their processes end with the context."""
    with ExitStack() as stack:
        try:
            if loopback:
                raise PermissionError
            hosts = stack.enter_context(namespaces(names))
            print("hosts: network namespaces")
        except (OSError, subprocess.CalledProcessError):
            hosts = [Host(f"127.0.77.{number}") for number in range(1, len(names) + 2)]
            print("hosts: addresses of the loopback range")
        for host in hosts:
            stack.callback(host.kill)
        yield hosts


def until(true: Callable[[], bool], what: str) -> None:
    """Wait for something."""
    deadline = time.monotonic() + PATIENCE_S
    while not true():
        if time.monotonic() > deadline:
            sys.exit(f"cluster: waited {PATIENCE_S:.0f} s for {what}")
        time.sleep(0.05)


def make_bucket(endpoint: str) -> bool:
    """Make the bucket ``cubes``, once the store answers."""
    try:
        boto3.client("s3", endpoint_url=endpoint).create_bucket(Bucket="cubes")
    except BotoCoreError:
        return False
    return True


def steps_done(run: Path) -> int:
    """Tiles that the sweep has noted as done."""
    found = run.glob(f".partial/sweep-*/{JOURNAL}")
    journals = [file.read_text(encoding="utf-8") for file in found]
    return sum(text.count('"done"') - text.count(":scout ") for text in journals)


def products(run: Path) -> dict[str, Any]:
    """Maps and figures of a run, without counts of reads, which depend on where it ran."""
    folder = run / "products"
    maps = {file.name: file.read_bytes() for file in folder.glob("*.fits")}
    figures = {file.name: json.loads(file.read_bytes()) for file in folder.glob("*.json")}
    for facts in figures["fit.json"]["sets"].values():
        del facts["passes"], facts["chunks_read"]
    return maps | figures


def main() -> None:
    """Run and compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=400, help="pixels along each side")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--loopback", action="store_true", help="no network namespaces")
    options = parser.parse_args()
    names = ("head", *HOSTS)
    with (
        tempfile.TemporaryDirectory() as scratch,
        network(names, loopback=options.loopback) as hosts,
    ):
        work = Workload(Path(scratch), (options.size, options.size - 7), options.frames, 2)
        work.simulate()
        run_with_a_loss(work, *hosts)


def run_with_a_loss(work: Workload, store: Host, head: Host, lost: Host, left: Host) -> None:
    """Run on the cluster, lose a host in the middle, and compare with a run of this machine."""
    endpoint, scheduler = f"http://{store.address}:{STORE_PORT}", f"tcp://{head.address}:{PORT}"
    os.environ |= {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_CONFIG_FILE": os.devnull,
        "DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL": SILENCE,
    }
    store.start("moto_server", "--host", store.address, "--port", str(STORE_PORT))
    until(lambda: make_bucket(endpoint), "the store")
    head.start("dask", "scheduler", "--host", head.address, "--port", str(PORT), "--no-dashboard")
    for host in (lost, left):
        host.start(
            "dask",
            "worker",
            scheduler,
            "--host",
            host.address,
            "--nworkers",
            "1",
            "--nthreads",
            "1",
            "--no-dashboard",
            "--local-directory",
            str(work.folder / "dask"),
        )
    alone, spread = work.folder / "alone", work.folder / "spread"
    command = ("pixcal", "run", str(work.folder / "acq"), "--no-diagnose", "--quiet", "--out")
    if store.start(*command, str(alone), quiet=False).wait():
        sys.exit("cluster: the run on this machine failed")
    running = head.start(
        *command, str(spread), "--cluster", scheduler, "--cubes", "s3://cubes/night", quiet=False
    )
    until(lambda: steps_done(spread) > 0 or running.poll() is not None, "the sweep")
    if running.poll() is not None:
        sys.exit("cluster: the run ended before a host could be lost")
    print(f"{lost.address} vanishes", flush=True)
    lost.vanish()
    if running.wait():
        sys.exit("cluster: the run on the cluster failed")
    ours, theirs = products(alone), products(spread)
    different = sorted(n for n in ours.keys() | theirs.keys() if ours.get(n) != theirs.get(n))
    if different or not ours:
        sys.exit(f"cluster: not the same as on one machine: {', '.join(different)}")
    print(f"cluster: {len(ours)} products, the same to the bit as on one machine")


if __name__ == "__main__":
    main()
