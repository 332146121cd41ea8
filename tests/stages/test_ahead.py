"""Kernels that another process compiles while a first run reads its frames."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import pixcal
from pixcal.engine.run import Runtime
from pixcal.stages import ahead
from pixcal.stages.ahead.__main__ import KERNELS


class Started:
    """Stands for a process: what happened to it."""

    def __init__(self, log: list[str], command: list[str]) -> None:
        log.append(command[-1])
        self.log = log

    def __enter__(self) -> "Started":
        return self

    def __exit__(self, *_: object) -> None:
        self.log.append("waited for")

    def terminate(self) -> None:
        self.log.append("ended")


@pytest.mark.parametrize(
    ("kept", "workers", "load", "before", "starts"),
    [
        (True, 2, 0.5, False, True),
        (True, 2, 0.5, True, False),
        (True, 2, 1.5, False, False),
        (True, 1, 0.0, False, False),
        (False, 2, 0.5, False, False),
    ],
)
def test_a_process_is_started_where_it_is_of_use_and_ends_with_the_run(
    kept: bool,
    workers: int,
    load: float,
    before: bool,
    starts: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    log: list[str] = []

    def popen(command: list[str], **_: Any) -> Started:
        return Started(log, command)

    monkeypatch.setattr(ahead, "KEPT", kept)
    monkeypatch.setattr(ahead, "_compiled_before", lambda: before)
    monkeypatch.setattr(ahead.subprocess, "Popen", popen)
    monkeypatch.setattr(ahead.os, "getloadavg", lambda: (load, 9.0, 9.0))
    with suppress(KeyError), ahead.compiled_ahead(Runtime(workers=workers)):
        log.append("run")
        raise KeyError
    own = ["pixcal.stages.ahead", "run", "ended", "waited for"]
    assert log == (own if starts else ["run"])


@pytest.mark.long
def test_a_run_calls_every_kernel_with_the_types_that_it_is_compiled_for(tmp_path: Path) -> None:
    pixcal.run(pixcal.sample_acquisition(), tmp_path / "demo")
    unused = [kernel.__name__ for kernel, types in KERNELS if types not in kernel.signatures]
    assert unused == []
    assert ahead._compiled_before()
