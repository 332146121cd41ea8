"""The blind examination: what is drawn, what cannot leak, what is sealed, and how it is scored."""

import importlib.util
import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.io import fits

from blind_examination.benches import LAYOUTS
from blind_examination.cases import make, write_examination
from blind_examination.draw import (
    LEFT_OUT,
    NOTHING,
    ONE,
    SECOND,
    SECOND_NOTHING,
    SECOND_ONE,
    SECOND_OTHER,
    SECOND_PAIR,
    SEVERAL,
    Drawn,
    Examination,
    Truth,
    draw_examination,
)
from blind_examination.grade import grade
from blind_examination.manifest import read_manifest
from blind_examination.marking import score
from blind_examination.offsets import offset_errors
from blind_examination.options import MakeConfig, RunConfig, ScoreConfig
from blind_examination.parameters import check_parameters
from blind_examination.running import run, share
from blind_examination.seal import read_seal
from blind_examination.second import SecondCase, catalogue, second_offsets
from blind_examination.strengths import STRONGEST, VARIANTS, Variant
from blind_examination.summary import summary
from blind_examination.table import as_markdown, write_between
from pixcal.effects import effects, parse_effects
from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime
from pixcal.model.acquisition import load_acquisition
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError, PlanError
from pixcal.stages import correct, diagnose, ingest, reduce
from pixcal.stages.diagnose import diagnosis_input
from pixcal.storage.artefact import build
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import write_json
from pixcal.storage.stage import require

DIAGNOSIS_FORMAT = STAGES["diagnose"].format

SYNC = Runtime(cluster="sync")
BLOCK = 2880


# What is drawn.


def test_every_effect_with_variants_has_its_turn() -> None:
    names = {way.effect for way in VARIANTS}
    assert names <= set(effects())
    examination = draw_examination(3 * len(names), 17, "small", "own")
    turns = Counter(t.names[0] for t in examination.truths if t.part == ONE)
    assert set(turns) == names
    assert max(turns.values()) - min(turns.values()) <= 1


@pytest.mark.parametrize("way", VARIANTS, ids=lambda way: f"{way.effect}: {way.strength}")
def test_a_way_is_an_effect_at_any_strength(way: Variant) -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        strength = way.threshold(("small", "standard")[seed % 2]) * STRONGEST ** (seed / 11)
        (effect,) = parse_effects({way.effect: way.make(strength, rng)}, "test")
        assert not effect.is_null
        json.dumps(way.make(strength, rng))


def test_the_parts_of_the_self_check() -> None:
    examination = draw_examination(100, 5, "small", "own")
    assert Counter(t.part for t in examination.truths) == {
        ONE: 50,
        NOTHING: 16,
        SEVERAL: 17,
        LEFT_OUT: 17,
    }
    assert [t.part for t in examination.truths] != sorted(t.part for t in examination.truths)
    for truth in examination.truths:
        assert (truth.left_out in truth.names) == (truth.part == LEFT_OUT)
        least = 1.0 if truth.part == ONE else 2.0
        assert all(least <= (d.times or 0) <= STRONGEST for d in truth.drawn)
        assert len(set(truth.names)) == len(truth.names)
        assert len(truth.names) in {ONE: (1,), NOTHING: (0,), SEVERAL: (2, 3)}.get(truth.part, (1,))
    assert draw_examination(100, 5, "small", "own") == examination
    assert draw_examination(100, 6, "small", "own") != examination


@pytest.mark.long
def test_half_of_the_cases_are_of_the_second_bench() -> None:
    variations, laws, _ = catalogue()
    examination = draw_examination(200, 5, "small")
    second = [t for t in examination.truths if t.part in SECOND]
    assert Counter(t.part for t in second) == {
        SECOND_ONE: 55,
        SECOND_NOTHING: 25,
        SECOND_PAIR: 10,
        SECOND_OTHER: 10,
    }
    assert all((t.second is None) == (t.part not in SECOND) for t in examination.truths)
    assert len({t.second.seed for t in second if t.second}) == 100
    known = {law.effect for law in laws if law.known}
    for truth in second:
        assert truth.left_out in effects()
        assert truth.left_out not in truth.names
        assert (set(truth.names) <= known) == (truth.part != SECOND_OTHER)
        assert len(truth.names) == {SECOND_NOTHING: 0, SECOND_PAIR: 2}.get(truth.part, 1)
    one = Counter(t.names[0] for t in second if t.part == SECOND_ONE)
    assert set(one) == known
    assert max(one.values()) - min(one.values()) <= 1
    plain = [t.second.case for t in second if t.second and t.part == SECOND_NOTHING]
    assert plain.count("ordinary") == 13
    assert {case.partition("/")[2] for case in plain if "/" in case} <= set(variations)
    assert {t.part for t in draw_examination(30, 5, "small", "second").truths} == set(SECOND)


