"""Kill -9, and Ctrl-C, at random moments."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator

from faults import Outcome
from faults.bench import STAGES, Bench
from faults.forks import PATIENCE_S, Command, Ended

MAIN = "from pixcal_cli.__main__ import main; main()"
"""What the shell command does."""
LOADING_S = 1.5
LONGER = 1.1
"""Moments are drawn from as long as the undisturbed command takes, and a little more."""


def kill(bench: Bench, stage: str, times: int) -> Outcome:
    """Kill a command at random moments, repeatedly until it completes; then start over.

    Its results, and those of earlier stages, must be as without a fault.
    """
    outcome = Outcome("kill -9 at a random moment")
    for again in _disturbed(bench, stage, times, signal.SIGKILL):
        assert again.code == -signal.SIGKILL
        assert again.err == ""
        outcome.ends["resumed"] += 1
    return outcome


def interrupt(bench: Bench, stage: str, times: int) -> Outcome:
    """The same with Ctrl-C: one line, exit code 1."""
    outcome = Outcome("Ctrl-C at a random moment")
    for again in _disturbed(bench, stage, times, signal.SIGINT):
        again.refused(1, "interrupted; run the same command again to resume")
        outcome.ends["one line, exit 1; resumed"] += 1
    return outcome


def loading(bench: Bench, stage: str, times: int) -> Outcome:
    """Ctrl-C in the first second and a half of a new interpreter, while it loads its libraries.

    In the first hundredths of a second, before pixcal is reached, Python itself answers.
    """
    outcome = Outcome(f"Ctrl-C in the first {LOADING_S} s, while libraries load")
    rng = bench.rng("loading", stage)
    while outcome.tried < times:
        run = bench.before(stage, "loading")
        line = [sys.executable, "-Xfaulthandler", "-c", MAIN]
        line += [*bench.command(stage, run), "--quiet"]
        # A shell that starts us in the background may have it ignored.
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        with subprocess.Popen(line, **streams, text=True) as process:
            signal.signal(signal.SIGINT, before)
            time.sleep(rng.uniform(0, LOADING_S))
            process.send_signal(signal.SIGINT)
            try:
                _, said = process.communicate(timeout=PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGABRT)  # which prints where all threads are
                raise AssertionError(f"hangs: {process.communicate()[1]}") from None
        if process.returncode == 0:
            continue  # over before: not counted
        if said.startswith("pixcal: "):
            Ended(process.returncode, "", said, 0.0).refused(1, "interrupted; run the same")
            end = "one line, exit 1; resumed"
        else:
            assert "pixcal_cli" not in said, said
            assert {f.name for f in run.iterdir()} == set(STAGES[: STAGES.index(stage)])
            end = "Python had not started pixcal"
        bench.assert_resumed(run, stage)
        outcome.ends[end] += 1
    return outcome


def _disturbed(bench: Bench, stage: str, times: int, number: signal.Signals) -> Iterator[Ended]:
    rng = bench.rng(stage)
    begun, disturbed, longest = 0, 0, bench.seconds[stage]
    while disturbed < times:
        begun += 1
        assert begun < 10 * times, "the signal has no effect"
        run = bench.before(stage, f"{stage}-{number.name}")
        for _ in range(6):
            command = Command(bench.command(stage, run))
            time.sleep(rng.uniform(0, LONGER * longest))
            command.send(number)
            ended = command.end()
            if ended.code == 0:
                longest = ended.seconds  # over before: not counted
                break
            disturbed += 1
            yield ended
            if disturbed == times:
                break
        bench.assert_resumed(run, stage)
