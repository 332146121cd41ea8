"""Bad input of `pixcal diagnose`: odd acquisitions, damaged runs, own effects, benches."""

import json
import os
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fuzzing.laws import RUNTIME, Broken, Case, Kind, good_input, lasting_folder, pixcal
from fuzzing.night import Night
from fuzzing.own_effects import GOOD
from fuzzing.settings import small_bench

SHAPE, COUNT = (16, 19), 50
"""As small as can be diagnosed: 24 frames in each half."""
VECTORS = {"vertical": (2 * np.pi / 5.3, 0.02)}
ONLY = ("--effects", "intensity_noise")
"""One candidate, so that a case takes a second and not ten."""
VERDICTS = ("explained", "partly explained", "unexplained", "no gap")


def diagnosed(run: Path, *more: str | Path, names: tuple[str, ...] = ()) -> dict[str, Any]:
    """Diagnose a run; returns the product after checking that it is a diagnosis."""
    pixcal("diagnose", run, *ONLY, *more, *RUNTIME, names=names)
    told: dict[str, Any] = json.loads((run / "products" / "diagnosis.json").read_text())
    if told["verdict"] not in VERDICTS:
        raise Broken(f"verdict {told['verdict']}")
    if bool(told["causes"]) != (told["verdict"] in VERDICTS[:2]):
        raise Broken(f"{told['verdict']} with {len(told['causes'])} causes")
    return told


def reduced(night: Night, folder: Path, dtype: str = "uint16") -> Path:
    """A run up to `reduce`."""
    acquisition, run = night.write(folder / "acquisition", dtype), folder / "run"
    pixcal("ingest", acquisition, "--out", run, *RUNTIME)
    pixcal("reduce", run, *RUNTIME)
    return run


# Acquisitions


def _odd(case: Case) -> None:
    """Frames that are of little or no use for a diagnosis."""
    what = str(
        case.pick(
            "few",
            "tiny",
            "saturated",
            "constant",
            "no fringes",
            "masked",
            "alone",
            "still",
            "short",
            "loud",
        )
    )
    shape = (7, 5) if what == "tiny" and case.number % 2 else SHAPE
    if what == "tiny" and case.number % 2 == 0:
        shape = tuple(int(n) for n in case.rng.integers(1, 12, 2))
    count = int(case.rng.integers(1, 60)) if what == "few" else COUNT
    phases = np.zeros(COUNT) if what == "still" else None
    level = 5.0 if what == "short" else 2e4
    vectors = VECTORS | ({"horizontal": (0.01, 1.2)} if case.number % 5 == 0 else {})
    night = Night(case.rng, shape, count=count, vectors=vectors, phases=phases, level=level)
    fringes = night.frames["vertical"]
    if what == "saturated":
        night.described["detector"]["saturation_adu"] = float(np.quantile(fringes, 0.3))
    elif what == "constant":
        night.frames["vertical"] = np.full_like(fringes, 5000.0)
    elif what == "no fringes":
        night.frames["vertical"] = case.rng.poisson(2e4, fringes.shape) + 300.0
    elif what == "masked":
        night.frames["bias"][:, case.rng.random(shape) < case.pick(0.9, 1.0)] = np.nan
    elif what == "alone":  # no bias, dark or flat
        night.described["frames"]["bias"] = []
        del night.frames["bias"]
    elif what == "loud":
        night.frames["vertical"] = fringes * (1 + 0.3 * case.rng.standard_normal((count, 1, 1)))
    run = reduced(night, case.folder, "float32" if what == "masked" else "uint16")
    told = diagnosed(run, names=(str(run), "--memory", "fringes/"))
    if what in ("few", "tiny", "alone") and told["causes"]:
        raise Broken(f"{what}: a cause was claimed of a nominal bench")


# Artefacts


@cache
def _runs() -> tuple[Path, Path, dict[str, Any]]:
    """A run, another one, and the diagnosis of the first."""
    folder = lasting_folder()
    runs = []
    with good_input():
        for number in (1, 2):
            night = Night(np.random.default_rng(number), SHAPE, count=COUNT, vectors=VECTORS)
            runs.append(reduced(night, folder / str(number)))
        return runs[0], runs[1], diagnosed(runs[0])


