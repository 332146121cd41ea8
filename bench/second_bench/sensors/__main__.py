"""``python -m second_bench.sensors``."""

import argparse
import json
from pathlib import Path

from second_bench import sensors
from second_bench.sensors import KINDS, make, write
from second_bench.sensors.model import LADDERS


def main(arguments: list[str] | None = None) -> None:
    """Make one set of frames."""
    parser = argparse.ArgumentParser("second_bench.sensors", description=sensors.__doc__)
    parser.add_argument("kind", nargs="?", choices=KINDS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--size", type=int, nargs=2, default=(257, 383))
    parser.add_argument(
        "--ladder",
        choices=LADDERS,
        help="exposure-time steps of the flats; default: drawn from the seed",
    )
    parser.add_argument("--bias", type=int, default=0, help="bias frames; 0: drawn from the seed")
    parser.add_argument(
        "--flats",
        type=int,
        default=0,
        help="flats of one level, in addition to the exposure-time steps",
    )
    parser.add_argument("--list", action="store_true", help="list the kinds")
    asked = parser.parse_args(arguments)
    if asked.list:
        for name, own in KINDS.items():
            print(f"{name}: {own.change.__doc__} [{own.cause or 'no gap'}]")
        return
    if not (asked.kind and asked.out and asked.truth):
        parser.error("KIND, --out and --truth are needed")
    sensor, truth = make(
        asked.kind, asked.seed, tuple(asked.size), asked.ladder, (asked.bias, asked.flats)
    )
    write(sensor, asked.out)
    asked.truth.parent.mkdir(parents=True, exist_ok=True)
    asked.truth.write_text(json.dumps(truth))


if __name__ == "__main__":
    main()
