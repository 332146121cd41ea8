"""What the diagnosis claims by chance, and from which strength on it finds each effect.

Every acquisition is of another detector, with nothing in it or one effect of some strength, and is
recorded, reduced and diagnosed as a user's would be. Results go to
``docs/appendix/diagnose/study.jsonl``, where an interrupted study resumes with the same code,
and tables into the page.
"""

import argparse
import hashlib
import json
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.special import ndtr
from scipy.stats import binomtest, kstest

import pixcal
from blind_examination.strengths import variants_of
from pixcal.effects import effects, parse_effects
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.diagnosis.gap import compare, flagged
from pixcal.estimators.diagnosis.test_statistics import known_statistics
from pixcal.model.bench import SCHEMA
from pixcal.model.config import to_plain
from pixcal.simulation.effect import Effect
from pixcal.stages import diagnose, ingest, reduce, simulate
from pixcal.stages.diagnose.inquiry import REFERENCES, Inquiry, inquire
from pixcal.stages.diagnose.rejection import similar_to
from pixcal.stages.diagnose.shrinkage import differing, shrinkage

OUT = Path(__file__).parents[1] / "docs" / "appendix" / "diagnose"
HERE, PROCESSES = Runtime(cluster="sync"), Runtime(cluster="processes", quiet=False)
STRENGTHS = (0.3, 1.0, 3.0, 10.0)
"""Times the threshold (`blind_examination.strengths`), of each way in turn."""
FIRST_SEED, SEEDS_APART = 5000, 10
CODE = (
    "effects", "estimators", "kernels", "model", "simulation", "stages/diagnose", "stages/fit",
    "stages/reduce", "stages/evidence.py", "stages/simulate",
)  # fmt: skip
"""Of pixcal, what a play depends on."""
MAX_WRONG = 3
"""That are named in a table."""
ALIKE = 0.05
"""By which shares of the gap may differ."""


def bench(seed: int = 9000) -> dict[str, Any]:
    """Two sets of 300 frames on 61 x 67 pixels, with bias, darks and a ladder of flats."""
    return {
        "schema": SCHEMA,
        "seed": seed,
        "detector": {
            "seed": seed + 1, "shape": [61, 67], "pitch_um": 4.4, "gain_e_per_adu": 1.0,
            "read_noise_e": 16.0, "bias_adu": 500, "bias_pixel_rms_adu": 4.0, "dark_e_s": 24.0,
            "prnu_rms": 0.01, "delta_rms_px": 2.0e-3, "hot_fraction": 0.004,
            "hot_rate_e_s": 3.0e4,
        },
        "optics": {
            "wavelength_nm": 632.8, "distance_mm": 400.0, "beam_radius_mm": 35.0,
            "visibility": 0.95,
        },
        "frames": {
            "exptime_s": 0.02, "period_s": 0.14, "per_file": 500, "bias": 60,
            "darks": [{"exptime_s": 0.5, "count": 20}],
            "flat_rate_e_s": 1.25e6,
            "flats": [{"exptime_s": 0.01 * n, "count": 20} for n in (1, 2, 3)],
            "fringes": [
                {"name": name, "baseline_mm": baseline, "count": 300, "peak_e": 45000}
                for name, baseline in (("vertical", [11.5, 0.0]), ("horizontal", [0.0, 6.4]))
            ],
        },
    }  # fmt: skip


def record(bench: dict[str, Any], folder: Path, run: Path) -> None:
    """Take the frames of a bench, and reduce them."""
    (folder / "bench.yaml").write_text(yaml.safe_dump(bench))
    simulate.run(folder / "bench.yaml", folder / "acq", simulate.Config(), HERE)
    ingest.run(folder / "acq", run, ingest.Config(copy=True), HERE)
    reduce.run(run, reduce.Config(), HERE)
    shutil.rmtree(folder / "acq")