def test_a_second_bench_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("blind_examination.second.NEEDED", ("galsim", "hcipy_of_old"))
    catalogue.cache_clear()
    with pytest.raises(InputError, match=r"hcipy_of_old; .*pixcal\[second-bench\].*--bench own"):
        draw_examination(20, 5, "small")
    assert len(draw_examination(20, 5, "small", "own").truths) == 20


@pytest.mark.parametrize("case", ["--list", "--out=/tmp/elsewhere", "ipc/", "", "lag; ls", "a b"])
def test_what_is_no_case_is_not_told_to_the_second_bench(
    case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("blind_examination.second._asked", pytest.fail)
    with pytest.raises(InputError, match="not a case of the second bench"):
        second_offsets(SecondCase(case, 1, 0.5), LAYOUTS["tiny"])


@pytest.mark.long
def test_laws_whose_package_is_missing_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(
        "blind_examination.second.importlib.util.find_spec",
        lambda name: None if name == "pyxel" else real(name),
    )
    catalogue.cache_clear()
    _, laws, absent = catalogue()
    assert absent == ("pyxel",)
    assert ("lag", "traps") not in {(law.effect, law.name) for law in laws}
    assert "lag" in {law.effect for law in laws}
    assert "pyxel" in draw_examination(20, 5, "small").notes[0]
    catalogue.cache_clear()


def test_some_standard_cases_have_a_second_baseline() -> None:
    examination = draw_examination(40, 5, "standard", "own")
    sets = Counter(len(examination.bench(n).frames.fringes) for n in range(40))
    assert set(sets) == {2, 3}
    for n in range(40):
        laws = {s.phase_law for s in examination.bench(n).frames.fringes}
        assert laws == {"random", "ramp"}


# What cannot leak.


def drawn(effect: str, strength: float, number: int = 0) -> Drawn:
    way = [w for w in VARIANTS if w.effect == effect][number]
    made = way.make(strength, np.random.default_rng(1))
    return Drawn(effect, way.strength, strength, 3.0, made)


def header(file: Path) -> bytes:
    """Blocks of the header, to the one that ends it."""
    data = file.read_bytes()
    size = BLOCK
    while not any(data[at : at + 80].startswith(b"END ") for at in range(size - BLOCK, size, 80)):
        size += BLOCK
    return data[:size]


def facts_of(folder: Path) -> dict[str, Any]:
    """All that can be known of a folder without looking at samples."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        stat = path.stat()
        content = b""
        if path.suffix == ".fits":
            content = header(path)
        elif path.name == "blind.json":
            content = json.dumps(json.loads(path.read_text()) | {"commitment": ""}).encode()
        elif path.is_file():
            content = path.read_bytes()
        name = path.relative_to(folder).as_posix()
        found[name] = (stat.st_size, stat.st_mtime_ns, stat.st_mode, content)
    return found


def test_the_folder_holds_no_trace_of_the_truth(tmp_path: Path) -> None:
    one = Examination(
        12,
        "tiny",
        (
            Truth(ONE, "lag", (drawn("row_noise", 8.0),)),
            Truth(NOTHING, "ipc"),
            Truth(SEVERAL, "lag", (drawn("nonlinearity", 0.02), drawn("intensity_noise", 0.02))),
        ),
    )
    other = replace(
        one,
        truths=(
            Truth(LEFT_OUT, "lag", (drawn("lag", 0.02),)),
            Truth(ONE, "ipc", (drawn("nonlinearity", 0.02),)),
            Truth(NOTHING, "lag"),
        ),
    )
    found = []
    for name, examination in (("one", one), ("other", other)):
        write_examination(tmp_path / name, tmp_path / f"{name}.json", examination, SYNC)
        found.append(facts_of(tmp_path / name))
    assert found[0] == found[1]
    assert len({moment for _, moment, _, _ in found[0].values()}) == 1
    files = [f for f in found[0] if f.endswith(".fits")]
    assert len(files) == 3 * (1 + 1 + 4 + 2)
    pairs = [[fits.getdata(tmp_path / n / f) for n in ("one", "other")] for f in files]
    assert not all(np.array_equal(*pair) for pair in pairs)
    assert {p.name for p in tmp_path.iterdir()} == {"one", "other", "one.json", "other.json"}
    text = (tmp_path / "one" / "blind.json").read_text()
    assert "row_noise" not in text
    assert '"seed"' not in text


@pytest.mark.long
def test_cases_of_the_second_bench_differ_in_their_samples_alone(tmp_path: Path) -> None:
    """What a case holds is not seen without looking at samples; whose bench it is may be."""
    found = []
    for name, case in (("one", "ordinary/dust"), ("other", "lag/linear+row_noise/rows")):
        asked = SecondCase(case, 77, 0.5)
        examination = Examination(12, "tiny", (Truth(SECOND_NOTHING, "ipc", second=asked),))
        write_examination(tmp_path / name, tmp_path / f"{name}.json", examination, SYNC)
        found.append(facts_of(tmp_path / name))
    (yaml_one, yaml_other) = (f.pop("case-0001/acquisition.yaml")[-1] for f in found)
    assert found[0] == found[1]
    assert load_acquisition(tmp_path / "one" / "case-0001").optics.distance_mm == 400
    assert set(yaml.safe_load(yaml_one)) == set(yaml.safe_load(yaml_other))


def test_the_bench_does_not_depend_on_the_truth() -> None:
    many, few = (draw_examination(n, 8, "small", "own") for n in (30, 7))
    assert many.truths[:7] != few.truths
    assert [many.bench(n) for n in range(7)] == [few.bench(n) for n in range(7)]
    assert len({many.bench(n).seed for n in range(30)}) == 30


def test_a_seed_that_is_not_given_cannot_be_guessed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("blind_examination.cases.write_examination", lambda *_: None)
    config = MakeConfig(1, bench="own")
    seeds = {make(tmp_path / "e", tmp_path / "t", config, SYNC).seed for _ in range(8)}
    assert len(seeds) == 8
    assert all(seed >= 1000 for seed in seeds)
    given = make(tmp_path / "e", tmp_path / "t", replace(config, seed=7), SYNC)
    assert given.seed == 7


# What is sealed.


@pytest.fixture(scope="module")
def exam(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Three cases, not to be changed."""
    folder = tmp_path_factory.mktemp("blind")
    truths = (
        Truth(ONE, "lag", (drawn("row_noise", 8.0),)),
        Truth(NOTHING, "ipc"),
        Truth(LEFT_OUT, "nonlinearity", (drawn("nonlinearity", 0.02),)),
    )
    examination = Examination(1012, "tiny", truths)
    write_examination(folder / "exam", folder / "truth.json", examination, SYNC)
    return folder / "exam", folder / "truth.json"


def test_the_truth_cannot_be_changed_afterwards(exam: tuple[Path, Path], tmp_path: Path) -> None:
    folder, sealed = exam
    paper = read_manifest(folder)
    assert paper.purpose == "examination"
    assert paper.without == ("lag", "ipc", "nonlinearity")
    opened = read_seal(sealed, paper.commitment)
    assert opened.examination.truths[0].names == ("row_noise",)
    assert opened.benches[2] == opened.examination.bench(2)
    assert sealed.stat().st_mode & 0o077 == 0
    changed = json.loads(sealed.read_text())
    changed["examination"]["truths"][1]["part"] = ONE
    write_json(tmp_path / "changed.json", changed)
    with pytest.raises(InputError, match="changed"):
        read_seal(tmp_path / "changed.json", paper.commitment)
    with pytest.raises(InputError, match="not found"):
        read_seal(tmp_path / "nowhere.json", paper.commitment)


def test_what_stands_in_the_way_is_refused(exam: tuple[Path, Path], tmp_path: Path) -> None:
    folder, sealed = exam
    config = MakeConfig(1, 3, "tiny")
    with pytest.raises(InputError, match="not empty"):
        make(folder, tmp_path / "truth.json", config, SYNC)
    with pytest.raises(InputError, match="already exists"):
        make(tmp_path / "new", sealed, config, SYNC)
    with pytest.raises(InputError, match="apart"):
        make(tmp_path / "new", tmp_path / "new" / "truth.json", config, SYNC)
    with pytest.raises(InputError, match=r"blind\.json"):
        run(tmp_path, RunConfig(), SYNC)


# How it is run.


def test_cases_are_diagnosed_once_and_without_what_is_left_out(
    exam: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, sealed = shutil.copytree(exam[0], tmp_path / "exam"), exam[1]
    asked: list[str] = []
    broken = {"ipc"}

    def diagnosed(run_dir: Path, config: diagnose.Config, _: Runtime) -> None:
        asked.extend(config.without)
        if broken & set(config.without):
            raise InputError("cannot be fitted")
        (run_dir / "products").mkdir(exist_ok=True)
        write_json(run_dir / "products" / "diagnosis.json", answer(["row_noise"], 0.9))

    monkeypatch.setattr(diagnose, "run", diagnosed)
    with pytest.raises(InputError, match="blind run"):
        score(folder, sealed, ScoreConfig(), SYNC)
    assert run(folder, RunConfig(limit=1), SYNC) == (1, 0)
    assert not (folder / "runs" / "case-0001" / "ingest").exists()
    nowhere = tmp_path / "nowhere.md"
    with pytest.raises(InputError, match=r"nowhere\.md: not found"):
        score(folder, sealed, ScoreConfig(write=nowhere), SYNC)
    assert not (folder / "score.json").exists()
    found = score(folder, sealed, ScoreConfig(), SYNC)
    assert [c["case"] for c in found["cases"]] == ["case-0001"]
    assert found["missing"] == ["case-0002", "case-0003"]
    # Of those that are still to be run nothing is told, nor the seed that they are drawn from.
    told = (folder / "score.json").read_text() + (folder / "score.md").read_text()
    assert found["seed"] is None
    assert "quadratic" not in told
    assert len(found["runs"]["codes"]) == 1
    assert run(folder, RunConfig(), SYNC) == (2, 1)
    assert asked == ["lag", "ipc", "nonlinearity"]
    found = score(folder, sealed, ScoreConfig(), SYNC)
    assert [c["right"] for c in found["cases"]] == [True, False, False]
    assert "cannot be fitted" in found["cases"][1]["why"]
    broken.clear()
    assert run(folder, RunConfig(), SYNC) == (0, 0), "a failure is an answer too"
    # What was begun by other code is not gone on with.
    begun = folder / "runs" / "case-0003"
    write_json(begun / "begun.json", {"code": "other"})
    (begun / "done.json").unlink()
    (begun / "left").touch()
    assert run(folder, RunConfig(), SYNC) == (1, 0)
    assert not (begun / "left").exists()
    assert run(folder, RunConfig(again=True, keep=True), SYNC) == (3, 0)
    assert (folder / "runs" / "case-0001" / "reduce").is_dir()


@pytest.mark.parametrize(
    ("memory", "at_once"), [(2 << 30, 1), (4 << 30, 2), (8 << 30, 2)], ids=["2G", "4G", "8G"]
)
@pytest.mark.parametrize("cluster", ["threads", "processes"])
def test_each_case_gets_the_memory_that_it_asks_for(
    memory: int, at_once: int, cluster: str
) -> None:
    """A case that is refused for want of memory would count as answered wrong."""
    runtime = Runtime(cluster, 2, memory)
    over, each = share("cases", "standard", 10, runtime)
    assert over.workers == at_once
    half, sets = 128 * 128 * 300, 3
    make_plan(
        "diagnose",
        diagnosis_input.ESTIMATE_BYTES * half,
        diagnosis_input.EVIDENCE_BYTES * half * sets,
        each,
    )
    with pytest.raises(PlanError, match="cases"):
        share("cases", "standard", 10, replace(runtime, memory=1 << 30))


# How it is scored.


def answer(named: list[str], closed: float, verdict: str = "", domain: str = "noise") -> Any:
    """A diagnosis: the causes named, of which the first closes a share of the gap."""
    causes = [
        {
            "effect": name,
            "parameters": to_plain(effects()[name]()),
            "uncertainty": {},
            "gap_closed": closed if n == 0 else 0.1,
            "p_value": 1e-6,
        }
        for n, name in enumerate(named)
    ]
    return {
        "verdict": verdict or ("explained" if named else "no gap"),
        "causes": causes,
        "gap": {"after": 1 - closed, "where": [{"domain": domain}]},
        "candidates": [{"effect": "lag", "rejected_because": "not seen"}],
    }


LAG = Truth(ONE, "ipc", (Drawn("lag", "share", 1e-3, 3.0, {"share": 1e-3}),))
BOTH = replace(LAG, part=SEVERAL, drawn=(*LAG.drawn, Drawn("ipc", "", 0.1, 2.0, {})))
MISSING = replace(LAG, part=LEFT_OUT, left_out="lag")
EMPTY = Truth(NOTHING, "ipc")
STRANGER = replace(LAG, part=SECOND_ONE, second=SecondCase("lag/linear", 3, 0.5))
ORDINARY = Truth(SECOND_NOTHING, "ipc", second=SecondCase("ordinary", 3, 0.5))
UNKNOWN = replace(
    STRANGER, part=SECOND_OTHER, drawn=(Drawn("pickup", "tone, e- amplitude", 5.0, None, {}),)
)


@pytest.mark.parametrize(
    ("truth", "diagnosis", "right", "why"),
    [
        (LAG, answer(["lag"], 0.9), True, ""),
        (LAG, answer(["lag", "ipc"], 0.9), True, ""),
        (LAG, answer(["ipc", "lag"], 0.9), False, "named after ipc; invented: ipc"),
        (LAG, answer([], 0.0), False, "lag: not seen; verdict 'no gap'"),
        (EMPTY, answer([], 0.0), True, ""),
        (EMPTY, answer([], 0.0, "unexplained"), True, ""),
        (EMPTY, answer(["lag"], 0.9), False, "lag claimed (p = 1.0e-06, closes 0.90)"),
        (BOTH, answer(["ipc", "lag"], 0.7), True, ""),
        (BOTH, answer(["ipc"], 0.7), False, "lag: not seen"),
        (BOTH, answer(["ipc", "lag", "row_noise"], 0.7), False, "invented: row_noise"),
        (MISSING, answer([], 0.0, "unexplained"), True, ""),
        (MISSING, answer(["ipc"], 0.4, "partly explained"), True, ""),
        (MISSING, answer(["ipc"], 0.8, "partly explained"), False, "ipc credited with 0.80"),
        (MISSING, answer([], 0.0), False, "verdict 'no gap'"),
        (STRANGER, answer(["lag"], 0.9), True, ""),
        (STRANGER, answer(["ipc", "lag"], 0.9), False, "named after ipc"),
        (ORDINARY, answer([], 0.0), True, ""),
        (ORDINARY, answer([], 0.0, "unexplained"), False, "verdict 'unexplained'"),
        (UNKNOWN, answer([], 0.0, "unexplained"), True, ""),
        (UNKNOWN, answer(["ipc"], 0.8), False, "ipc credited with 0.80"),
    ],
)
def test_an_answer_is_marked(truth: Truth, diagnosis: Any, right: bool, why: str) -> None:
    found = grade("case-0001", truth, diagnosis)
    assert found.right == right
    assert why in found.why
    assert bool(found.why) != right


def test_the_domain_is_that_of_the_effect() -> None:
    seen = [
        grade("case-0001", MISSING, answer([], 0.0, "unexplained", domain)).marks["right domain"]
        for domain in ("time", "intensity", "space", "noise")
    ]
    assert seen == [True, True, False, False]


def test_parameters_are_held_against_their_errors() -> None:
    found = check_parameters(
        "lag",
        {"share": 1e-3},
        {"share": 1.4e-3, "decay_frames": 0.5, "spread": 0.1},
        {"share": 1e-4, "decay_frames": 0.2},
    )
    assert [(p.name, p.within(3)) for p in found] == [("share", False), ("decay_frames", True)]
    turned = check_parameters(
        "ghost_fringes",
        {"phase_rad": 3.1},
        {"share": 0.005, "beat_rad_px": [0.35, 0.2], "phase_rad": -3.1},
        {"phase_rad": 0.05, "beat_rad_px[0]": 0.01},
    )
    assert all(p.within(3) for p in turned)
    assert [found[1].within(errors) for errors in (1, 2, 3)] == [False, False, True]
    assert len(turned) == 2


def test_couplings_are_the_same_in_any_period() -> None:
    def coupling(share: float, every: int = 1, row: int = 0, dx: int = 0) -> dict[str, Any]:
        return {"dy": 1, "dx": dx, "share": share, "every_rows": every, "row": row}

    true = {"couplings": [coupling(0.01, 2, 1)]}
    found = {"couplings": [coupling(0.0101, 4, 3), coupling(0.5, 4, 2), coupling(0.5, 2, 1, 1)]}
    errors = {f"couplings[{n}].share": 1e-4 for n in range(3)}
    (one,) = check_parameters("ipc", true, found, errors)
    assert one.within(3)
    assert one.estimate == 0.0101
    (missing,) = check_parameters("ipc", {"couplings": [coupling(0.01, 2, 0, 1)]}, found, errors)
    assert not missing.within(3)


def test_a_score_counts_and_is_shown(tmp_path: Path) -> None:
    grades = [
        grade("case-0001", LAG, answer(["lag"], 0.9)),
        grade("case-0002", LAG, answer(["ipc"], 0.9)),
        grade("case-0003", EMPTY, answer([], 0.0)),
        grade("case-0004", BOTH, answer(["ipc"], 0.7)),
        grade("case-0005", MISSING, answer([], 0.0, "unexplained")),
        grade("case-0006", EMPTY, None, "disk | full"),
        grade("case-0009", STRANGER, answer(["lag", "ipc"], 0.9)),
        grade("case-0010", UNKNOWN, answer([], 0.0, "unexplained")),
    ]
    found = summary(grades)
    pairs = found["parts"]["3"]["questions"]["pairs: both found"]
    assert (pairs["right"], pairs["of"], pairs["target"]) == (0, 1, 0.85)
    assert found["effects"]["lag"]["from_twice"]["right"] == 1
    first = found["parts"]["1"]["questions"]["named first"]
    assert (first["right"], first["of"]) == (1, 2)
    # Clopper and Pearson's limits of one in two: of the beta distribution.
    assert first["interval"] == pytest.approx([0.0126, 0.9874], abs=1e-4)
    assert found["confusion"] == {
        "lag": {"ipc": 1, "lag": 2},
        "nothing": {"failed": 1, "nothing": 1},
        "pickup": {"unexplained": 1},
    }
    stranger = found["parts"][str(SECOND_ONE)]["questions"]
    assert [q["right"] for q in stranger.values()] == [1, 0, 1]
    assert found["second"]["effects"]["lag"]["right"]["of"] == 1
    about = {
        "purpose": "development",
        "size": "small",
        "seed": 3,
        "notes": [],
        "made": 10,
        "missing": ["case-0007", "case-0008"],
        "runs": {
            "codes": ["a", "b"],
            "median_seconds": {"diagnosis": 60.2, "maps": 1.9},
            "without_maps": 0,
        },
    }
    text = as_markdown(found | about)
    assert text.index("The second bench") < text.index("Self-check")
    assert "2 of 10 are not diagnosed yet" in text
    assert "2 versions of the program" in text
    assert "development seed" in text
    assert "| lag | 3 | 2 | ipc 1 |" in text
    assert "disk / full" in text
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- blind:small -->\nold\n<!-- end -->\nafter\n")
    write_between(page, "small", text)
    once = page.read_text()
    write_between(page, "small", text)
    assert page.read_text() == once
    assert once.startswith("before\n<!-- blind:small -->\n\n8 cases")
    assert once.endswith("<!-- end -->\nafter\n")
    with pytest.raises(InputError, match="blind:standard"):
        write_between(page, "standard", text)


# Errors of the offsets.

KERNEL = drawn("ipc", 0.04)
WANDERING = drawn("hyperbolic_fringes", 60.0)


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("truth", "named", "before"),
    [
        (Truth(ONE, "lag", (KERNEL,)), KERNEL, (1.5, 50.0)),
        (Truth(ONE, "lag", (KERNEL,)), None, (1.5, 50.0)),
        (Truth(ONE, "lag", (WANDERING,)), WANDERING, (0.9, 50.0)),
        (Truth(NOTHING, "lag"), None, (0.9, 1.15)),
        pytest.param(
            Truth(SECOND_NOTHING, "lag", second=SecondCase("ordinary/aim", 5, 0)),
            None,
            (0.9, 1.15),
            marks=pytest.mark.long,
        ),
    ],
    ids=["undone", "not named", "another shape", "nothing", "nothing, on the second bench"],
)
def test_offsets_are_held_against_the_truth_in_bounds(
    truth: Truth, named: Drawn | None, before: tuple[float, float], tmp_path: Path
) -> None:
    """Corrected by the true effects they are at the bound; what no one named stays in them."""
    examination = Examination(14, "tiny", (truth,))
    folder, run_dir = tmp_path / "exam", tmp_path / "run"
    write_examination(folder, tmp_path / "truth.json", examination, SYNC)
    ingest.run(folder / "case-0001", run_dir, ingest.Config(), SYNC)
    reduce.run(run_dir, reduce.Config(), SYNC)
    causes = [] if named is None else [{"effect": named.effect, "parameters": named.parameters}]
    inputs = {"reduce": require(run_dir, "reduce").key}
    with build(run_dir, "diagnose", DIAGNOSIS_FORMAT, {"own": [], "nominal": {}}, inputs) as made:
        write_json(made.folder / "diagnosis.json", {"verdict": "explained", "causes": causes})
    correct.run(run_dir, correct.Config(), SYNC)
    found = offset_errors(
        run_dir / "products", folder / "case-0001", truth, examination.bench(0), LAYOUTS["tiny"]
    )
    assert [one.axis for one in found] == ["x", "y"]
    worst = max(one.before for one in found)
    assert before[0] < worst < before[1]
    assert any(one.biased for one in found) == (truth.names == ("ipc",))
    for one in found:
        if named is None:
            assert one.after == one.before
        else:
            assert 0.9 < one.after < 1.15


# A whole examination, so that the diagnosis cannot rot.


@pytest.mark.long
def test_strong_effects_are_found_and_nothing_is_claimed(tmp_path: Path) -> None:
    """Development cases, whose seed is no examination's; a minute in all."""
    rows = drawn("row_noise", 12.0)
    truths = (
        Truth(ONE, "lag", (KERNEL,)),
        Truth(NOTHING, "ipc"),
        Truth(LEFT_OUT, "row_noise", (rows,)),
        Truth(
            SECOND_ONE,
            "ipc",
            (Drawn("lag", "", 0.01, None, {}),),
            second=SecondCase("lag/linear", 3, 0.85),
        ),
    )
    folder, sealed = tmp_path / "exam", tmp_path / "truth.json"
    write_examination(folder, sealed, Examination(12, "tiny", truths), SYNC)
    assert run(folder, RunConfig(), SYNC) == (4, 0)
    found = score(folder, sealed, ScoreConfig(), SYNC)
    assert [case["why"] for case in found["cases"]] == 4 * [""]
    for part in found["parts"].values():
        for question, count in part["questions"].items():
            if "sigma" not in question:
                assert count["right"] == count["of"], question
    asked = [q["of"] for part in found["parts"].values() for q in part["questions"].values()]
    assert sum(asked) > 10
    assert found["runs"]["without_maps"] == 0
    biased = found["maps"]["biased"]
    assert biased["maps"] == 2
    assert biased["before"] > 3
    assert biased["after"] < found["maps"]["target"]
    # What stays of a case is small.
    kept = sum(f.stat().st_size for f in (folder / "runs").rglob("*") if f.is_file())
    assert kept < 4 * 1_000_000
