"""Examination on simulated cameras without fringes: right causes, gain, read noise, masks, time.

Every draw is made by ``second_bench.sensors``, which shares no code with pixcal, and run without a
report, all in this process::

    python benchmarks/sensors.py --draws 8 --seed 1 --out /tmp/sensors [KIND ...]

Time is that of the processors. ``--out`` keeps a line of JSON for each draw.
"""

import argparse
import json
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import pixcal
from second_bench.sensors import KINDS, make, write

GAIN_WITHIN, NOISE_WITHIN, MASK_WITHIN = 0.01, 0.01, 1e-3
LINES = ("row", "column")


def examine(
    kind: str, seed: int, folder: Path, options: dict[str, Any], diagnose: bool
) -> dict[str, Any]:
    """Simulate, run and mark one draw."""
    acquisition, run = folder / "acq", folder / "run"
    sensor, truth = make(kind, seed, **options)
    write(sensor, acquisition)
    marks = {"kind": kind, "seed": seed}
    marks |= {key: truth[key] for key in ("ladder", "bits", "drawn")}
    marks["e_per_adu"], marks["noise_e"] = round(truth["gain"], 3), round(truth["read_noise_e"], 3)
    before = time.process_time()
    try:
        pixcal.ingest(acquisition, run)
        pixcal.reduce(run)
        if diagnose:
            pixcal.diagnose(run)
    except Exception as error:  # every failure of a draw is a result
        return marks | {"cpu_s": 0.0, "failed": f"{type(error).__name__}: {error}"[-400:]}
    marks["cpu_s"] = round(time.process_time() - before, 1)
    return marks | mark(run, truth)


def mark(run: Path, truth: dict[str, Any]) -> dict[str, Any]:
    """Results of a run next to the truth."""
    opened = pixcal.open_run(run)
    figures = opened.reduction["figures_of_merit"]

    def value(name: str) -> float:
        found = figures.get(name, {}).get("value")
        return float("nan") if found is None else float(found)

    # The drawn read noise is that of single pixels.
    shared = sum(figures.get(f"{line}_noise", {}).get("value", 0.0) ** 2 for line in LINES)
    noise = np.sqrt(max(value("read_noise") ** 2 - shared, 0.0))

    mask = np.asarray(opened.detector["mask"]) != 0
    true = np.zeros(mask.size, np.bool_)
    true[truth["defects"]] = True
    mask.ravel()[truth["unclear"]] = True
    true[truth["unclear"]] = True
    error = figures["conversion_gain"]["error"] or float("nan")
    return {
        **_diagnosis(run / "products" / "diagnosis.json", truth["causes"]),
        "gain_error": round(error / truth["gain"], 5),
        "gain_off": round(value("conversion_gain") / truth["gain"] - 1, 5),
        "noise_off": round(noise / truth["read_noise_e"] - 1, 5),
        "missed": round(float((true & ~mask.ravel()).mean()), 6),
        "false": round(float((mask.ravel() & ~true).mean()), 6),
    }


def _diagnosis(file: Path, causes: list[list[str]] | None) -> dict[str, Any]:
    """Causes named, and whether they match the expected ones; None: any is wrong.

    A cause also matches by an effect that it is said to be indistinguishable from.
    """
    if not file.exists():
        return {"right": False}
    found = json.loads(file.read_text())
    causes_named = found["causes"]
    named = [cause["effect"] for cause in causes_named]
    alike = {name for cause in causes_named for name in cause["not_told_apart_from"]}
    if causes is None:
        right = not named
    elif not causes:
        right = found["verdict"] == "no gap"
    else:
        right = len(named) == len(causes) and all({*named, *alike} & set(one) for one in causes)
    return {
        "right": right,
        "verdict": found["verdict"],
        "named": named,
        "alike": sorted(alike),
        "p": [cause["p_value"] for cause in found["causes"]],
        "parameters": [[cause["parameters"], cause["uncertainty"]] for cause in found["causes"]],
        "where": [w["statistic"] for w in found["gap"].get("where", [])][:4],
    }


def table(lines: list[dict[str, Any]]) -> str:
    """Counts by kind."""
    rows = ["kind | draws | cause right | gain | read noise | mask | failed | CPU s, largest"]
    rows.append(" | ".join(["---"] * 8))
    for kind in dict.fromkeys(line["kind"] for line in lines):
        own = [line for line in lines if line["kind"] == kind]
        ran = [line for line in own if "failed" not in line]
        rows.append(
            f"{kind} | {len(own)} | {sum(n['right'] for n in ran)} | "
            f"{sum(abs(n['gain_off']) < GAIN_WITHIN for n in ran)} | "
            f"{sum(abs(n['noise_off']) < NOISE_WITHIN for n in ran)} | "
            f"{sum(n['missed'] + n['false'] <= MASK_WITHIN for n in ran)} | "
            f"{len(own) - len(ran)} | {max(n['cpu_s'] for n in own):.0f}"
        )
    return "\n".join(rows)


def main() -> None:
    """Examine kinds, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*")
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", nargs=2, type=int, default=(257, 383))
    parser.add_argument("--bias", type=int, default=0)
    parser.add_argument("--flats", type=int, default=0)
    parser.add_argument("--ladder")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--no-diagnose",
        action="store_false",
        dest="diagnose",
        help="gain, read noise and masks only",
    )
    parser.add_argument("--keep", action="store_true", help="keep frames and runs")
    asked = parser.parse_args()
    counts = asked.bias, asked.flats
    options = {"shape": tuple(asked.size), "ladder": asked.ladder, "counts": counts}
    asked.out.mkdir(parents=True, exist_ok=True)
    lines = []
    for kind in asked.kinds or KINDS:
        for seed in range(asked.seed, asked.seed + asked.draws):
            folder = Path(tempfile.mkdtemp(prefix=f"{kind}-{seed}-", dir=asked.out))
            lines.append(examine(kind, seed, folder, options, asked.diagnose))
            print(json.dumps(lines[-1]), flush=True)
            with (asked.out / "draws.jsonl").open("a") as file:
                file.write(json.dumps(lines[-1]) + "\n")
            if not asked.keep:
                shutil.rmtree(folder)
    print(table(lines))


if __name__ == "__main__":
    main()