def _spoil(case: Case, file: Path) -> None:
    body = bytearray(file.read_bytes())
    how = str(case.pick("flip", "flip", "cut", "zero", "remove", "text", "folder", "empty"))
    if how == "flip" and body:
        at = int(case.rng.integers(8 * len(body)))
        body[at >> 3] ^= 1 << (at & 7)
    file.unlink()
    if how == "cut":
        del body[int(case.rng.integers(len(body) + 1)) :]
    spoilt = {"zero": bytes(len(body)), "text": b"[]\n", "empty": b""}
    if how == "folder":
        file.mkdir()
    elif how != "remove":
        file.write_bytes(spoilt.get(how, bytes(body)))


def _artefacts(case: Case) -> None:
    """Files of RUN damaged or missing; stages missing, or from another run."""
    whole, other, told = _runs()
    run = case.folder / "run"
    shutil.copytree(whole, run, copy_function=os.link)
    what = str(case.pick("file", "file", "file", "file", "file", "other", "gone", "run"))
    stage = str(case.pick("ingest", "reduce"))
    if what == "file":
        files = sorted(f for f in run.rglob("*") if f.is_file() and f.name != ".lock")
        chunks = [f for f in files if "/c/" in f.as_posix()]
        few = [f for f in files if f not in chunks and "/diagnose/" not in f.as_posix()]
        pool = [files, chunks, few][case.number % 3]
        if case.pick(True, True, False):
            shutil.rmtree(run / "diagnose")
            pool = [f for f in pool if f.exists()]
        _spoil(case, pool[int(case.rng.integers(len(pool)))])
    elif what == "run":
        shutil.rmtree(run)
        case.pick(lambda: None, run.mkdir, run.touch)()  # type: ignore[operator]
    else:
        shutil.rmtree(run / stage)
        if what == "other":
            shutil.copytree(other / stage, run / stage)
    found = diagnosed(run, names=(str(run),))
    if found != told:
        raise Broken(f"another diagnosis than that of the whole run: {found['verdict']}")


# Effects of the user's own

OWN = (
    GOOD.replace("import Effect, Stage", "import Effect, Estimate, Stage").replace(
        "from pixcal.model.config", "import numpy as np\nfrom pixcal.model.config"
    )
    + """
    @classmethod
    def estimate(cls, evidence):
        return Estimate(cls(electrons=50.0), {"electrons": 1.0}, 50.0, "made up")
"""
)
ANSWER = 'return Estimate(cls(electrons=50.0), {"electrons": 1.0}, 50.0, "made up")'
LIGHT = "return mean + self.electrons"
BROKEN = (
    ("", ""),
    (ANSWER, "return None"),
    (ANSWER, "raise ValueError('two\\nlines')"),
    (ANSWER, "raise InputError('glow: no darks; take some')"),
    (ANSWER, "return 3"),
    (ANSWER, "return float('nan')"),
    (ANSWER, "return cls()"),
    (ANSWER, "1 / 0"),
    (ANSWER, "raise SystemExit(3)"),
    (ANSWER, "exit('bye')"),
    (ANSWER, "return []"),
    (ANSWER, "return evidence.nothing"),
    (ANSWER, "return cls.estimate(evidence)"),
    (ANSWER, "return Estimate(None, {}, 50.0, '')"),
    (ANSWER, "return Estimate()"),
    (ANSWER, "return np.array(1.0)"),
    (ANSWER, "raise MemoryError"),
    (ANSWER, "evidence.good[:] = False; return None"),
    ("electrons=50.0", "electrons=float('nan')"),
    ("electrons=50.0", "electrons=-1.0"),
    ("electrons=50.0", "electrons='many'"),
    ("electrons=50.0", "electrons=1e30"),
    ("electrons=50.0", "protons=1.0"),
    ('"electrons": 1.0}', '"electrons": float("nan")}'),
    ('"electrons": 1.0}', '"electrons": 0.0}'),
    ('"electrons": 1.0}', '"electrons": -1.0}'),
    ('{"electrons": 1.0}', "{}"),
    ('{"electrons": 1.0}', "None"),
    ('{"electrons": 1.0}', '{"protons": 1.0}'),
    ('50.0, "made', "float('nan'), \"made"),
    ('50.0, "made', "float('inf'), \"made"),
    ('50.0, "made', "'much', \"made"),
    ('50.0, "made', '-50.0, "made'),
    ('50.0, "made', 'np.float32(50), "made'),
    ('"made up"', "None"),
    ('"made up"', "'two\\nlines <b>&'"),
    ("@classmethod\n", "\n"),
    ("(cls, evidence)", "(cls)"),
    ("class Glow", "clas Glow"),
    ("(Effect)", "(Exception)"),
    ("(Effect)", ""),
    ("(frozen=True)", ""),
    (LIGHT, "return mean * float('nan')"),
    (LIGHT, "raise ValueError('x')"),
    (LIGHT, "return None"),
    (LIGHT, "return mean[:1]"),
    (LIGHT, "raise SystemExit(3)"),
    (LIGHT, "return mean - 1e9"),
    (LIGHT, "return mean * 1e300"),
    (LIGHT, "return 'light'"),
)


