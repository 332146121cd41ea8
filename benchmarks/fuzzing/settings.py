"""Configuration files: wrong values at every key, and text that is no plain YAML."""

import copy
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fuzzing.laws import RUNTIME, Broken, Case, Kind, calibrate, good_input, lasting_folder, pixcal
from fuzzing.night import Night

HUGE = 10**19
WRONG: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    -1,
    1,
    2,
    1e-320,
    -1e-9,
    1e9,
    1e300,
    10**18,
    HUGE,
    10**400,
    float("nan"),
    float("inf"),
    -float("inf"),
    "",
    " ",
    "1",
    "abc",
    "1e3",
    "nan",
    "é💥",
    "\x07",
    "x" * 3000,
    "<script>alert(1)</script>",
    "%s%n",
    "{}",
    "../..",
    "a\nb",
    [],
    [1],
    [1, 2],
    [[]],
    [None],
    [1, 2, 3],
    ["a", "b"],
    {},
    {"a": 1},
    {"": {}},
    [{"a": []}],
    [0, 0],
    [1e300, 1],
)
GONE = object()
BENCH = Path(__file__).parents[2] / "tests" / "bench.yaml"
MAX_SAMPLES = 400_000
"""A bench that is right and asks for more is not simulated here: it would only take long."""

Path_ = tuple[Any, ...]


def small_bench() -> str:
    """The tests' bench with a few frames of 12 x 10 pixels and without effects."""
    text = BENCH.read_text(encoding="utf-8").partition("\neffects:")[0]
    return re.sub(r"count: \d\d", "count: 3", text.replace("[61, 83]", "[12, 10]"))


def _places(data: Any, at: Path_ = ()) -> Iterator[Path_]:
    """Paths of all keys and items, inner ones too."""
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        yield (*at, key)
        if isinstance(value, (dict, list)):
            yield from _places(value, (*at, key))


def _with(data: Any, at: Path_, value: Any) -> Any:
    """A copy with another value at a place, or without it."""
    made = copy.deepcopy(data)
    inner = made
    for key in at[:-1]:
        inner = inner[key]
    if value is GONE:
        del inner[at[-1]]
    else:
        inner[at[-1]] = value
    return made


def _choice(case: Case, data: Any) -> tuple[Path_, Any]:
    """Every place with every wrong value: as many cases as there are, in a shuffled order."""
    places = list(_places(data))
    values = (*WRONG, GONE)
    order = np.random.default_rng(0).permutation(len(places) * len(values))
    place, value = divmod(int(order[case.number % len(order)]), len(values))
    return places[place], values[value]


def _names(at: Path_) -> list[str]:
    """What a refusal may name: the key, or the one it belongs to."""
    return [str(key) for key in at if isinstance(key, str)]


def _dump(data: Any) -> str:
    return yaml.safe_dump(data, allow_unicode=True, sort_keys=False)


@cache
def _night() -> tuple[Night, Path]:
    """A good acquisition, written once; cases put other descriptions beside it."""
    vectors = {"vertical": (1.18, 0.02), "horizontal": (0.01, 1.18)}
    night = Night(np.random.default_rng(5), count=20, vectors=vectors)
    return night, night.write(lasting_folder() / "acq")


def _acquisition_key(case: Case) -> None:
    """A wrong value, or none, at a key of acquisition.yaml."""
    night, folder = _night()
    at, value = _choice(case, night.described)
    file = folder / f"case-{case.number}.yaml"
    file.write_text(_dump(_with(night.described, at, value)), encoding="utf-8")
    run = case.folder / "run"
    try:
        calibrate(file, run, _names(at))
    finally:
        file.unlink()
    if (run / "products" / "fit.json").exists():
        night.check(run)


@cache
def _bench() -> dict[str, Any]:
    """A bench that is simulated in a moment, all keys given, every effect on."""
    from pixcal.effects import effects
    from pixcal.model.bench import load_bench
    from pixcal.model.config import to_plain

    plain: dict[str, Any] = to_plain(load_bench(BENCH))
    plain["detector"] |= {"shape": [12, 10], "chip": [40, 30], "origin_px": [3, 4]}
    plain["detector"] |= {"saturation_adu": 60000.0}
    plain["optics"] |= {"nominal_distance_mm": 400.0}
    plain["frames"] |= {"bias": 2, "darks": [{"exptime_s": 0.5, "count": 2}]}
    plain["frames"]["flats"] = [{"exptime_s": 0.05, "count": 2}]
    for scan in plain["frames"]["fringes"]:
        scan |= {"count": 3, "offset_mm": [0.0, 0.0]}
    plain["effects"] = {name: to_plain(cls()) for name, cls in effects().items()}
    return plain


def _samples(bench: dict[str, Any]) -> float:
    frames = bench["frames"]
    counts = [frames.get("bias", 0)]
    counts += [f["count"] for key in ("darks", "flats", "fringes") for f in frames.get(key, [])]
    return float(np.prod(bench["detector"]["shape"]) * sum(map(float, counts)))


