"""Tasks give the same results wherever they run, each is noted once, and a failure is heard."""

import math
import operator
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import cloudpickle
import psutil
import pytest

from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.errors import InputError

# Functions that other processes can import: those of the standard library.
POWER = partial(pow, 3)
LOCAL = [Runtime("sync"), Runtime("threads", 1), Runtime("threads", 3), Runtime("processes", 2)]


@pytest.fixture(params=[*LOCAL, "cluster"], ids=str)
def runtime(request: pytest.FixtureRequest) -> Runtime:
    if request.param == "cluster":
        found: Runtime = request.getfixturevalue("dask_cluster")
        return found
    local: Runtime = request.param
    return local


@pytest.mark.parametrize("count", [0, 1, 2, 7, 41])
def test_results_in_the_order_of_the_items(runtime: Runtime, count: int) -> None:
    assert run_tasks(POWER, range(count), runtime, label="test") == [3**n for n in range(count)]


def test_each_task_is_noted_once_in_this_thread(runtime: Runtime) -> None:
    noted: list[tuple[int, int]] = []
    threads = set()

    def done(number: int, result: int) -> None:
        noted.append((number, result))
        threads.add(threading.get_ident())

    items = [5, 5, 0, 9, 2, 5, 7]
    results = run_tasks(POWER, items, runtime, label="test", done=done)
    assert Counter(noted) == Counter(enumerate(results))
    assert threads == {threading.get_ident()}


def test_a_failure_comes_out_as_it_is(runtime: Runtime) -> None:
    noted: list[int] = []
    with pytest.raises(ValueError, match="factorial"):
        run_tasks(
            math.factorial, [3, 4, -1, 5], runtime, label="test", done=lambda n, _: noted.append(n)
        )
    assert 2 not in noted
    assert run_tasks(math.factorial, [3, 4], runtime, label="test") == [6, 24], "and not for long"


def test_an_input_error_stays_one(runtime: Runtime) -> None:
    with pytest.raises(InputError, match="--cluster nonsense"):
        run_tasks(Runtime, ["sync", "nonsense"], runtime, label="test")


def test_items_are_handed_over_as_they_are(runtime: Runtime) -> None:
    """Whatever they look like to Dask, whose graphs give tuples, lists and words a meaning."""
    items: list[Any] = [
        "task-1",
        ["task-0", "task-2"],
        (len, "four"),
        {"a": "task-0"},
        ((0, 4), (3, 9)),
        None,
    ]
    wrapped = partial(operator.contains, items[1:])
    expected = [item in items[1:] for item in items]
    assert run_tasks(wrapped, items, runtime, label="test") == expected
    assert run_tasks(partial(str.format, "{}"), items, runtime, label="test") == list(
        map(str, items)
    )


def test_threads_are_threads_and_processes_processes() -> None:
    items = [None] * 8
    here = os.getpid()
    assert set(run_tasks(_pid, items, Runtime("threads", 2), label="test")) == {here}
    others = set(
        run_tasks(
            partial(eval, "__import__('os').getpid()"),
            [{}] * 8,
            Runtime("processes", 2),
            label="test",
        )
    )
    assert here not in others
    assert len(others) <= 2


def _pid(_item: None) -> int:
    return os.getpid()


def _fail_or_mark(folder: Path, item: int) -> None:
    (folder / f"{item}.begun").touch()
    if item == 0:
        while not (folder / "1.begun").exists():
            threading.Event().wait(0.01)
        raise ValueError
    threading.Event().wait(0.4)
    (folder / f"{item}.ended").touch()


@pytest.mark.parametrize("place", ["threads", "processes"])
def test_what_has_begun_has_ended_when_a_failure_comes_out(place: str, tmp_path: Path) -> None:
    """The caller gives up its lock then: two must not write one chunk."""
    cloudpickle.register_pickle_by_value(sys.modules[__name__])
    # Dask begins with the last of the tasks.
    items = [5, 4, 3, 2, 1, 0]
    with pytest.raises(ValueError):
        run_tasks(partial(_fail_or_mark, tmp_path), items, Runtime(place, 2), label="test")
    begun, ended = (
        {file.stem for file in tmp_path.glob(f"*.{state}")} for state in ("begun", "ended")
    )
    assert begun - ended == {"0"}


@pytest.mark.parametrize("workers", [1, 3])
def test_no_more_tasks_at_a_time_than_workers(workers: int) -> None:
    running, most, lock = 0, 0, threading.Lock()

    def task(_item: int) -> None:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        threading.Event().wait(0.01)
        with lock:
            running -= 1

    run_tasks(task, range(12), Runtime("threads", workers), label="test")
    assert most == workers


def test_workers() -> None:
    assert Runtime("sync", 5).n_workers == 1
    assert Runtime("threads", 5).n_workers == 5
    assert Runtime("threads").n_workers == len(os.sched_getaffinity(0))
    assert Runtime("threads", memory=7).with_workers(3) == Runtime("threads", 3, 7)


@pytest.mark.parametrize("name", ["", "thread", "slurm", "Threads"])
def test_an_unknown_place_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"--cluster {name}: not one of threads, processes, sync"):
        Runtime(name)


@pytest.mark.parametrize("address", ["nonsense://127.0.0.1:1", "tcp://127.0.0.1:notaport"])
def test_an_address_that_is_none(address: str) -> None:
    with pytest.raises(InputError, match=f"--cluster {address}: no Dask scheduler"):
        run_tasks(POWER, [1], Runtime(address), label="test")


@pytest.mark.long
def test_a_scheduler_that_does_not_answer() -> None:
    # In a process of its own: clusters of other tests leave their event loops behind.
    code = (
        "from pixcal.engine.run import Runtime, run_tasks\n"
        "run_tasks(print, [1], Runtime('tcp://127.0.0.1:1'), label='test')"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "InputError: --cluster tcp://127.0.0.1:1: no Dask scheduler answers" in ended.stderr


@pytest.mark.parametrize("quiet", [True, False])
def test_progress_goes_to_stderr(quiet: bool, capfd: pytest.CaptureFixture[str]) -> None:
    run_tasks(POWER, range(4), Runtime("sync", quiet=quiet), label="counting")
    out, err = capfd.readouterr()
    assert out == ""
    assert err == "" if quiet else ("counting" in err and "4/4" in err)


ORPHANS = """
import time
from pixcal.engine.run import run_in_processes
run_in_processes(time.sleep, [60.0] * 4, 2, print)
"""


def test_workers_end_when_what_they_work_for_is_killed() -> None:
    main = subprocess.Popen([sys.executable, "-c", ORPHANS])
    try:
        children: list[psutil.Process] = []
        deadline = time.monotonic() + 60
        # Workers, and what multiprocessing itself starts; both have begun their tasks.
        while len(children) < 3 and time.monotonic() < deadline:
            time.sleep(0.2)
            children = psutil.Process(main.pid).children(recursive=True)
        assert len(children) >= 3
        time.sleep(3)
    finally:
        main.kill()
        main.wait()
    _, alive = psutil.wait_procs(children, timeout=20)
    assert not alive


def test_work_on_this_machine_does_without_distributed() -> None:
    code = (
        "import sys; from pixcal.engine.run import Runtime, run_tasks; "
        "run_tasks(abs, [1, -2, 3], Runtime(workers=2, quiet=True), label='x'); "
        "sys.exit('distributed' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
