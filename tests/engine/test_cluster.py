"""On a real cluster: each task once, failures as they are, deaths survived, strangers refused."""

import os
import shutil
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import cloudpickle
import dask
import psutil
import pytest
from distributed import Client, LocalCluster, Security

from pixcal.engine import cluster as engine_cluster
from pixcal.engine.cluster import AHEAD, MIN_AHEAD, workers_of
from pixcal.engine.plan import DASK_WORKER_BYTES, USABLE, make_plan
from pixcal.engine.remote_task import versions
from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.errors import ClusterError, DamagedError, InputError, PlanError

MIB = 1 << 20


@pytest.fixture(autouse=True, scope="module")
def _by_value() -> Iterator[None]:
    """Workers cannot import this file: its functions travel whole."""
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    yield
    cloudpickle.unregister_pickle_by_value(sys.modules[__name__])


def known_tasks(address: str) -> int:
    """Number of tasks that the scheduler knows."""
    with Client(address, set_as_default=False) as client:
        found: int = client.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks))
        return found


def eventually(true: Callable[[], bool], seconds: float = 20.0) -> bool:
    deadline = time.monotonic() + seconds
    while not true():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.05)
    return True


# What tasks do


def spot(folder: Path, item: int) -> tuple[int, float, float, str]:
    """Process, begin and end of a task, and the folder it was given."""
    begin = time.time()
    time.sleep(0.02)
    return os.getpid(), begin, time.time(), str(folder)


def fail(error: BaseException) -> None:
    raise error


def kill(mark: Path, item: int) -> int:
    """Kill the process that does the first task; always, when the mark is a folder."""
    if item == 0 and not mark.is_file():
        if not mark.exists():
            mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return item * item


def leave_mark(folder: Path, bad: int, item: int) -> None:
    (folder / f"{item}.begun").touch()
    time.sleep(0.3)
    if item == bad:
        raise ValueError
    (folder / f"{item}.ended").touch()


class Counted:
    """A function that notes in which process it was unpacked."""

    def __init__(self, log: Path, load: bytes) -> None:
        self.log, self.load = log, load

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__ = state
        with self.log.open("a") as file:
            file.write(f"{os.getpid()}\n")

    def __call__(self, item: int) -> int:
        return len(self.load) + item


# Where and how they are done


def test_every_task_once_and_none_left_behind(cluster: Any) -> None:
    noted: list[int] = []
    most = 0

    def done(number: int, result: int) -> None:
        nonlocal most
        assert result == 3**number
        noted.append(number)
        if number % 29 == 0:
            most = max(most, known_tasks(cluster.address))

    count = 10 * MIN_AHEAD
    run_tasks(partial(pow, 3), range(count), cluster.runtime, label="powers", done=done)
    assert Counter(noted) == Counter(range(count))
    assert 0 < most <= max(MIN_AHEAD, AHEAD * 4), "the scheduler gets them bit by bit"
    assert eventually(lambda: known_tasks(cluster.address) == 0)


def test_tasks_run_in_all_workers_and_see_absolute_paths(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "data").mkdir()
    monkeypatch.chdir(tmp_path)
    spots = run_tasks(partial(spot, Path("data")), range(24), cluster.runtime, label="spots")
    assert {pid for pid, *_ in spots} == set(cluster.pids())
    assert {folder for *_, folder in spots} == {str(tmp_path / "data")}


@pytest.mark.parametrize("at_once", [0, 1])
def test_no_more_tasks_at_a_time_in_a_worker_than_asked_for(cluster: Any, at_once: int) -> None:
    runtime = cluster.runtime.with_workers(at_once)
    spots = run_tasks(partial(spot, Path()), range(40), runtime, label="spots")
    together = any(a[0] == b[0] and a[1] < b[2] and b[1] < a[2] for a, b in combinations(spots, 2))
    assert together == (at_once != 1)


