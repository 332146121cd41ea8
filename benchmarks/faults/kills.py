"""Kill -9, and Ctrl-C, at random moments."""

import random
import signal
import time
from collections.abc import Iterator

from faults import Outcome
from faults.bench import STAGES, Bench
from faults.forks import Command, Ended, pixcal

LONGER = 1.1
"""Moments are drawn from as long as the undisturbed command takes, and a little more."""


def kill(bench: Bench, stage: str, times: int, seed: int) -> Outcome:
    """Kill a command at random moments, again and again until it ends by itself; begin anew.

    All that is left, and what earlier stages left, must be as without a fault.
    """
    outcome = Outcome(f"kill -9 of `{stage}` at a random moment")
    for again in _disturbed(bench, stage, times, seed, signal.SIGKILL):
        assert again.code == -signal.SIGKILL
        assert again.err == ""
        outcome.ends["resumed, bit-identical"] += 1
    return outcome


def interrupt(bench: Bench, stage: str, times: int, seed: int) -> Outcome:
    """The same with Ctrl-C: one line, exit code 1."""
    outcome = Outcome(f"Ctrl-C in `{stage}` at a random moment")
    for again in _disturbed(bench, stage, times, seed, signal.SIGINT):
        again.refused(1, "interrupted; run the same command again to resume")
        outcome.ends["one line, exit 1, resumed, bit-identical"] += 1
    return outcome


def _disturbed(
    bench: Bench, stage: str, times: int, seed: int, number: signal.Signals
) -> Iterator[Ended]:
    rng = random.Random(f"{stage} {seed}")
    earlier = STAGES[: STAGES.index(stage)]
    begun, disturbed, longest = 0, 0, bench.seconds[stage]
    while disturbed < times:
        begun += 1
        assert begun < 10 * times, "the signal has no effect"
        run = bench.copy(f"{stage}-{number.name}", *earlier)
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
        pixcal(*bench.command(stage, run)).succeeded()
        bench.assert_same(run, *earlier, stage)
