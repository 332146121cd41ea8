"""Memory is decided before anything is read, and refused with both numbers."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pixcal.engine.plan import BASE_BYTES, Plan, make_plan
from pixcal.engine.run import Runtime
from pixcal.model.errors import InputError, PlanError

MIB = 1 << 20


def test_the_total() -> None:
    assert Plan(3, 5, 7).total == BASE_BYTES + 5 + 7 * 3


@given(
    task=st.integers(0, 1 << 34),
    shared=st.integers(0, 1 << 34),
    workers=st.integers(1, 64),
    memory=st.integers(1, 1 << 36),
)
def test_as_many_workers_as_fit(task: int, shared: int, workers: int, memory: int) -> None:
    runtime = Runtime("threads", workers, memory)
    try:
        plan = make_plan("the work", task, shared, runtime)
    except PlanError:
        assert BASE_BYTES + shared + task > memory
        return
    assert 1 <= plan.workers <= workers
    assert plan.total <= memory
    if plan.workers < workers:
        assert BASE_BYTES + shared + (plan.workers + 1) * task > memory


def test_too_little_memory_is_refused_with_both_numbers() -> None:
    runtime = Runtime("threads", 4, 600 * MIB)
    with pytest.raises(PlanError) as caught:
        make_plan("the fit of vertical", 100 * MIB, 1000 * MIB, runtime)
    need = BASE_BYTES // MIB + 1100
    assert str(caught.value) == (
        f"--memory: the fit of vertical needs {need} MiB, but the limit is 600 MiB"
    )
    assert isinstance(caught.value, InputError), "so that the exit code is 2"


def test_sync_has_one_worker() -> None:
    assert make_plan("it", MIB, 0, Runtime("sync", 8)).workers == 1


def test_every_process_has_an_interpreter_of_its_own() -> None:
    runtime = Runtime("processes", 4, 2 * BASE_BYTES + 3 * MIB)
    assert make_plan("it", MIB, MIB, runtime).workers == 1
    assert make_plan("it", MIB, MIB, Runtime("threads", 4, runtime.memory)).workers == 4


def test_fewer_workers_than_asked_for_are_told_once(capsys: pytest.CaptureFixture[str]) -> None:
    runtime = Runtime("processes", 3, 2 * BASE_BYTES + 3 * MIB, quiet=False)
    for _ in range(2):
        assert make_plan("half of it", MIB, MIB, runtime).workers == 1
    told = capsys.readouterr().err
    assert told == (
        f"half of it: --memory of {2 * BASE_BYTES // MIB + 3} MiB allows 1 of 3 workers; "
        f"all need {4 * BASE_BYTES // MIB + 4} MiB\n"
    )
    make_plan("the other half", MIB, MIB, Runtime("processes", 3, runtime.memory))
    make_plan("all of it", MIB, MIB, Runtime("threads", 3, runtime.memory, quiet=False))
    assert not capsys.readouterr().err
