"""The blind examination: what is drawn, what cannot leak, what is sealed, and how it is scored."""

import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from pixcal.effects import effects, parse_effects
from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime
from pixcal.kernels.crosstalk import Coupling, couple
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError, PlanError
from pixcal.simulation.recording import Recording, recordings
from pixcal.stages import blind, correct, diagnose, ingest, reduce
from pixcal.stages.blind.benches import LAYOUTS, draw_bench
from pixcal.stages.blind.cases import write_examination
from pixcal.stages.blind.draw import (
    ELSEWHERE,
    LEFT_OUT,
    NOTHING,
    ONE,
    SEVERAL,
    Drawn,
    Examination,
    Truth,
    draw_examination,
)
from pixcal.stages.blind.elsewhere import FOREIGN, Elsewhere
from pixcal.stages.blind.grade import grade
from pixcal.stages.blind.marking import summary
from pixcal.stages.blind.offsets import offset_errors
from pixcal.stages.blind.paper import read_paper
from pixcal.stages.blind.parameters import held
from pixcal.stages.blind.seal import read_seal
from pixcal.stages.blind.sitting import share
from pixcal.stages.blind.strengths import STRONGEST, WAYS, Way
from pixcal.stages.blind.table import as_markdown, write_between
from pixcal.stages.diagnose import look
from pixcal.stages.diagnose.stage import FORMAT as DIAGNOSIS_FORMAT
from pixcal.storage.artefact import build, require, write_json

SYNC = Runtime(cluster="sync")
BLOCK = 2880


# What is drawn.


def test_every_effect_has_its_ways_and_its_turn() -> None:
    assert {way.effect for way in WAYS} == set(effects())
    examination = draw_examination(3 * len(effects()), 17, "small")
    turns = Counter(t.names[0] for t in examination.truths if t.part == ONE)
    assert set(turns) == set(effects())
    assert max(turns.values()) - min(turns.values()) <= 1


@pytest.mark.parametrize("way", WAYS, ids=lambda way: f"{way.effect}: {way.strength}")
def test_a_way_is_an_effect_at_any_strength(way: Way) -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        strength = way.threshold(("small", "standard")[seed % 2]) * STRONGEST ** (seed / 11)
        (effect,) = parse_effects({way.effect: way.make(strength, rng)}, "test")
        assert not effect.is_null
        json.dumps(way.make(strength, rng))


def test_the_parts_of_an_examination() -> None:
    examination = draw_examination(200, 5, "small")
    assert Counter(t.part for t in examination.truths) == {
        ONE: 80, NOTHING: 30, SEVERAL: 30, LEFT_OUT: 30, ELSEWHERE: 30,
    }  # fmt: skip
    assert [t.part for t in examination.truths] != sorted(t.part for t in examination.truths)
    for truth in examination.truths:
        assert (truth.left_out in truth.names) == (truth.part == LEFT_OUT)
        least = 1.0 if truth.part == ONE else 2.0
        assert all(least <= d.times <= STRONGEST for d in truth.drawn)
        assert len(set(truth.names)) == len(truth.names)
        assert len(truth.names) in {ONE: (1,), NOTHING: (0,), SEVERAL: (2, 3)}.get(truth.part, (1,))
    assert draw_examination(200, 5, "small") == examination
    assert draw_examination(200, 6, "small") != examination