def test_a_function_is_unpacked_once_in_each_worker(cluster: Any, tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.touch()
    function = Counted(log, bytes(MIB))
    results = run_tasks(function, range(50), cluster.runtime, label="counted")
    assert results == [MIB + n for n in range(50)]
    assert Counter(map(int, log.read_text().split())) == dict.fromkeys(cluster.pids(), 1)


@pytest.mark.parametrize(
    "error",
    [
        InputError("acq/bias/1.fits: EXPTIME missing; add it"),
        DamagedError("RUN/x", "chunk missing"),
        OSError(28, "No space left on device", "RUN/x"),
        MemoryError(),
        ValueError("seven"),
    ],
    ids=repr,
)
def test_a_failure_arrives_as_it_is(cluster: Any, error: BaseException) -> None:
    with pytest.raises(type(error)) as caught:
        run_tasks(fail, [error], cluster.runtime, label="failing")
    assert type(caught.value) is type(error)
    assert caught.value.args == error.args
    assert getattr(caught.value, "filename", None) == getattr(error, "filename", None)


@pytest.mark.parametrize("cause", ["failure", "ctrl-c", "ctrl-c that a callback swallows"])
def test_what_is_left_is_taken_back_and_workers_are_idle(
    cluster: Any, tmp_path: Path, cause: str
) -> None:
    expected: type[BaseException] = ValueError if cause == "failure" else KeyboardInterrupt
    # Tests that a shell starts in the background ignore Ctrl-C, and so does what they start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if cause != "failure":
        me = threading.main_thread().ident
        assert me is not None
        if "swallows" in cause:
            signal.signal(signal.SIGINT, lambda *_: None)

        def interrupt_at_work() -> None:
            # Not before: while the library connects, Python may be where it cannot raise.
            eventually(lambda: any(tmp_path.glob("*.ended")))
            signal.pthread_kill(me, signal.SIGINT)

        threading.Thread(target=interrupt_at_work).start()
    task = partial(leave_mark, tmp_path, 3 if cause == "failure" else -1)
    heard = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(expected):
            run_tasks(task, range(400), cluster.runtime, label="marks")
        assert signal.getsignal(signal.SIGINT) is heard
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    begun, ended = (set(tmp_path.glob(f"*.{state}")) for state in ("begun", "ended"))
    assert len(begun) < 300
    assert len(begun) == len(ended) + (cause == "failure"), "nothing is going on"
    assert eventually(lambda: known_tasks(cluster.address) == 0)
    assert run_tasks(abs, [-1, 2], cluster.runtime, label="again") == [1, 2]
    assert set(tmp_path.glob("*.begun")) == begun


def test_where_to_watch_is_said_once(cluster: Any, capfd: pytest.CaptureFixture[str]) -> None:
    run_tasks(abs, [1], cluster.runtime, label="quiet")
    assert capfd.readouterr() == ("", "")
    loud = Runtime(cluster.address, quiet=False)
    for _ in range(2):
        run_tasks(abs, [1], loud, label="counting")
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("dashboard http://127.0.0.1:") == 1


def test_encrypted_with_the_certificates_that_dask_knows() -> None:
    pytest.importorskip("cryptography")
    made = Security.temporary()
    known = {
        "distributed.comm.tls.ca-file": made.tls_ca_file,
        "distributed.comm.tls.client.cert": made.tls_client_cert,
        "distributed.comm.tls.client.key": made.tls_client_key,
    }
    with LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        host="127.0.0.1",
        protocol="tls://",
        security=made,
        dashboard_address=None,
    ) as local:
        runtime = Runtime(local.scheduler_address)
        assert runtime.cluster.startswith("tls://")
        with dask.config.set(known):
            assert run_tasks(abs, [-1, 2], runtime, label="encrypted") == [1, 2]
        with pytest.raises(
            InputError, match=r"names no certificates; .*\(distributed\.comm\.tls\)"
        ):
            run_tasks(abs, [1], runtime, label="encrypted")


def test_no_port_is_opened(cluster: Any) -> None:
    def ports() -> set[Any]:
        connections = psutil.Process().net_connections("inet")
        return {c.laddr for c in connections if c.status == psutil.CONN_LISTEN}

    before, during = ports(), set()
    run_tasks(abs, [1], cluster.runtime, label="x", done=lambda *_: during.update(ports()))
    assert during <= before


# Workers that are not what they should be


def test_a_worker_without_the_disk_is_refused(cluster: Any, tmp_path: Path) -> None:
    """The path is a folder of this process's own; another process finds nothing there."""
    (tmp_path / "run").mkdir()
    here = Path(f"/proc/self/fd/{os.open(tmp_path, os.O_RDONLY)}")
    with pytest.raises(InputError, match=rf"{here}/run: the worker on .* cannot see this path"):
        run_tasks(partial(spot, here / "run"), range(3), cluster.runtime, label="spots")
    with pytest.raises(InputError, match=rf"{here}/run: the worker on .* cannot see this path"):
        run_tasks(len, [[here / "run"]], cluster.runtime, label="lengths")