def truth_of(name: str, strength: float, seed: int) -> tuple[Effect, ...]:
    """An effect in one of its ways, so many times as strong as its threshold."""
    ways = variants_of()[name]
    way = ways[(seed // SEEDS_APART + STRENGTHS.index(strength)) % len(ways)]
    drawn = way.make(strength * way.threshold("small"), np.random.default_rng(seed))
    return tuple(parse_effects({name: drawn}, name))


def play(folder: Path, case: tuple[str, float, int]) -> dict[str, Any]:
    """Play the reality once: name of an effect (or none), strength, seed."""
    name, strength, seed = case
    found = played_with(folder, name, strength, seed) if name else played_nominal(folder, seed)
    return {"effect": name, "strength": strength, "seed": seed, "code": code(), **found}


@cache
def code() -> str:
    """Checksum of the code that plays."""
    root, found = Path(pixcal.__file__).parent, hashlib.sha256()
    for part in CODE:
        for file in sorted((root / part).rglob("*.py")) or [root / part]:
            found.update(file.read_bytes())
    return found.hexdigest()[:12]


def played_nominal(folder: Path, seed: int) -> dict[str, Any]:
    """A detector of its own with nothing in it, diagnosed by the command."""
    with tempfile.TemporaryDirectory(dir=folder) as own:
        run = Path(own, "run")
        record(bench(seed), Path(own), run)
        diagnose.run(run, diagnose.Config(), HERE)
        diagnosis = json.loads((run / "products" / "diagnosis.json").read_text())
        curves = json.loads((run / "diagnose" / "curves.json").read_text())
    return {
        "taken": [cause["effect"] for cause in diagnosis["causes"]],
        "gap": bool(diagnosis["gap"]["total"]),
        "chances": {
            f"{c['statistic']} {c['set']}": float(ndtr(-c["significance"]))
            for c in curves
            if c["statistic"] in known_statistics() and not known_statistics()[c["statistic"]].floor
        },
        "estimates": {
            c["effect"]: float(ndtr(-c["sigmas"])) for c in diagnosis["candidates"] if "sigmas" in c
        },
    }


def played_with(folder: Path, name: str, strength: float, seed: int) -> dict[str, Any]:
    """A detector of its own with an effect, through all that the command does."""
    truth = truth_of(name, strength, seed)
    plain = bench(seed) | {"effects": {e.name: to_plain(e) for e in truth}}
    with tempfile.TemporaryDirectory(dir=folder) as own:
        record(plain, Path(own), Path(own, "run"))
        scratch = Path(own, "scratch")
        scratch.mkdir()
        return marked(inquire(Path(own, "run"), effects(), (), scratch, HERE), name, truth)


def marked(made: Inquiry, name: str, truth: tuple[Effect, ...]) -> dict[str, Any]:
    """What was found, held against the truth."""
    search, found, data = made.search, made.found, made.data
    candidates = found.candidates
    before = compare(data, search.nominal.expected)
    own = candidates[name].estimate
    result: dict[str, Any] = {
        "taken": list(found.taken),
        "alike": {taken: list(others) for taken, others in found.alike.items()},
        "gap": bool(flagged(before)),
        "sigmas": own.significance if own else None,
    }
    if name in found.taken:
        where = differing(search.nominal, found.final, data)
        told = shrinkage(data, search.nominal, found.final, where)
        result["told"] = [1 - told.gap.total, *(1 - v for v in reversed(told.interval))]
        # Of what is random a few simulations differ more than fitted and true parameters do: of
        # both as many as of the nominal bench, and none moved by the errors of its parameters.
        as_they_are = replace(made.trials, estimates={}, _made={})
        for key, on in (("closed", found.final.effects), ("closed_by_truth", truth)):
            (curves,) = as_they_are.curves([on], REFERENCES, key)
            if not isinstance(curves, str):
                trial = search.held_against(on, curves)
                left = shrinkage(data, search.nominal, trial, where).gap.total
                result[key] = 1 - left
        result["parameters"] = [to_plain(e) for e in found.final.effects if e.name == name]
        result["truth"] = [to_plain(e) for e in truth]
    if where := flagged(before):
        result["closed_by_wrong"], result["closed_by_alike"] = {}, {}
        for other, wrong in candidates.items():
            if wrong.alone is None or other == name:
                continue
            # Of which it is told that the frames do not tell it from the true one.
            alike = other in found.alike.get(name, ()) or wrong.reason == similar_to(name)
            told = shrinkage(data, search.nominal, wrong.alone, where)
            result["closed_by_alike" if alike else "closed_by_wrong"][other] = [
                1 - told.gap.total,
                1 - told.interval[1],
            ]
    return result


def nominal_table(played: Sequence[dict[str, Any]]) -> str:
    """False claims and how the chances of the statistics lie."""
    count = len(played)
    claims = sum(bool(p["taken"]) for p in played)
    gaps = sum(p["gap"] for p in played)
    chances = np.array([chance for p in played for chance in p["chances"].values()])
    share = [float(np.mean(chances < limit)) for limit in (0.1, 0.01, 0.001)]
    rows = [
        ("nominal acquisitions", count),
        ("with a claimed cause", _share(claims, count)),
        ("with a significant gap", _share(gaps, count)),
        ("statistics with p < 0.1", f"{share[0]:.3f}"),
        ("p < 0.01", f"{share[1]:.4f}"),
        ("p < 0.001", f"{share[2]:.5f}"),
        ("largest deviation from a uniform distribution (Kolmogorov-Smirnov)", _ks(chances)),
        ("statistics that deviate from it with p < 0.05", _unlike(played)),
    ]
    own = [p["estimates"] for p in played if p.get("estimates")]
    if own:
        every = np.array([chance for found in own for chance in found.values()])
        best = np.array([len(found) * min(found.values()) for found in own])
        rows += [
            ("estimates of effects with p < 0.1", f"{np.mean(every < 0.1):.3f}"),
            ("p < 0.01", f"{np.mean(every < 0.01):.4f}"),
            ("p < 0.001", f"{np.mean(every < 0.001):.5f}"),
            (
                "acquisitions whose most significant estimate has p < 0.1, corrected for the "
                "number of candidates",
                _share(int((best < 0.1).sum()), len(best)),
            ),
        ]
    return _table(("", ""), rows)


def shares_table(played: Sequence[dict[str, Any]]) -> str:
    """What the fitted parameters close of the gap, against the true ones; and what was told."""
    own = [p for p in played if {"told", "closed", "closed_by_truth"} <= p.keys()]
    held = sum(p["told"][1] - ALIKE <= p["closed_by_truth"] <= p["told"][2] + ALIKE for p in own)
    rows: list[tuple[Any, ...]] = [("acquisitions in which the effect was found", len(own))]
    for what, shares in (
        ("as told", [p["told"][0] for p in own]),
        ("with the fitted parameters as they are", [p["closed"] for p in own]),
    ):
        off = np.array(shares) - [p["closed_by_truth"] for p in own]
        far = np.argsort(-abs(off))[:MAX_WRONG]
        named = ", ".join(f"{own[n]['effect']} {off[n]:+.2f}" for n in far)
        rows += [
            (f"share closed, {what}: within {ALIKE:g} of the true effect's",
             int((abs(off) <= ALIKE).sum())),
            ("more than that below, above", f"{(off < -ALIKE).sum()}, {(off > ALIKE).sum()}"),
            ("furthest off", named),
        ]  # fmt: skip
    rows.append((f"the true effect's within {ALIKE:g} of the interval that is told", held))
    return _table(("", ""), rows)


def wrong_table(played: Sequence[dict[str, Any]]) -> str:
    """What absent effects close by themselves of the gap that another makes."""
    rows: list[tuple[Any, ...]] = []
    for what, of in (
        ("absent effects tried", "closed_by_wrong"),
        ("effects tried that the answer says look like the true one", "closed_by_alike"),
    ):
        closed = [
            (share, least, other, p["effect"])
            for p in played
            for other, (share, least) in p.get(of, {}).items()
        ]
        rows.append((what, len(closed)))
        if not closed:
            continue
        shares = np.array([share for share, *_ in closed])
        most = sorted(closed, reverse=True)[:MAX_WRONG]
        told = ", ".join(f"{other} of {name}'s {share:.2f}" for share, _, other, name in most)
        rows += [
            ("share closed: median", f"{np.median(shares):.3f}"),
            ("95 % close at most", f"{np.quantile(shares, 0.95):.3f}"),
            (
                f"close more than {ALIKE:g} by their whole interval",
                sum(least > ALIKE for _, least, *_ in closed),
            ),
            ("the most", told),
        ]
    return _table(("", ""), rows)


def strengths_table(played: Sequence[dict[str, Any]]) -> str:
    """Fitted strengths over the true ones: of those of several numbers, the part along the true.

    Of couplings the sum of their shares.
    """

    def numbers(value: Any) -> np.ndarray:
        if isinstance(value, list) and value and isinstance(value[0], dict):
            value = sum(one["share"] for one in value)
        return np.array(value or 0.0, float)

    ratios: dict[tuple[str, str], list[float]] = {}
    for p in played:
        for fitted, true in zip(p.get("parameters", ()), p.get("truth", ()), strict=True):
            for name in effects()[p["effect"]].strengths:
                own, truth = (numbers(one.get(name)) for one in (fitted, true))
                if np.any(truth):
                    ratio = float((own * truth).sum() / (truth * truth).sum())
                    ratios.setdefault((p["effect"], name), []).append(ratio)
    rows = [
        (
            effect,
            f"`{name}`",
            len(own),
            f"{np.median(own):.3f}",
            f"{min(own):.2f} to {max(own):.2f}",
        )
        for (effect, name), own in sorted(ratios.items())
    ]
    return _table(("effect", "strength", "times found", "median", "from least to most"), rows)


def _ks(chances: np.ndarray) -> str:
    """Of one acquisition many statistics hang together, so only the distance is told."""
    return f"{kstest(chances, 'uniform').statistic:.3f}"


def _unlike(played: Sequence[dict[str, Any]]) -> str:
    """A twentieth is what chance lets expect."""
    names = set.intersection(*(set(p["chances"]) for p in played))
    by_statistic = {name: [p["chances"][name] for p in played] for name in sorted(names)}
    off = [n for n, own in by_statistic.items() if kstest(own, "uniform").pvalue < 0.05]
    print("chances not uniform:", ", ".join(off))
    return f"{len(off)} of {len(by_statistic)}"


def _share(found: int, count: int) -> str:
    low, high = binomtest(found, count).proportion_ci(0.95)
    return f"{found} of {count} (95 %: {low:.1%} to {high:.1%})"


def _table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    lines = ["| " + " | ".join(map(str, row)) + " |" for row in (header, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(header), *lines[1:]])


def strangers(p: dict[str, Any]) -> list[str]:
    """Effects claimed that were not there, and not said to look like the one that was."""
    return [t for t in p["taken"] if t != p["effect"] and p["effect"] not in p["alike"].get(t, ())]


def power_table(played: Sequence[dict[str, Any]]) -> str:
    """Share of acquisitions in which each effect was found, by its strength."""
    rows = []
    for name in sorted({p["effect"] for p in played}):
        own = [p for p in played if p["effect"] == name]
        cells = []
        for strength in STRENGTHS:
            here = [p for p in own if p["strength"] == strength]
            if not here:
                cells.append("-")
                continue
            found = sum(name in p["taken"] for p in here)
            others = sum(bool(strangers(p)) for p in here)
            sigmas = np.median([p["sigmas"] or 0.0 for p in here])
            cells.append(
                f"{found}/{len(here)} ({sigmas:.1f} σ)" + (f", others {others}" if others else "")
            )
        pairs = [
            (p["told"][0], p["closed_by_truth"])
            for p in own
            if {"told", "closed_by_truth"} <= p.keys()
        ]
        off = f"{np.median([abs(a - b) for a, b in pairs]):.3f}" if pairs else "-"
        rows.append((name, *cells, off))
    header = ("effect", *(f"{s:g} × threshold" for s in STRENGTHS), "error of the gap closed")
    return _table(header, rows)


def main() -> None:
    """Play all cases, two at a time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nominal", type=int, default=40, help="acquisitions without an effect")
    parser.add_argument("--seeds", type=int, default=2, help="for each effect and strength")
    parser.add_argument("--effects", nargs="*", default=list(effects()), help="default: all")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--publish", action="store_true", help="what was played, and no more")
    options = parser.parse_args()
    names = options.effects
    rounds: list[list[tuple[str, float, int]]] = [
        [
            (name, strength, FIRST_SEED + 100_000 + SEEDS_APART * n)
            for strength in STRENGTHS
            for name in names
        ]
        for n in range(options.seeds)
    ]
    rounds[0] += [("", 0.0, FIRST_SEED + SEEDS_APART * n) for n in range(options.nominal)]
    # So that an interrupted study has some of all.
    rng = np.random.default_rng(1)
    cases = [own[n] for own in rounds for n in rng.permutation(len(own))]
    options.out.mkdir(parents=True, exist_ok=True)
    journal = options.out / "study.jsonl"
    played: list[dict[str, Any]] = []
    if journal.exists():
        # What an interrupted study has played is not played again.
        played = [json.loads(line) for line in journal.read_text().splitlines()]
        others = [p for p in played if p.get("code") != code()]
        played = [p for p in played if p.get("code") == code()]
        if others:
            print(f"{len(others)} plays of other code are left out", file=sys.stderr)
    known = {(p["effect"], p["strength"], p["seed"]) for p in played}
    pending = [case for case in cases if case not in known and not options.publish]
    with tempfile.TemporaryDirectory() as folder, journal.open("a") as lines:

        def noted(_: int, result: dict[str, Any]) -> None:
            played.append(result)
            print(json.dumps(result), file=lines, flush=True)

        run_tasks(partial(play, Path(folder)), pending, PROCESSES, label="acquisitions", done=noted)
    publish(played, options.out)


def publish(played: Sequence[dict[str, Any]], out: Path) -> None:
    """Print the tables, and put those that the page has marks for into it."""
    nothing = [p for p in played if not p["effect"]]
    something = [p for p in played if p["effect"]]
    tables = {"nominal": nominal_table(nothing)} if nothing else {}
    if something:
        tables |= {
            "power": power_table(something),
            "shares": shares_table(something),
            "strengths": strengths_table(something),
            "wrong": wrong_table(something),
        }
    page = OUT.parent / "diagnose-study.md"
    text = page.read_text(encoding="utf-8")
    for name, table in tables.items():
        start, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        print(table, "\n")
        if start in text:
            before, _, rest = text.partition(start)
            text = before + start + "\n" + table + "\n\n" + end + rest.partition(end)[2]
    if out == OUT:
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
