"""Whether the errors of measured parameters are right: deviations from the simulated values.

Every acquisition has a different detector and one effect, several times as strong as needed for
four sigma on half of its frames. All of its frames are used, as by a diagnosis after the search::

    python benchmarks/errors.py --draws 8 --out errors.jsonl [EFFECT ...]

Prints by kind of effect how many parameters are within one error (68 % expected), and the largest
deviation. ``--out`` keeps a line of JSON for each acquisition; an interrupted study resumes.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import default_rng

import pixcal
from blind_examination.parameters import check_parameters
from blind_examination.strengths import VARIANTS
from pixcal.effects import known_effects
from pixcal.model.config import to_plain
from pixcal.stages.evidence import load_evidence
from study import bench, reduced, run_study

PAGE = Path(__file__).parents[1] / "docs/appendix/errors.md"
# words in the names of parameters that are roots of measured variances
ROOTS = ("rms", "walk", "jitter", "vibration", "polarisation", "spread", "width_px", "amplitude")
Case = tuple[int, float, int]  # number of the variant, strength over its threshold, draw


def examine(case: Case) -> dict[str, Any]:
    """Simulate one acquisition and measure its effect."""
    number, times, draw = case
    variant = VARIANTS[number]
    seed = 300_000 + 1000 * number + draw
    true = variant.make(times * variant.small, default_rng(seed))
    marks = {
        "variant": number,
        "effect": variant.effect,
        "strength": variant.strength,
        "times": times,
        "draw": draw,
    }
    with reduced(bench(seed) | {"effects": {variant.effect: true}}) as run:
        pixcal.fit(run)
        found = known_effects()[variant.effect].estimate(load_evidence(run))
    if found is None:
        return marks | {"sigmas": None, "by_law": False, "parameters": {}}
    checks = check_parameters(variant.effect, true, to_plain(found.effect), found.errors)
    parameters = {c.name: [c.true, c.estimate, c.error] for c in checks if c.error > 0}
    marks |= {"sigmas": found.significance, "by_law": bool(found.law)}
    return marks | {"parameters": parameters}


def deviation(name: str, true: float, estimate: float, error: float) -> float:
    """Deviation of a parameter over its error; of the variance, not its root, if zero."""
    if true or not any(word in name for word in ROOTS):
        return (estimate - true) / error
    # The error is the longer side of the root of the variance's interval.
    low, high = (estimate - error, estimate) if error < estimate else (estimate, estimate + error)
    return estimate**2 / (high**2 - low**2)


def deviations(results: Sequence[dict[str, Any]]) -> list[tuple[float, str]]:
    """Of all parameters, by name, except those that are zero and were measured as zero.

    Parameters described by another law are excluded too.
    """
    return [
        (deviation(name, true, estimate, error), name)
        for one in results
        for name, (true, estimate, error) in one["parameters"].items()
        if estimate or (true and not one["by_law"])
    ]


def table(results: Sequence[dict[str, Any]]) -> str:
    """Markdown, by kind of effect."""
    lines = ["| effect | values | within one error | rms | largest, errors |"]
    lines.append("|---" * 5 + "|")
    for number in sorted({r["variant"] for r in results}):
        own = [r for r in results if r["variant"] == number]
        lines.append(_row(f"{own[0]['effect']}: {own[0]['strength']}", deviations(own)))
    return "\n".join([*lines, _row("all", deviations(results))])


def _row(title: str, off: Sequence[tuple[float, str]]) -> str:
    if not off:
        return f"| {title} | 0 | | | |"
    size = np.abs([value for value, _ in off])
    largest = off[int(np.argmax(size))][1]
    within, rms = 100 * (size <= 1).mean(), np.sqrt((size**2).mean())
    return f"| {title} | {len(off)} | {within:.0f} % | {rms:.2f} | {size.max():.1f} (`{largest}`) |"


def main() -> None:
    """Examine all cases and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("effects", nargs="*", help="all, if not said")
    parser.add_argument("--draws", type=int, default=8, help="of each variant")
    parser.add_argument("--times", type=float, default=5.0, help="strength over the threshold")
    parser.add_argument("--out", type=Path, default=Path("work", "errors.jsonl"))
    parser.add_argument("--write", action="store_true", help="write docs/appendix/errors.md")
    options = parser.parse_args()
    cases: list[Case] = [
        (n, options.times, draw)
        for draw in range(options.draws)
        for n, variant in enumerate(VARIANTS)
        if not options.effects or variant.effect in options.effects
    ]
    results = run_study(
        examine, cases, lambda r: (r["variant"], r["times"], r["draw"]), options.out
    )
    print(table(results))
    if options.write:
        text = PAGE.read_text(encoding="utf-8")
        head, rest = text[: text.index("| effect |")], text[text.index("| all |") :]
        rest = rest.partition("\n")[2]
        PAGE.write_text(f"{head}{table(results)}\n{rest}", encoding="utf-8")


if __name__ == "__main__":
    main()