def test_without_galsim_there_is_no_part_5(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pixcal.stages.blind.draw.galsim_is_there", lambda: False)
    examination = draw_examination(20, 5, "small")
    assert ELSEWHERE not in {t.part for t in examination.truths}
    assert len(examination.truths) == 20
    assert "GalSim" in examination.notes[0]


def test_some_standard_cases_have_a_second_baseline() -> None:
    examination = draw_examination(40, 5, "standard")
    sets = Counter(len(examination.bench(n).frames.fringes) for n in range(40))
    assert set(sets) == {2, 3}
    for n in range(40):
        laws = {s.phase_law for s in examination.bench(n).frames.fringes}
        assert laws == {"random", "ramp"}


# What cannot leak.


def drawn(effect: str, strength: float, number: int = 0) -> Drawn:
    way = [w for w in WAYS if w.effect == effect][number]
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
            Truth(ELSEWHERE, "ipc", (Drawn("nonlinearity", "", 0.02, 3.0, {}),), elsewhere=True),
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


def test_the_bench_does_not_depend_on_the_truth() -> None:
    many, few = draw_examination(30, 8, "small"), draw_examination(7, 8, "small")
    assert many.truths[:7] != few.truths
    assert [many.bench(n) for n in range(7)] == [few.bench(n) for n in range(7)]
    assert len({many.bench(n).seed for n in range(30)}) == 30


def test_a_seed_that_is_not_given_cannot_be_guessed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pixcal.stages.blind.cases.write_examination", lambda *_: None)
    config = blind.MakeConfig(1)
    seeds = {blind.make(tmp_path / "e", tmp_path / "t", config, SYNC).seed for _ in range(8)}
    assert len(seeds) == 8
    assert all(seed >= 1000 for seed in seeds)
    given = blind.make(tmp_path / "e", tmp_path / "t", replace(config, seed=7), SYNC)
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
    paper = read_paper(folder)
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
    config = blind.MakeConfig(1, 3, "tiny")
    with pytest.raises(InputError, match="not empty"):
        blind.make(folder, tmp_path / "truth.json", config, SYNC)
    with pytest.raises(InputError, match="there already"):
        blind.make(tmp_path / "new", sealed, config, SYNC)
    with pytest.raises(InputError, match="apart"):
        blind.make(tmp_path / "new", tmp_path / "new" / "truth.json", config, SYNC)
    with pytest.raises(InputError, match=r"blind\.json"):
        blind.run(tmp_path, blind.RunConfig(), SYNC)


# How it is sat.


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
        blind.score(folder, sealed, blind.ScoreConfig(), SYNC)
    assert blind.run(folder, blind.RunConfig(limit=1), SYNC) == (1, 0)
    assert not (folder / "runs" / "case-0001" / "ingest").exists()
    found = blind.score(folder, sealed, blind.ScoreConfig(), SYNC)
    assert [c["case"] for c in found["cases"]] == ["case-0001"]
    assert found["missing"] == ["case-0002", "case-0003"]
    # Of those that are still to be sat nothing is told, nor the seed that they are drawn from.
    told = (folder / "score.json").read_text() + (folder / "score.md").read_text()
    assert found["seed"] is None
    assert "quadratic" not in told
    assert len(found["sittings"]["codes"]) == 1
    assert blind.run(folder, blind.RunConfig(), SYNC) == (2, 1)
    assert asked == ["lag", "ipc", "nonlinearity"]
    found = blind.score(folder, sealed, blind.ScoreConfig(), SYNC)
    assert [c["right"] for c in found["cases"]] == [True, False, False]
    assert "cannot be fitted" in found["cases"][1]["why"]
    broken.clear()
    assert blind.run(folder, blind.RunConfig(), SYNC) == (0, 0), "a failure is an answer too"
    # What was begun by other code is not gone on with.
    begun = folder / "runs" / "case-0003"
    write_json(begun / "begun.json", {"code": "other"})
    (begun / "sat.json").unlink()
    (begun / "left").touch()
    assert blind.run(folder, blind.RunConfig(), SYNC) == (1, 0)
    assert not (begun / "left").exists()
    assert blind.run(folder, blind.RunConfig(again=True, keep=True), SYNC) == (3, 0)
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
        "diagnose", look.ESTIMATE_BYTES * half,
        look.EVIDENCE_BYTES * half * sets, each,
    )  # fmt: skip
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
        (MISSING, answer(["ipc"], 0.8, "partly explained"), False, "ipc blamed for 0.80"),
        (MISSING, answer([], 0.0), False, "verdict 'no gap'"),
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
    found = held(
        "lag",
        {"share": 1e-3},
        {"share": 1.4e-3, "decay_frames": 0.5, "spread": 0.1},
        {"share": 1e-4, "decay_frames": 0.2},
    )
    assert [(p.name, p.within(3)) for p in found] == [("share", False), ("decay_frames", True)]
    turned = held(
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
    (one,) = held("ipc", true, found, errors)
    assert one.within(3)
    assert one.found == 0.0101
    (missing,) = held("ipc", {"couplings": [coupling(0.01, 2, 0, 1)]}, found, errors)
    assert not missing.within(3)


def test_a_score_counts_and_is_shown(tmp_path: Path) -> None:
    grades = [
        grade("case-0001", LAG, answer(["lag"], 0.9)),
        grade("case-0002", LAG, answer(["ipc"], 0.9)),
        grade("case-0003", EMPTY, answer([], 0.0)),
        grade("case-0004", BOTH, answer(["ipc"], 0.7)),
        grade("case-0005", MISSING, answer([], 0.0, "unexplained")),
        grade("case-0006", EMPTY, None, "disk | full"),
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
        "lag": {"ipc": 1, "lag": 1},
        "nothing": {"failed": 1, "nothing": 1},
    }
    about = {
        "purpose": "development", "size": "small", "seed": 3, "notes": [],
        "made": 8, "missing": ["case-0007", "case-0008"],
        "sittings": {"codes": ["a", "b"], "median_seconds": {"diagnosis": 60.2, "maps": 1.9},
                     "without_maps": 0},
    }  # fmt: skip
    text = as_markdown(found | about)
    assert "2 of 8 are not diagnosed yet" in text
    assert "2 versions of the program" in text
    assert "development seed" in text
    assert "| lag | 2 | 1 | ipc 1 |" in text
    assert "disk / full" in text
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- blind:small -->\nold\n<!-- end -->\nafter\n")
    write_between(page, "small", text)
    once = page.read_text()
    write_between(page, "small", text)
    assert page.read_text() == once
    assert once.startswith("before\n<!-- blind:small -->\n\n6 cases")
    assert once.endswith("<!-- end -->\nafter\n")
    with pytest.raises(InputError, match="blind:standard"):
        write_between(page, "standard", text)


# Errors of the offsets.

KERNEL = drawn("ipc", 0.04)
WANDERING = drawn("hyperbolic_fringes", 60.0)


@pytest.mark.parametrize(
    ("truth", "named", "before"),
    [
        (Truth(ONE, "lag", (KERNEL,)), KERNEL, (1.5, 50.0)),
        (Truth(ONE, "lag", (KERNEL,)), None, (1.5, 50.0)),
        (Truth(ONE, "lag", (WANDERING,)), WANDERING, (0.9, 50.0)),
        (Truth(NOTHING, "lag"), None, (0.9, 1.15)),
        (Truth(NOTHING, "lag", elsewhere=True), None, (0.9, 1.15)),
    ],
    ids=["undone", "not named", "another shape", "nothing", "nothing, elsewhere"],
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
    inputs = {"reduce": require(run_dir, "reduce", 1).key}
    with build(run_dir, "diagnose", DIAGNOSIS_FORMAT, {"own": [], "nominal": {}}, inputs) as made:
        write_json(made.folder / "diagnosis.json", {"verdict": "explained", "causes": causes})
    correct.run(run_dir, correct.Config(), SYNC)
    found = offset_errors(
        run_dir / "products", folder / "case-0001", truth, examination.bench(0)
    )  # fmt: skip
    assert [one.axis for one in found] == ["x", "y"]
    worst = max(one.before for one in found)
    assert before[0] < worst < before[1]
    assert any(one.biased for one in found) == (truth.names == ("ipc",))
    for one in found:
        if named is None:
            assert one.after == one.before
        else:
            assert 0.9 < one.after < 1.15


# Frames made elsewhere.


@pytest.fixture(scope="module")
def flat() -> Recording:
    """Flats of a bench without noise of the pixels."""
    layout = LAYOUTS["small"]
    bench = draw_bench(layout, np.random.default_rng(2))
    quiet = replace(bench.detector, prnu_rms=0.0, hot_fraction=0.0, read_noise_e=0.0)
    bench = replace(bench, detector=replace(quiet, gain_e_per_adu=1.0, bias_pixel_rms_adu=0.0))
    return next(r for r in recordings(bench) if r.kind == "flat" and r.number == 2)


def exposed(made: Elsewhere, recording: Recording, count: int) -> Any:
    shape = recording.bench.detector.shape
    camera = made.camera(recording.bench, (0, shape[0]), ())
    return np.stack([s for _, s in camera.expose(recording, range(count))]).astype(float)


def test_frames_of_the_other_simulator_have_shot_noise_and_fringes(flat: Recording) -> None:
    frames = exposed(Elsewhere(), flat, 20)
    mean = flat.electrons
    bias = frames.mean(axis=0) - mean
    assert frames.var(axis=0, ddof=1).mean() == pytest.approx(mean, rel=0.02)
    assert np.median(bias) == pytest.approx(flat.bench.detector.bias_adu, abs=3 * 12 + 12)
    scan = next(r for r in recordings(flat.bench) if r.kind == "fringes")
    one = exposed(Elsewhere(), scan, 1)[0]
    power = np.abs(np.fft.fft(one - one.mean(), axis=1)).mean(axis=0)[1 : one.shape[1] // 2]
    pitch = flat.bench.detector.pitch_um * 1e-3
    spacing = 632.8e-6 * 400 / (scan.bench.frames.fringes[0].baseline_mm[0] * pitch)
    assert one.shape[1] / (np.argmax(power) + 1) == pytest.approx(spacing, rel=0.1)


def test_the_other_simulator_does_not_mind_how_rows_are_cut(flat: Recording) -> None:
    made = Elsewhere("lag", 0.01)
    whole = exposed(made, flat, 4)
    for rows in ((0, 40), (40, 61)):
        camera = made.camera(flat.bench, rows, ())
        (own,) = [s for _, s in camera.expose(flat, range(3, 4))]
        assert np.array_equal(own, whole[3, slice(*rows)])


def test_what_galsim_does_is_what_the_library_means(flat: Recording) -> None:
    """Sizes of GalSim's effects in the frames, against those of the library's own."""
    plain = exposed(Elsewhere(), flat, 40)
    light = flat.electrons
    bent = exposed(Elsewhere("nonlinearity", 0.02), flat, 40)
    assert (bent - plain).mean() == pytest.approx(-0.02 * light**2 / 50_000, rel=0.02)

    late = exposed(Elsewhere("lag", 0.01), flat, 40)
    assert (late - plain)[0].mean() == pytest.approx(-0.01 * light, rel=0.02)
    assert (late - plain)[2:].mean() == pytest.approx(0, abs=2)

    coarse = exposed(Elsewhere("quantisation", 3.0), flat, 2)
    assert np.all(coarse % 4 == 0)

    coupled = exposed(Elsewhere("ipc", 0.01), flat, 1)[0]
    own = couple(
        (exposed(Elsewhere(), flat, 1)[0] - _bias(flat)).astype(np.float32),
        [Coupling(dy, 0, 0.01) for dy in (-1, 1)] + [Coupling(0, dx, 0.005) for dx in (-1, 1)],
        (0, 0),
    )
    assert np.abs(coupled - _bias(flat) - own)[1:-1, 1:-1].max() < 2

    moved = exposed(Elsewhere("brighter_fatter", 1e-6), flat, 40)
    loss = plain.var(axis=0, ddof=1).mean() - moved.var(axis=0, ddof=1).mean()
    # A pixel's four boundaries move by the charge on either side: 4 px/e- times the mean squared.
    assert loss == pytest.approx(8 * 1e-6 * light**2, rel=0.25)


def _bias(recording: Recording) -> Any:
    camera = Elsewhere().camera(recording.bench, (0, recording.bench.detector.shape[0]), ())
    return camera.pixels.bias


def test_galsim_that_is_missing_is_named(flat: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr("pixcal.stages.blind.elsewhere.importlib.import_module", missing)
    for effect in FOREIGN:
        with pytest.raises(InputError, match="pip install galsim"):
            exposed(Elsewhere(effect, 0.01), flat, 2)


# A whole examination, so that the diagnosis cannot rot.


@pytest.mark.long
def test_strong_effects_are_found_and_nothing_is_claimed(tmp_path: Path) -> None:
    """Development cases, whose seed is no examination's; a minute in all."""
    rows = drawn("row_noise", 12.0)
    truths = (
        Truth(ONE, "lag", (KERNEL,)),
        Truth(NOTHING, "ipc"),
        Truth(LEFT_OUT, "row_noise", (rows,)),
        Truth(ELSEWHERE, "ipc", (Drawn("lag", "", 0.01, 9.0, {}),), elsewhere=True),
    )
    folder, sealed = tmp_path / "exam", tmp_path / "truth.json"
    write_examination(folder, sealed, Examination(12, "tiny", truths), SYNC)
    assert blind.run(folder, blind.RunConfig(), SYNC) == (4, 0)
    found = blind.score(folder, sealed, blind.ScoreConfig(), SYNC)
    assert [case["why"] for case in found["cases"]] == 4 * [""]
    for part in found["parts"].values():
        for question, count in part["questions"].items():
            if "sigma" not in question:
                assert count["right"] == count["of"], question
    asked = [q["of"] for part in found["parts"].values() for q in part["questions"].values()]
    assert sum(asked) > 10
    assert found["sittings"]["without_maps"] == 0
    biased = found["maps"]["biased"]
    assert biased["maps"] == 2
    assert biased["before"] > 3
    assert biased["after"] < found["maps"]["target"]
    # What stays of a case is small.
    kept = sum(f.stat().st_size for f in (folder / "runs").rglob("*") if f.is_file())
    assert kept < 4 * 1_000_000
