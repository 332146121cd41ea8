"""``python -m second_bench CASE --seed N --out ACQ --truth FILE``."""

import argparse
import json
import sys
from pathlib import Path

import second_bench
from second_bench.cases import CaseError, make_case
from second_bench.effects import LAWS
from second_bench.model import MARGIN
from second_bench.ordinary import VARIATIONS, Layout
from second_bench.writing import write_acquisition, write_truth


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "second_bench",
        description=second_bench.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("case", nargs="?", help="ordinary, an effect, or effects joined by '+'")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder of the acquisition; none: truth alone")
    parser.add_argument("--truth", type=Path, help="file of the truth (JSON)")
    parser.add_argument("--strength", type=float, help="0 (barely visible) to 1 (strong)")
    parser.add_argument("--bench", choices=("ordinary", "plain"), default="ordinary")
    parser.add_argument(
        "--size", type=int, nargs=2, default=(128, 128), metavar=("ROWS", "COLUMNS")
    )
    parser.add_argument("--frames", type=int, default=600, help="of each fringe set")
    parser.add_argument("--bias", type=int, default=40)
    parser.add_argument("--flats", type=int, default=40)
    parser.add_argument("--darks", type=int, default=0, help="of one second")
    parser.add_argument("--sets", type=int, choices=(1, 2), default=2, help="of fringes")
    parser.add_argument("--list", action="store_true", help="list the cases")
    parser.add_argument("--json", action="store_true", help="list them for programs")
    return parser


def _show_cases(as_json: bool) -> None:
    facts = ("effect", "name", "weak", "strong", "unit", "known", "decidable", "needs")
    laws = [{name: getattr(law, name) for name in facts} for law in LAWS]
    if as_json:
        print(json.dumps({"variations": [*VARIATIONS], "laws": laws}))
        return
    print(*(f"ordinary/{name}" for name in VARIATIONS), sep="\n")
    for law in LAWS:
        known = "" if law.known else " (not known to pixcal)"
        print(f"{law.effect}/{law.name}: {law.weak:g} to {law.strong:g} {law.unit}{known}")


def main(arguments: list[str] | None = None) -> int:
    """Make one acquisition; gives the exit code."""
    parser = _parser()
    asked = parser.parse_args(arguments)
    if asked.list:
        _show_cases(asked.json)
        return 0
    if not (asked.case and asked.truth):
        parser.error("CASE and --truth are needed")
    if asked.out and asked.out.exists():
        parser.error(f"--out {asked.out}: exists already; choose another folder")
    if asked.out and asked.truth.resolve().is_relative_to(asked.out.resolve()):
        parser.error(f"--truth {asked.truth}: inside {asked.out}; keep the truth apart")
    shape = asked.size[0] + 2 * MARGIN, asked.size[1] + 2 * MARGIN
    layout = Layout(shape, asked.frames, asked.bias, asked.darks, asked.flats, asked.sets)
    plain = asked.bench == "plain"
    try:
        bench, truth = make_case(asked.case, asked.seed, layout, asked.strength, plain)
    except CaseError as error:
        parser.error(str(error))
    except ModuleNotFoundError as error:
        parser.error(f"{asked.case}: needs {error.name}; pip install 'pixcal[second-bench]'")
    if asked.out:
        from second_bench.camera import record  # here: HCIPy takes seconds to import

        write_acquisition(bench, record(bench), asked.out)
    write_truth(asked.truth, truth, bench)
    return 0


if __name__ == "__main__":
    sys.exit(main())
