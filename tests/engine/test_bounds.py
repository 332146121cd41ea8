"""What takes more time or memory than was planned for it is ended; what comes after is not."""

import threading
import time

import numpy as np
import pytest
from numba.core import event

from pixcal.engine.bounds import Bound, Exceeded
from pixcal.engine.run import Runtime

ALL = 1 << 60


def busy(seconds: float) -> int:
    """Work of this thread's processor time, in small steps."""
    end, steps = time.thread_time() + seconds, 0
    while time.thread_time() < end:
        steps += 1
    return steps


def test_work_within_its_bound_is_left_alone() -> None:
    with Bound(5.0, ALL).enforced():
        assert busy(0.05)
    # Nor is what follows, of which nothing is watched any more.
    assert busy(0.5)


def test_work_that_goes_on_for_long_is_ended() -> None:
    begin = time.thread_time()
    with pytest.raises(Exceeded), Bound(0.1, ALL).enforced():
        busy(20.0)
    assert time.thread_time() - begin < 5.0
    assert busy(0.3)


def test_waiting_is_no_work() -> None:
    """Nor is what other threads do: a busy machine changes no answer."""
    other = threading.Thread(target=busy, args=(0.6,))
    other.start()
    with Bound(0.3, ALL).enforced():
        time.sleep(0.6)
    other.join()


def test_compiling_is_no_work() -> None:
    """A kernel within a kernel counts once; work after it counts."""
    begin = time.thread_time()
    with Bound(0.4, ALL).enforced(), event.trigger_event("numba:compile"):
        busy(0.5)
        with event.trigger_event("numba:compile"):
            busy(0.5)
    assert time.thread_time() - begin > 1.0

    def go_on() -> None:
        with event.trigger_event("numba:compile"):
            busy(0.5)
        busy(20.0)

    with pytest.raises(Exceeded), Bound(0.4, ALL).enforced():
        go_on()
    assert time.thread_time() - begin < 5.0


def test_work_that_fills_the_memory_is_ended() -> None:
    held = []

    def fill() -> None:
        for _ in range(40):
            held.append(np.ones(32 << 20, np.uint8))
            busy(0.1)

    with pytest.raises(Exceeded), Bound(60.0, 600 << 20).enforced():
        fill()
    assert len(held) < 40


def test_memory_that_the_process_held_before_is_not_counted() -> None:
    """A notebook with a large array open gets the answers of the command line."""
    before = np.ones(600 << 20, np.uint8)
    excluded = Runtime().excluded_bytes
    assert excluded > 300 << 20
    with Bound(5.0, 500 << 20, excluded).enforced():
        busy(0.5)
    with pytest.raises(Exceeded), Bound(5.0, 500 << 20).enforced():
        busy(3.0)
    assert before.all()


def test_others_who_try_several_ways_do_not_go_on() -> None:
    def stubborn() -> None:
        while True:
            try:
                busy(10.0)
            except Exception:
                continue

    with pytest.raises(Exceeded), Bound(0.1, ALL).enforced():
        stubborn()
