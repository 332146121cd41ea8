"""Several processes at the same time on one run."""

import time
from collections import Counter

from faults import Outcome
from faults.bench import STAGES, Bench
from faults.forks import Command


def together(bench: Bench, times: int) -> Outcome:
    """Begin three commands on one run at almost the same time; each does its work or is refused."""
    outcome = Outcome("three commands on one RUN at the same time")
    rng = bench.rng("together")
    for number in range(times):
        stage = STAGES[number % len(STAGES)]
        run = bench.before(stage, "together")
        # Two of the same, and one that would change what they read or write.
        others = [stage, stage, rng.choice(STAGES[: STAGES.index(stage) + 1])]
        commands = []
        for other in others:
            commands.append(Command(bench.command(other, run)))
            time.sleep(rng.uniform(0, 0.5) * bench.seconds[stage])
        ends: Counter[str] = Counter()
        for command in commands:
            ended = command.end()
            if ended.code == 0:
                ends["done or up to date"] += 1
                continue
            ended.refused(2, f"{run}: another pixcal is working there; wait for it")
            ends["one line, exit 2"] += 1
        assert ends["done or up to date"] > 0
        bench.assert_resumed(run, stage)
        outcome.ends += ends
    return outcome