def test_a_worker_with_a_run_of_its_own_is_refused(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk of its own that holds another run under the very same path."""
    with Client(cluster.address, set_as_default=False) as client:
        (there,) = set(client.run(os.getcwd).values())
    for folder in (tmp_path, Path(there)):
        (folder / "run" / "reduce").mkdir(parents=True)
        (folder / "run" / ".lock").touch()
        (folder / "run" / ".partial").mkdir()
    monkeypatch.chdir(tmp_path)
    source = Path("/proc/self/cwd/run/reduce")
    with pytest.raises(
        InputError, match=r"run/\.cluster-\w+: the worker on .* cannot see this path"
    ):
        run_tasks(partial(spot, source), range(3), cluster.runtime, label="spots")
    assert not list((tmp_path / "run").glob(".cluster*"))
    monkeypatch.chdir(there)
    run_tasks(partial(spot, source), range(3), cluster.runtime, label="spots")
    shutil.rmtree(Path(there) / "run")


def test_locks_of_other_programs_make_no_run_directory(cluster: Any, tmp_path: Path) -> None:
    """pytest keeps one above all its folders, and several processes work below."""
    (tmp_path / ".lock").touch()
    other = tmp_path / ".cluster-other"
    other.touch()
    (tmp_path / "frames").mkdir()
    run_tasks(partial(spot, tmp_path / "frames"), range(3), cluster.runtime, label="spots")
    assert sorted(tmp_path.glob(".cluster*")) == [other]


@pytest.mark.parametrize(
    ("other", "refused"),
    [
        ({"numpy": "9.9"}, r"has numpy \d.*, this process 9\.9; install the same"),
        ({"machine": "far", "code of pixcal": "0"}, "has code of pixcal .*, this process 0; inst"),
        ({"machine": "far"}, None),
        ({"code of pixcal": "0"}, None),
    ],
    ids=str,
)
def test_other_versions_are_refused(
    cluster: Any, monkeypatch: pytest.MonkeyPatch, other: dict[str, str], refused: str | None
) -> None:
    # Of the workers, as theirs may be older than an edit that this process has seen.
    with Client(cluster.address, set_as_default=False) as client:
        (theirs,) = {tuple(found.items()) for found in client.run(versions).values()}
    monkeypatch.setattr(engine_cluster, "versions", lambda: dict(theirs) | other)
    if refused is None:
        assert run_tasks(abs, [-1], cluster.runtime, label="x") == [1]
        return
    with pytest.raises(InputError, match=refused):
        run_tasks(abs, [1], cluster.runtime, label="x")


# Memory


def test_tasks_are_planned_into_the_memory_of_the_workers(cluster: Any) -> None:
    limits = {worker["memory_limit"] for worker in workers_of(cluster.runtime).values()}
    assert limits == {1200 * MIB}
    room = int(USABLE * 1200 * MIB) - DASK_WORKER_BYTES
    for per_task, expected in ((room // 2, 2), (room // 2 + 1, 1), (room, 1), (0, 2)):
        assert make_plan("it", per_task, 0, cluster.runtime).workers == expected
    assert make_plan("it", MIB, 0, cluster.runtime.with_workers(1)).workers == 1
    need, have = (DASK_WORKER_BYTES + room + MIB) // MIB, int(USABLE * 1200)
    with pytest.raises(PlanError, match=rf"it needs {need} MiB in a worker, tcp://.* {have} MiB"):
        make_plan("it", room + MIB, 0, cluster.runtime)
    with pytest.raises(PlanError, match="--memory: it needs"):
        make_plan("it", 0, 3 << 30, cluster.runtime)


# Deaths


def test_the_tasks_of_a_killed_worker_are_done_by_others(cluster: Any, tmp_path: Path) -> None:
    before = set(cluster.pids())
    noted: list[int] = []
    results = run_tasks(
        partial(kill, tmp_path / "mark"),
        range(60),
        cluster.runtime,
        label="squares",
        done=lambda n, _: noted.append(n),
    )
    assert results == [n * n for n in range(60)]
    assert Counter(noted) == Counter(range(60))
    assert len(before - set(cluster.pids())) == 1


def test_a_task_that_kills_every_worker_ends_the_run(cluster: Any, tmp_path: Path) -> None:
    cluster.pids()
    with pytest.raises(ClusterError, match=r"2 workers died on the same task, the last was tcp://"):
        run_tasks(partial(kill, tmp_path), range(4), cluster.runtime, label="squares")
    assert run_tasks(abs, [-1], cluster.runtime, label="again") == [1]


@pytest.mark.long
def test_processes_that_are_killed_are_replaced(tmp_path: Path) -> None:
    runtime = Runtime("processes", 2)
    noted: list[int] = []
    results = run_tasks(
        partial(kill, tmp_path / "mark"),
        range(9),
        runtime,
        label="squares",
        done=lambda n, _: noted.append(n),
    )
    assert results == [n * n for n in range(9)]
    assert Counter(noted) == Counter(range(9))
    with pytest.raises(ClusterError, match="--cluster processes: worker processes were killed"):
        run_tasks(partial(kill, tmp_path), range(3), runtime, label="squares")
    assert run_tasks(abs, [-1], runtime, label="again") == [1]
