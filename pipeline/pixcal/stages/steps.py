"""Work in steps; steps already noted by an interrupted build are skipped."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from pixcal.engine.run import Runtime, run_tasks
from pixcal.storage.artefact import Workspace

T = TypeVar("T")


def run_steps(
    made: Workspace, task: Callable[[T], Any], steps: Mapping[str, T], runtime: Runtime, label: str
) -> None:
    """Run a task on each of the ``steps`` (by name), noting each in the journal once in place."""
    done = made.journal()
    names = [name for name in steps if name not in done]
    todo = [steps[name] for name in names]
    run_tasks(task, todo, runtime, label=label, done=lambda n, _: made.note(names[n]))
