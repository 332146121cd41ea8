"""Power of the diagnosis: how often each effect is named, by its strength, and false causes.

Every acquisition has a different detector, with no effect or with one at 0.3 to 10 times its
threshold: the strength that gives about four sigma on half of the frames. All effects are
candidates::

    python benchmarks/power.py --draws 2 --nominal 40 --out power.jsonl [EFFECT ...]

Each acquisition takes about a minute of processor time. ``--out`` keeps a line of JSON for each; an
interrupted study resumes.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.random import default_rng

import pixcal
from blind_examination.strengths import variants_of
from study import bench, reduced, run_study

STRENGTHS = (0.3, 1.0, 3.0, 10.0)  # times the threshold
Case = tuple[str, float, int]  # effect ("" for none), strength, number of the draw


def examine(case: Case) -> dict[str, Any]:
    """Simulate and diagnose one acquisition."""
    name, strength, draw = case
    seed = 5000 + 10 * draw
    plain = bench(seed)
    if name:
        seed += 100_000
        variants = variants_of()[name]
        variant = variants[(draw + STRENGTHS.index(strength)) % len(variants)]
        drawn = variant.make(strength * variant.threshold("small"), default_rng(seed))
        plain = bench(seed) | {"effects": {name: drawn}}
    with reduced(plain) as run:
        pixcal.diagnose(run)
        diagnosis = json.loads((run / "products" / "diagnosis.json").read_text(encoding="utf-8"))
    own = [c.get("sigmas") for c in diagnosis["candidates"] if c["effect"] == name]
    return {
        "effect": name,
        "strength": strength,
        "draw": draw,
        "verdict": diagnosis["verdict"],
        "causes": [cause["effect"] for cause in diagnosis["causes"]],
        "sigmas": next(iter(own), None),
    }


def table(results: Sequence[dict[str, Any]]) -> str:
    """Markdown: effects named of those drawn (median significance), and false causes."""
    head = ("effect", *(f"{s:g} × threshold" for s in STRENGTHS), "false causes")
    rows: list[tuple[str, ...]] = []
    for name in sorted({r["effect"] for r in results} - {""}):
        own = [r for r in results if r["effect"] == name]
        cells = [_named([r for r in own if r["strength"] == s], name) for s in STRENGTHS]
        false = sum(any(c != name for c in r["causes"]) for r in own)
        rows.append((name, *cells, f"{false} of {len(own)}"))
    nominal = [r for r in results if not r["effect"]]
    if nominal:
        gaps = sum(r["verdict"] != "no gap" for r in nominal)
        false = sum(bool(r["causes"]) for r in nominal)
        note = f"a gap in {gaps} of {len(nominal)}"
        rows.append(("none", note, *("" for _ in STRENGTHS[1:]), f"{false} of {len(nominal)}"))
    lines = ["| " + " | ".join(row) + " |" for row in (head, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def _named(results: Sequence[dict[str, Any]], name: str) -> str:
    if not results:
        return "–"
    sigmas = sorted(r["sigmas"] or 0.0 for r in results)
    named = sum(name in r["causes"] for r in results)
    return f"{named} of {len(results)} ({sigmas[len(sigmas) // 2]:.1f} σ)"


def main() -> None:
    """Examine all cases, two at a time, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("effects", nargs="*", help="all, if not said")
    parser.add_argument("--draws", type=int, default=2, help="of each effect and strength")
    parser.add_argument("--nominal", type=int, default=40, help="acquisitions without an effect")
    parser.add_argument("--strengths", type=float, nargs="*", choices=STRENGTHS, default=STRENGTHS)
    parser.add_argument("--out", type=Path, default=Path("work", "power.jsonl"))
    options = parser.parse_args()
    names = options.effects or sorted(variants_of())
    cases: list[Case] = [("", 0.0, draw) for draw in range(options.nominal)]
    cases += [(n, s, d) for d in range(options.draws) for s in options.strengths for n in names]
    results = run_study(
        examine, cases, lambda r: (r["effect"], r["strength"], r["draw"]), options.out
    )
    print(table(results))


if __name__ == "__main__":
    main()
