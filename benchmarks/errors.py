"""Whether the errors of measured parameters are true: deviations from what was simulated.

Every acquisition is of another detector with one effect, at some times the strength that half of
its frames show at about four sigma. All of its frames are looked at, as a diagnosis does after the
search::

    python benchmarks/errors.py --draws 8 --out errors.jsonl [EFFECT ...]

Prints by effect how many parameters lie within one error (68 % of true ones), and the largest
deviation. ``--out`` keeps a line of JSON for each acquisition; an interrupted study goes on where
it stopped.
"""

import argparse
import json
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.random import default_rng

import pixcal
from blind_examination.parameters import check_parameters
from blind_examination.strengths import VARIANTS
from pixcal.effects import known_effects
from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.config import to_plain
from pixcal.stages.evidence import load_evidence
from power import bench

# words in the names of parameters that are roots of measured variances
ROOTS = ("rms", "walk", "jitter", "vibration", "polarisation", "spread", "width_px", "amplitude")
FAR = 5.0  # errors beyond which no parameter should be
Case = tuple[int, float, int]  # number of the variant, strength over its threshold, draw


def examine(case: Case) -> dict[str, Any]:
    """Simulate one acquisition and measure its effect."""
    number, times, draw = case
    variant = VARIANTS[number]
    seed = 300_000 + 1000 * number + draw
    true = variant.make(times * variant.small, default_rng(seed))
    marks = {"variant": number, "effect": variant.effect, "strength": variant.strength,
             "times": times, "draw": draw}  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        file, acquisition, run = (Path(folder, n) for n in ("bench.yaml", "acq", "run"))
        plain = bench(seed) | {"effects": {variant.effect: true}}
        file.write_text(yaml.safe_dump(plain), encoding="utf-8")
        pixcal.simulate(file, acquisition)
        for step in (partial(pixcal.ingest, acquisition), pixcal.reduce, pixcal.fit):
            step(run)
        found = known_effects()[variant.effect].estimate(load_evidence(run))
    if found is None:
        return marks | {"sigmas": None, "parameters": {}}
    checks = check_parameters(variant.effect, true, to_plain(found.effect), found.errors)
    parameters = {c.name: [c.true, c.estimate, c.error] for c in checks if c.error > 0}
    return marks | {"sigmas": found.significance, "parameters": parameters}


def deviation(name: str, true: float, estimate: float, error: float) -> float:
    """Of a parameter, over its error; of standard deviations that of the variance."""
    if not any(word in name for word in ROOTS):
        return (estimate - true) / error
    # The error is the longer side of the root of the variance's interval.
    ends = (estimate - error, estimate) if error < estimate else (estimate, estimate + error)
    return (estimate**2 - true**2) / (ends[1] ** 2 - ends[0] ** 2)


def deviations(results: Sequence[dict[str, Any]]) -> dict[str, list[float]]:
    """By parameter; without those that are at zero and measured there."""
    found: dict[str, list[float]] = {}
    for one in results:
        for name, (true, estimate, error) in one["parameters"].items():
            if true or estimate:
                found.setdefault(name, []).append(deviation(name, true, estimate, error))
    return found


def table(results: Sequence[dict[str, Any]]) -> str:
    """Markdown, by variant."""
    lines = ["| effect | parameter | values | within one error | rms | largest, errors |"]
    lines.append("|---" * 6 + "|")
    every: list[float] = []
    for number in sorted({r["variant"] for r in results}):
        own = [r for r in results if r["variant"] == number]
        title = f"{own[0]['effect']}: {own[0]['strength']}"
        for name, off in deviations(own).items():
            every += off
            lines.append(f"| {title} | {name} | {_cells(off)} |")
    far = sum(abs(d) > FAR for d in every)
    return "\n".join([*lines, f"| all | {far} beyond {FAR:g} | {_cells(every)} |"])


def _cells(off: Sequence[float]) -> str:
    size = np.abs(off)
    if not size.size:
        return "0 | | |"
    within, rms = 100 * (size <= 1).mean(), np.sqrt((size**2).mean())
    return f"{size.size} | {within:.0f} % | {rms:.2f} | {size.max():.1f}"


def main() -> None:
    """Examine all cases and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("effects", nargs="*", help="all, if not said")
    parser.add_argument("--draws", type=int, default=8, help="of each variant")
    parser.add_argument("--times", type=float, default=5.0, help="strength over the threshold")
    parser.add_argument("--out", type=Path, default=Path("work", "errors.jsonl"))
    options = parser.parse_args()
    cases: list[Case] = [
        (n, options.times, draw)
        for draw in range(options.draws)
        for n, variant in enumerate(VARIANTS)
        if not options.effects or variant.effect in options.effects
    ]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.touch()
    results = [json.loads(line) for line in options.out.read_text("utf-8").splitlines()]
    known = {(r["variant"], r["times"], r["draw"]) for r in results}
    pending = [case for case in cases if case not in known]
    with options.out.open("a", encoding="utf-8") as lines:

        def keep(_: int, result: dict[str, Any]) -> None:
            results.append(result)
            print(json.dumps(result), file=lines, flush=True)

        runtime = Runtime(cluster="processes", quiet=False)
        run_tasks(examine, pending, runtime, label="acquisitions", done=keep)
    print(table(results))


if __name__ == "__main__":
    main()