def _own(case: Case) -> None:
    """A broken file of an effect as a candidate; what cannot be estimated is no cause."""
    whole, _, _ = _runs()
    old, new = BROKEN[case.number % len(BROKEN)]
    text = OWN.replace(old, new) if old else OWN
    if case.number >= len(BROKEN):
        old, new = BROKEN[int(case.rng.integers(len(BROKEN)))]
        text = text.replace(old, new) if old else text
    own, run = case.folder / "own.py", case.folder / "run"
    own.write_text(text, encoding="utf-8")
    shutil.copytree(whole, run, copy_function=os.link, ignore=shutil.ignore_patterns("diagnose"))
    effects = ("--own", own, "--effects", "intensity_noise,glow")
    told = diagnosed(run, *effects, names=("own.py", "glow", "Glow"))
    if any(cause["effect"] == "glow" for cause in told["causes"]):
        raise Broken("an effect that is not there was claimed")


# The nominal bench

EFFECTS: tuple[Any, ...] = (
    {"lag": {}},
    {},
    None,
    [],
    3,
    "lag",
    {"lag": None},
    {"lag": 3},
    {"lag": {"x": 1}},
    {"nowhere": {}},
    {"ipc": {}, "lag": {}},
    {"intensity_noise": {}},
    {3: {}},
    {"glow": {}},
    {"quantisation": {}},
    {"cosmic_hits": {}},
    {"hyperbolic_fringes": {}},
    {"straylight": {}},
    {"nonlinearity": {}},
    {"telegraph_noise": {}},
    {"rolling_shutter": {}},
    {"flat_error": {}},
    {"lag": {"fraction": -1}},
    {"lag": {"fraction": "a"}},
    {"ipc": {"nearest": 3}},
)


def _nominal(case: Case) -> None:
    """A bench file for `--nominal` that is invalid, does not match the run, or is good."""
    whole, _, _ = _runs()
    run, file = case.folder / "run", case.folder / "bench.yaml"
    shutil.copytree(whole, run, copy_function=os.link, ignore=shutil.ignore_patterns("diagnose"))
    bench = yaml.safe_load(small_bench())
    bench["effects"] = EFFECTS[case.number % len(EFFECTS)]
    text = yaml.safe_dump(bench)
    if case.number >= len(EFFECTS):
        how = str(case.pick("cut", "bytes", "key", "value", "acquisition", "empty", "folder"))
        if how == "cut":
            text = text[: int(case.rng.integers(len(text)))]
        elif how == "bytes":
            text = "".join(chr(int(c)) for c in case.rng.integers(1, 300, 200))
        elif how == "acquisition":
            text = (run.parent / "none").as_posix()
        elif how == "empty":
            text = ""
        elif how == "folder":
            file.mkdir()
        else:
            section = str(case.pick(*bench))
            if how == "key":
                del bench[section]
            else:
                bench[section] = case.pick(None, [], {}, "x", 1e300, -1)
            text = yaml.safe_dump(bench)
    if not file.is_dir():
        file.write_text(text, encoding="utf-8")
    names = ("bench.yaml", "effects", "--nominal")
    diagnosed(run, "--nominal", file, names=names)


KINDS = [
    Kind("diagnose-odd", "diagnosis of odd acquisitions", _odd, 60),
    Kind("diagnose-run", "diagnosis with damaged, missing or swapped artefacts", _artefacts, 60),
    Kind("diagnose-own", "diagnosis with broken effects of your own", _own, 60),
    Kind("diagnose-nominal", "bench files for `--nominal`", _nominal, 50),
]