def _bench_key(case: Case) -> None:
    """A wrong value, or none, at a key of a bench file; then planned and simulated."""
    plain = _bench()
    at, value = _choice(case, plain)
    made = _with(plain, at, value)
    file = case.folder / "bench.yaml"
    file.write_text(_dump(made), encoding="utf-8")
    names = [*_names(at), "effects"]
    pixcal("budget", file, "--precision", "1e-3", names=names)
    if _samples(made) > MAX_SAMPLES:
        return
    acq = case.folder / "acq"
    pixcal("simulate", file, "--out", acq, *RUNTIME, names=names)
    truth = json.loads((case.folder / "acq-truth" / "truth.json").read_text())
    if not np.isfinite(np.concatenate([s["phi"] for s in truth["sets"].values()] or [[0]])).all():
        raise Broken("the truth of a simulation is not finite")
    with good_input():
        pixcal("ingest", acq, "--out", case.folder / "run", *RUNTIME)


def _bomb(depth: int) -> str:
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    for n in range(1, depth):
        lines.append(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]")
    return "\n".join(lines)


def _text(case: Case, good: str) -> bytes:
    """Text damaged in a random way."""
    lines = good.splitlines(keepends=True)
    at = int(case.rng.integers(len(lines)))
    key = lines[at].partition(":")[0].strip(" -") or "x"
    tags = (
        "!!python/object/apply:os.system ['true']",
        "!!python/name:os.system",
        "!!binary aGk=",
        "!!python/object/new:type {}",
        "!!timestamp 2026-01-01",
        "!!set {a, b}",
        "!x y",
        "!!map {}",
        "!!float 1",
        "!<tag:yaml.org,2002:int> 3",
    )
    numbers = (
        "9" * 400,
        "9" * 5000,
        "1e999",
        "-1e999",
        "0x" + "f" * 300,
        "1_0",
        "1:1:1",
        "٣",
        "+.inf",
        ".nan",
        "0o17",
        "0b1",
        "1e",
        "--1",
        "0" * 10_000,
    )
    ways = {
        "bomb": lambda: _bomb(int(case.rng.integers(2, 30))) + "\n" + good,
        "alias": lambda: good + f"\nextra: &a [*a, {key}]\n",
        "merge": lambda: good + "\n<<: {schema: 1}\n",
        "tag": lambda: "".join([*lines[:at], f"{key}: {case.pick(*tags)}\n", *lines[at + 1 :]]),
        "number": lambda: "".join(
            [*lines[:at], f"{key}: {case.pick(*numbers)}\n", *lines[at + 1 :]]
        ),
        "twice": lambda: good + lines[at],
        "doubled": lambda: "".join([*lines[:at], lines[at], *lines[at:]]),
        "cut": lambda: good[: int(case.rng.integers(len(good)))],
        "deep": lambda: good + "\nx: " + "[" * int(10 ** case.rng.uniform(1, 5.5)),
        "documents": lambda: good + "\n---\n" + good,
        "directive": lambda: "%YAML 3.0\n---\n" + good,
        "tabs": lambda: good.replace("  ", "\t"),
        "swapped": lambda: "".join(case.rng.permutation(lines)),
        "long": lambda: good + "\n# " + "x" * int(10 ** case.rng.uniform(3, 6.2)),
        "quotes": lambda: good.replace(":", ': "', 1),
    }
    way = str(case.pick(*ways, "bytes", "bytes", "code"))
    if way == "code":
        spoilt = good.encode(str(case.pick("utf-16", "utf-32", "utf-7", "utf-8-sig")))
    elif way == "bytes":
        raw = bytearray(good.encode())
        for n in case.rng.integers(0, len(raw), int(10 ** case.rng.uniform(0, 1.5))):
            raw[n] = int(case.rng.integers(256))
        spoilt = bytes(raw)
    else:
        spoilt = ways[way]().encode()
    return spoilt


def _spoilt_acquisition(case: Case) -> None:
    """Text of acquisition.yaml that is changed, or not plain YAML."""
    night, folder = _night()
    file = folder / f"text-{case.number}.yaml"
    file.write_bytes(_text(case, _dump(night.described)))
    run = case.folder / "run"
    try:
        pixcal("ingest", file, "--out", run, *RUNTIME, names=[file.name, ".fits"])
    finally:
        file.unlink()
    _finite(json.loads((run / "ingest" / "acquisition.json").read_text()))


def _spoilt_bench(case: Case) -> None:
    """Text of a bench file that is changed, or not plain YAML."""
    file = case.folder / "bench.yaml"
    file.write_bytes(_text(case, BENCH.read_text(encoding="utf-8")))
    pixcal("budget", file, "--precision", "1e-3", names=[file.name])


def _finite(data: Any) -> None:
    if isinstance(data, float) and not np.isfinite(data):
        raise Broken("a number of the configuration is not finite")
    if isinstance(data, (dict, list)):
        for value in data.values() if isinstance(data, dict) else data:
            _finite(value)


KINDS = [
    Kind("acquisition", "wrong values at every key of acquisition.yaml", _acquisition_key, 600),
    Kind("bench-file", "wrong values at every key of a bench file", _bench_key, 600),
    Kind(
        "yaml",
        "acquisition.yaml: YAML bombs, tags, huge numbers, repeated keys",
        _spoilt_acquisition,
        500,
    ),
    Kind("bench-yaml", "bench file: the same", _spoilt_bench, 500),
]
