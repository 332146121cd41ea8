"""The diagnosis on small acquisitions: what is there is found, what is not is not."""

import json
import shutil
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.io import fits

from pixcal.effects import effects, known_effects
from pixcal.effects.hyperbolic_fringes import HyperbolicFringes
from pixcal.effects.intra_pixel_response import IntraPixelResponse
from pixcal.effects.nonlinearity import Nonlinearity
from pixcal.effects.straylight import Straylight
from pixcal.engine.run import Runtime
from pixcal.estimators.test_statistics import DETECTOR, measure
from pixcal.kernels.frame_order import runs
from pixcal.model.bench import Bench
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect
from pixcal.stages import correct, diagnose, fit, ingest, reduce, simulate
from pixcal.stages.diagnose import frames, search_run, stage, trial, windows
from pixcal.stages.diagnose.diagnosis_input import prepare_input
from pixcal.stages.diagnose.frames import frames_of_half, split
from pixcal.stages.diagnose.parts import evidence_of
from pixcal.stages.diagnose.windows import chosen_windows, whole_of
from pixcal_cli.main import invoke

SYNC = Runtime(cluster="sync")
SMALL = {"detector.shape": [53, 59], "frames.fringes.0.count": 120, "frames.fringes.1.count": 110}
FEW = ("lag", "row_noise", "fringe_jitter", "quantisation")
"""Candidates of most tests, for speed."""


@pytest.fixture(scope="session")
def reduced(
    tmp_path_factory: pytest.TempPathFactory, make_effect_bench: Callable[..., Bench]
) -> Callable[..., Path]:
    """A reduced run of a small bench: ``reduced(effects, changes)``."""

    def make(effects: dict[str, Any] | None = None, changes: dict[str, Any] | None = None) -> Path:
        folder = tmp_path_factory.mktemp("diagnose")
        bench = to_plain(make_effect_bench(SMALL | (changes or {}), effects))
        (folder / "bench.yaml").write_text(yaml.safe_dump(bench))
        simulate.run(folder / "bench.yaml", folder / "acq", simulate.Config(), SYNC)
        ingest.run(folder / "acq", folder / "run", ingest.Config(), SYNC)
        reduce.run(folder / "run", reduce.Config(), SYNC)
        return folder / "run"

    return make


@pytest.fixture(scope="session")
def with_lag(reduced: Callable[..., Path]) -> Path:
    return reduced({"lag": {"share": 0.004}})


@pytest.fixture
def few_references(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that do not ask what is chance: simulating takes most of the time."""
    monkeypatch.setattr(search_run, "REFERENCES", 6)


def diagnosed(run: Path, **options: Any) -> dict[str, Any]:
    diagnose.run(run, diagnose.Config(**options), SYNC)
    found: dict[str, Any] = json.loads((run / "products" / "diagnosis.json").read_text())
    return found


@pytest.mark.long
def test_an_effect_is_found_and_closes_the_gap(with_lag: Path) -> None:
    found = diagnosed(with_lag, only=FEW)
    assert found["schema"] == "pixcal/diagnosis/1"
    assert found["verdict"] == "explained"
    (cause,) = found["causes"]
    assert cause["effect"] == "lag"
    error = cause["uncertainty"]["share"]
    assert cause["parameters"]["share"] == pytest.approx(0.004, abs=4 * error)
    assert error < 4e-4
    assert cause["gap_closed"] > 0.85
    assert cause["gap_closed_interval"][0] <= cause["gap_closed"] <= cause["gap_closed_interval"][1]
    assert cause["p_value"] < 1e-6
    gap = found["gap"]
    assert gap["total"] == 1
    assert gap["interval"][0] <= gap["after"] <= gap["interval"][1] < 0.3
    for entry in gap["where"]:
        assert {"domain", "statistic", "measured", "simulated", "z", "after", "place"} <= set(entry)
    assert {"time"} <= {entry["domain"] for entry in gap["where"]}
    for row in gap["absolute"]:
        assert {"quantity", "unit", "measured", "simulated", "after"} <= set(row)
    assert {c["effect"] for c in found["candidates"]} == set(FEW)
    assert {c["effect"] for c in found["candidates"] if not c["rejected_because"]} == {"lag"}
    # Made once; other maps of the offsets change nothing.
    made = (with_lag / "diagnose" / "manifest.json").stat().st_mtime_ns
    fit.run(with_lag, fit.Config(), SYNC)
    assert diagnosed(with_lag, only=FEW) == found
    assert (with_lag / "diagnose" / "manifest.json").stat().st_mtime_ns == made


def test_frames_less_an_effect_show_it_no_more(reduced: Callable[..., Path]) -> None:
    """Only its change without noise is subtracted: their noise stays as it is."""
    inputs = prepare_input(reduced({"nonlinearity": {}}), SYNC)
    window, raw = inputs.first, inputs.learn()
    freed = window.bench.without(raw, window.learn, [Nonlinearity()])
    before, after = (evidence_of(one, window.part, window.whole) for one in (raw, freed))
    assert (Nonlinearity.detect(before) or 0) > 50
    assert abs(Nonlinearity.detect(after) or 0) < 3
    for name, fringes in after.fringes.items():
        assert np.nanstd(fringes.residual) < np.nanstd(before.fringes[name].residual)
        assert fringes.adu.dtype == before.fringes[name].adu.dtype


@pytest.mark.long
def test_other_random_numbers_of_the_simulations_change_no_more_than_the_interval(
    with_lag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = diagnosed(with_lag, only=FEW)
    run = tmp_path / "run"
    shutil.copytree(with_lag, run, ignore=shutil.ignore_patterns("diagnose", "products"))
    taken = trial.Window.evidence

    def with_other_seeds(
        self: trial.Window, half: Any, effects: Any, seed: int, *more: Any, **named: Any
    ) -> Any:
        return taken(self, half, effects, seed + 50_000, *more, **named)

    monkeypatch.setattr(trial.Window, "evidence", with_other_seeds)
    again = diagnosed(run, only=FEW)
    assert again["verdict"] == found["verdict"]
    assert again["gap"]["where"] != found["gap"]["where"]
    (one,), (other,) = found["causes"], again["causes"]
    assert one["effect"] == other["effect"]
    assert one["parameters"] == other["parameters"]
    # Both have an interval.
    for first, second in (
        (one["gap_closed_interval"], other["gap_closed_interval"]),
        (found["gap"]["interval"], again["gap"]["interval"]),
    ):
        assert max(first[0], second[0]) <= min(first[1], second[1])


@pytest.mark.long
@pytest.mark.usefixtures("few_references")
def test_a_run_that_was_stopped_goes_on(
    with_lag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Simulations that were made are not made again, and the result is the same."""
    run, only = tmp_path / "run", ("row_noise",)
    shutil.copytree(with_lag, run)
    made: list[int] = []
    make, last = trial._made, 0

    def stops(*args: Any) -> Any:
        made.append(1)
        if len(made) == last:
            raise KeyboardInterrupt
        return make(*args)

    monkeypatch.setattr(trial, "_made", stops)
    whole = diagnosed(with_lag, only=only)
    needed = len(made)
    made.clear()
    last = 4
    with pytest.raises(KeyboardInterrupt):
        diagnosed(run, only=only)
    assert not (run / "diagnose").exists() or whole != json.loads(
        (run / "products" / "diagnosis.json").read_text()
    )
    assert diagnosed(run, only=only) == whole
    # One was begun twice.
    assert len(made) == needed + 1 > last
    assert not list((run / ".partial").glob("diagnose-*"))


@pytest.mark.long
def test_left_out_it_is_not_put_on_another(with_lag: Path) -> None:
    found = diagnosed(with_lag, only=tuple(name for name in FEW if name != "lag"))
    assert found["verdict"] == "unexplained"
    assert not found["causes"]
    assert found["gap"]["after"] == pytest.approx(1, abs=0.01)
    worst = {entry["statistic"] for entry in found["gap"]["where"][:4]}
    assert {"contrast_by_step", "frames_before"} & worst


@pytest.mark.long
def test_in_the_nominal_bench_it_is_no_gap(
    with_lag: Path, tmp_path: Path, make_effect_bench: Callable[..., Bench]
) -> None:
    """A richer bench as the starting point."""
    bench = to_plain(make_effect_bench({}, {"lag": {"share": 0.004}}))
    (tmp_path / "richer.yaml").write_text(yaml.safe_dump(bench))
    found = diagnosed(with_lag, only=("row_noise",), nominal=tmp_path / "richer.yaml")
    assert found["verdict"] == "no gap"
    assert found["gap"]["total"] == 0


@pytest.mark.long
def test_of_a_nominal_bench_nothing_is_claimed(reduced: Callable[..., Path]) -> None:
    """Every effect is a candidate; the same on processes."""
    run = reduced()
    found = diagnosed(run)
    assert found["verdict"] == "no gap"
    assert not found["causes"]
    written = (run / "diagnose" / "curves.json").read_bytes()
    again = diagnose.run(run, diagnose.Config(), Runtime(cluster="processes", workers=2))
    assert again.summary["verdict"] == "no gap"
    assert (run / "diagnose" / "curves.json").read_bytes() == written


@pytest.mark.long
def test_without_fringes_noise_and_intensity_are_looked_at(reduced: Callable[..., Path]) -> None:
    run = reduced(
        {"row_noise": {"row_rms": 6.0}},
        {"frames.fringes": [], "frames.bias": 60, "detector.shape": [101, 97]},
    )
    found = diagnosed(run, only=("row_noise", "lag", "ipc"))
    assert [cause["effect"] for cause in found["causes"]] == ["row_noise"]
    assert found["verdict"] == "explained"
    assert {entry["domain"] for entry in found["gap"]["where"]} <= {"noise", "intensity", "time"}


@pytest.mark.long
def test_a_bent_ladder_of_flats_is_a_gap_and_its_response_closes_it(
    reduced: Callable[..., Path],
) -> None:
    run = reduced({"nonlinearity": {}}, {"frames.fringes": []})
    found = diagnosed(run, only=("nonlinearity", "row_noise"))
    assert [cause["effect"] for cause in found["causes"]] == ["nonlinearity"]
    assert found["verdict"] == "explained"
    assert "flat_ladder" in {entry["statistic"] for entry in found["gap"]["where"]}


@pytest.mark.long
def test_a_saturated_step_of_the_ladder_is_left_out(reduced: Callable[..., Path]) -> None:
    """Whether or not its level is declared; the rest is looked at as before."""
    steps = [{"exptime_s": t, "count": 20} for t in (0.01, 0.02, 0.03, 0.08)]
    short = {"frames.fringes.0.count": 60, "frames.fringes.1.count": 60}
    inputs = prepare_input(reduced(None, short | {"frames.flats": steps}), SYNC)
    again = measure(inputs.first.evidence(inputs.first.test, (), 3))
    for found in (inputs.measured, again):
        for name in ("flat_ladder", "photon_transfer"):
            assert len(found[name, DETECTOR].value) == 3
    assert np.ptp(inputs.measured["flat_ladder", DETECTOR].value) < 1e-3


def test_a_part_of_a_large_detector_is_enough_without_fringes(
    reduced: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(windows, "LARGEST", 60)
    monkeypatch.setattr(windows, "SIDE", 40)
    for module in (windows, frames):
        monkeypatch.setattr(module, "SAMPLES", 400_000)
    run = reduced(None, {"detector.shape": [131, 127], "frames.fringes": []})
    inputs = prepare_input(run, SYNC)
    assert len(inputs.windows) == 4
    again = measure(inputs.first.evidence(inputs.first.test, (), 3))
    assert inputs.measured.keys() <= again.keys()


@pytest.mark.long
def test_a_corner_without_light_is_left_out(
    reduced: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(windows, "LARGEST", 60)
    monkeypatch.setattr(windows, "SIDE", 40)
    short = {"frames.fringes.0.count": 60, "frames.fringes.1.count": 60}
    run = reduced(None, short | {"detector.shape": [131, 127]})
    acquisition = run.parent / "acq"
    for file in (*acquisition.glob("vertical/*.fits"), *acquisition.glob("horizontal/*.fits")):
        with fits.open(file, mode="update") as opened:
            opened[0].data[:, :60, :60] = 500
    other = run.parent / "other"
    ingest.run(acquisition, other, ingest.Config(), SYNC)
    reduce.run(other, reduce.Config(), SYNC)
    inputs = prepare_input(other, SYNC)
    (left,) = inputs.facts.left_out
    assert left["window"] == ((9, 49), (9, 49))
    assert left["reason"]
    assert len(inputs.facts.tried_on["windows"]) == len(inputs.windows) == 3
    # Nothing of the one that failed gets into those after it.
    levels = [w.bench.measured.sets[0].light.mean() for w in inputs.windows]
    assert min(levels) > 0.5 * max(levels) > 1000


def test_frames_too_few_to_part_are_named(reduced: Callable[..., Path]) -> None:
    changes = {"frames.bias": 3, "frames.fringes.0.count": 60, "frames.fringes.1.count": 60}
    assert prepare_input(reduced(None, changes), SYNC).facts.shared == ("bias",)


OWN = '''
from dataclasses import dataclass
import numpy as np
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage

@dataclass(frozen=True)
class Flicker(Effect):
    """Every second frame is brighter."""
    name, title, acts_at = "flicker", "every second frame brighter", Stage.LIGHT
    domains, strengths, sources = ("time",), ("size",), ("nowhere in particular",)
    size: float = quantity(0.01, low=-1, high=1, doc="relative")

    def photons(self, mean, shot):
        own = shot.recording.kind == "fringes" and shot.frame % 2
        return mean * np.float32(1 + self.size) if own else mean

    @classmethod
    def estimate(cls, evidence):
        sets = evidence.fringes.values()
        light = [f.free[:, 0] / f.free[:, 0].mean() for f in sets]
        odd = [f.frame % 2 == 1 for f in sets]
        sizes = [b[o].mean() - b[~o].mean() for b, o in zip(light, odd)]
        error = np.std(np.concatenate([np.diff(b[~o]) for b, o in zip(light, odd)])) / 5
        size, error = float(np.mean(sizes)), max(float(error), 1e-6)
        return Estimate(cls(size), {"size": error}, abs(size) / error, "odd frames")
'''


@pytest.mark.long
def test_an_effect_of_the_users_own_is_found(reduced: Callable[..., Path], tmp_path: Path) -> None:
    file = tmp_path / "flicker.py"
    file.write_text(OWN)
    run = reduced()
    raw = run.parent / "acq"
    for path in sorted(raw.glob("vertical/*.fits")) + sorted(raw.glob("horizontal/*.fits")):
        with fits.open(path, mode="update", memmap=False) as hdus:
            frames = hdus[0].data.astype(float)
            frames[1::2] = (frames[1::2] - 500) * 1.01 + 500
            hdus[0].data = np.round(frames).astype(np.uint16)
    ingest.run(raw, run, ingest.Config(), SYNC)
    reduce.run(run, reduce.Config(), SYNC)
    found = diagnosed(run, only=("flicker", "lag"), own=(file,))
    assert [cause["effect"] for cause in found["causes"]] == ["flicker"]
    assert found["causes"][0]["parameters"]["size"] == pytest.approx(0.01, rel=0.05)


@pytest.mark.long
@pytest.mark.usefixtures("few_references")
def test_an_effect_of_the_users_own_may_be_in_the_nominal_bench(
    with_lag: Path,
    tmp_path: Path,
    make_effect_bench: Callable[..., Bench],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Its file is in any encoding that Python reads."""
    file = tmp_path / "flicker.py"
    file.write_bytes(f"# coding: latin-1\n# by Andr\xe9\n{OWN}".encode("latin-1"))
    nominal = tmp_path / "richer.yaml"
    bench = to_plain(make_effect_bench({}, {"flicker": {"size": 0.01}}))
    nominal.write_text(yaml.safe_dump(bench))
    line = ["diagnose", str(with_lag), "--nominal", str(nominal), "--effects", "row_noise"]
    line += ["--cluster", "sync", "--quiet"]
    assert invoke(line) == 2
    told = capsys.readouterr().err
    assert "unknown effect 'flicker'" in told
    assert "--own" in told
    assert invoke([*line, "--own", str(file)]) == 0
    config = json.loads((with_lag / "diagnose" / "manifest.json").read_text())["config"]
    assert config["nominal"] == {"flicker": {"size": 0.01}}
    found = json.loads((with_lag / "products" / "diagnosis.json").read_text())
    # Frames that do not flicker differ from a bench that does.
    assert found["verdict"] == "unexplained"
    assert "intensity: spectrum over the frames" in {
        entry["title"] for entry in found["gap"]["where"]
    }


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"only": ("lagg",)}, "did you mean 'lag'?"),
        ({"without": ("colour",)}, "unknown effect"),
        (
            {"only": ("lag", "ipc"), "without": ("lag",)},
            "--effects: lag is a candidate and left out; write either 'lag' or '-lag'",
        ),
        ({"without": tuple(effects())}, "--effects: every effect is left out; keep at least one"),
        ({"own": (Path("nowhere.py"),)}, "nowhere.py: not found"),
        ({"nominal": Path("nowhere.yaml")}, "nowhere.yaml: not found"),
    ],
)
def test_wrong_options_are_told(with_lag: Path, options: dict[str, Any], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        diagnose.run(with_lag, diagnose.Config(**options), SYNC)


def test_too_few_frames_to_part_are_told(reduced: Callable[..., Path]) -> None:
    run = reduced(None, {"frames.fringes.1.count": 20})
    with pytest.raises(InputError, match=r"fringes/horizontal: only 10 frames in one half; .* 24"):
        diagnose.run(run, diagnose.Config(), SYNC)


def test_a_run_that_was_not_reduced_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="reduce"):
        diagnose.run(tmp_path, diagnose.Config(), SYNC)


def test_halves_share_no_frame_but_first_flats_without_fringes() -> None:
    table: dict[str, list[Any]] = {
        "exptime_s": [0.1] * 5 + [0.2] * 3 + [None] * 9,
        "time_s": list(range(17)),
    }
    fringes: dict[str, list[Any]] = {"exptime_s": [0.1] * 101, "time_s": list(range(101))}
    parts = split({"flat": table, "fringes/a": fringes}, 128 * 128)
    learn, test = parts.learn, parts.test
    assert not set(learn["fringes/a"]) & set(test["fringes/a"])
    assert len(learn["fringes/a"]) + len(test["fringes/a"]) == 101
    # Three frames of an exposure time cannot be parted.
    assert set(learn["flat"]) & set(test["flat"]) == {5, 6, 7}
    parts = split({"flat": table}, 128 * 128)
    assert set(parts.learn["flat"]) & set(parts.test["flat"]) == {0, 5, 6, 7, 8}


def test_of_five_darks_three_are_fitted() -> None:
    """A median of three frames rejects a cosmic ray; a mean of two does not."""
    parts = split({"dark": {"exptime_s": [60.0] * 5}}, 128 * 128)
    assert [len(half["dark"]) for half in (parts.learn, parts.test)] == [3, 2]


@pytest.mark.parametrize("count", [32, 200, 600, 732, 9000])
def test_both_halves_see_the_whole_of_time(count: int) -> None:
    table: dict[str, list[Any]] = {"exptime_s": [0.1] * count, "time_s": list(range(count))}
    parts = split({"fringes/a": table}, 128 * 128)
    learn, test = parts.learn["fringes/a"], parts.test["fringes/a"]
    assert not set(learn) & set(test)
    assert abs(len(learn) - len(test)) <= 2
    assert len(learn) == min(count // 2, 366 // 8 * 8)
    # A steady drift is the same in both, and both begin and end near the ends.
    assert learn.mean() == pytest.approx(test.mean(), abs=0.02 * count)
    assert max(learn[0], test[0]) <= 0.26 * count
    assert min(learn[-1], test[-1]) >= 0.7 * count
    # Few frames lack the one before.
    assert max(len(runs(learn)), len(runs(test))) <= max(count // 40, 2)


def test_windows_of_a_large_detector_lie_apart_on_its_chunks() -> None:
    learn, test = chosen_windows((5456, 8320))
    everywhere = [learn, *test]
    assert len(set(everywhere)) == 5
    for (y0, y1), (x0, x1) in everywhere:
        assert (y1 - y0, x1 - x0) == (128, 128)
        assert y0 % 128 == x0 % 128 == 0
        assert 0 <= y0 < y1 <= 5456
        assert 0 <= x0 < x1 <= 8320
    for small in ((61, 67), (180, 288)):
        whole, (same,) = chosen_windows(small)
        assert whole == same == ((0, small[0]), (0, small[1]))


@pytest.mark.parametrize("shape", [(289, 289), (300, 5000), (100, 400), (288, 290), (700, 289)])
def test_windows_that_are_tried_do_not_overlap(shape: tuple[int, int]) -> None:
    """Of pixels that are in two windows the noise would count twice."""
    seen = np.zeros(shape, int)
    _, tried = chosen_windows(shape)
    for (y0, y1), (x0, x1) in tried:
        seen[y0:y1, x0:x1] += 1
    assert seen.max() == 1
    assert len(tried) == (4 if min(shape) > 288 else 2)


@pytest.mark.parametrize(
    "shape", [(512, 640), (1024, 1280), (257, 1000), (300, 2000), (641, 823), (3000, 3000)]
)
def test_few_frames_without_fringes_are_looked_at_in_more_pixels(shape: tuple[int, int]) -> None:
    plain, tried = chosen_windows(shape)
    wide, also = chosen_windows(shape, 60)
    sides = [np.diff(window).ravel() for window in (plain, wide)]
    assert np.prod(sides[1]) > 1.5 * np.prod(sides[0])
    assert (sides[1] >= sides[0]).all()
    pixels = [np.prod(np.diff(window).ravel()) for window in (wide, *also)]
    assert pixels[0] * 60 <= 6e6
    assert sum(pixels[1:]) * 60 <= 6e6
    assert sum(pixels[1:]) > len(tried) * 128 * 128
    for a, b in combinations((wide, *also), 2):
        assert any(p[0] >= q[1] or p[1] <= q[0] for p, q in zip(a, b, strict=True))
    assert chosen_windows(shape, 5000) == (plain, tried)


def test_detectors_of_few_enough_samples_are_looked_at_whole() -> None:
    shape = (300, 400)
    assert chosen_windows(shape, 100)[1] == (whole_of(shape),)
    assert len(chosen_windows(shape, 101)[1]) == 4


@pytest.mark.parametrize(("levels", "count"), [(50, 4), (31, 10), (50, 40), (36, 32)])
def test_each_level_of_a_long_series_of_flats_is_in_both_halves(levels: int, count: int) -> None:
    exposures = np.repeat(np.arange(1.0, 1 + levels), count)
    own = split({"bias": {"exptime_s": [0.0] * 16}, "flat": {"exptime_s": exposures}}, 256**2)
    for half in (own.learn, own.test):
        assert np.unique(exposures[half["flat"]], return_counts=True)[1].min() >= 2
    assert own.shared == ()


def test_stacks_without_fringes_are_cut_to_the_samples_of_a_half() -> None:
    """Where a level has a hundred frames, they do not take the memory of all the others."""
    flat = {"exptime_s": [1.0] * 2 + [2.0] * 100 + [3.0] * 100 + [4.0] * 100}
    tables = {"bias": {"exptime_s": [0.0] * 100}, "flat": flat}
    pixels = 51_200
    own = split(tables, pixels)
    for half in (own.learn, own.test):
        # Each level may share its first flat.
        assert (sum(len(frames) for frames in half.values()) - 3) * pixels <= 6e6
        counts = np.unique(np.array(flat["exptime_s"])[half["flat"]], return_counts=True)[1]
        assert counts[0] == 2
        assert set(counts[1:]) <= {28, 29}
    assert frames_of_half(tables) == 202


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "effect",
    [
        Straylight(share=0.05),
        IntraPixelResponse(),
        Nonlinearity(-0.03, 0.01),
        HyperbolicFringes((90.0, -100.0)),
    ],
)
def test_what_an_effect_takes_from_the_fringes_is_not_taken_twice(
    effect: Effect, reduced: Callable[..., Path]
) -> None:
    """The bench was measured with the effect in it: with the effect it looks as it was measured."""
    changes = {"frames.fringes.0.count": 60, "frames.fringes.1.count": 60}
    run = reduced({effect.name: to_plain(effect)}, changes)
    window = prepare_input(run, SYNC).first

    def seen(on: tuple[Effect, ...]) -> dict[str, tuple[float, float, float]]:
        evidence = window.evidence(window.test, on, 3)
        return {
            name: (
                float(np.median(f.theta[0][f.good]) * f.g[:, 0].mean()),
                float(np.median((np.hypot(*f.theta[1:]) / f.theta[0])[f.good])),
                float(np.hypot(*f.k)),
            )
            for name, f in evidence.fringes.items()
        }

    without, again = seen(()), seen((effect,))
    assert len(again) == 2
    for name, (light, contrast, k) in again.items():
        assert k == pytest.approx(without[name][2], rel=5e-4)
        assert light == pytest.approx(without[name][0], rel=2e-3)
        assert contrast == pytest.approx(without[name][1], rel=2e-3)


@pytest.mark.long
def test_every_acquisition_is_held_against_random_numbers_of_its_own(
    reduced: Callable[..., Path],
) -> None:
    """Of its frames; a fault of chance in sixteen simulations is not that of all nights."""
    short = {"frames.fringes.0.count": 60, "frames.fringes.1.count": 60}
    first, again, other = (
        prepare_input(reduced(None, short | {"seed": seed}), SYNC).first for seed in (3, 3, 4)
    )
    assert first.seed == again.seed != other.seed

    def noise(window: trial.Window) -> np.ndarray:
        simulated = window.bench.simulate(window.test, (), window.seed)
        frames = simulated.arrays["bias"].astype(float)
        return (frames - frames.mean(axis=0)).ravel()

    one, same, another = map(noise, (first, again, other))
    np.testing.assert_array_equal(one, same)
    assert abs(np.corrcoef(one, another)[0, 1]) < 5 / np.sqrt(one.size)


@pytest.mark.long
def test_windows_are_exposed_together(
    reduced: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame has one phase in all windows; pixels have a noise of their own."""
    monkeypatch.setattr(windows, "LARGEST", 40)
    monkeypatch.setattr(windows, "SIDE", 30)
    changes = {"frames.fringes.0.count": 60, "frames.fringes.1.count": 60}
    inputs = prepare_input(reduced(None, changes | {"detector.shape": [85, 89]}), SYNC)
    assert len(inputs.windows) == 4
    assert len({window.seed for window in inputs.windows}) == 1
    for number in (0, 1):
        phi = np.array([w.bench.measured.sets[number].phi for w in inputs.windows])
        steps = np.angle(np.exp(1j * (phi - phi[:, :1])))
        # The fit knows a phase to a few mrad.
        assert np.abs(np.angle(np.exp(1j * (steps - steps[0])))).max() < 0.02
    trials = trial.Trials(inputs.windows, tmp_path, SYNC)
    trials.curves([()], 2, "nominal bench")
    simulated = [[trials.of_window(n, (), 2)[seed] for n in range(4)] for seed in (0, 1)]
    for of_windows in (inputs.each, *simulated):
        for name in ("vertical", "horizontal"):
            noise = np.array([c["residual_noise", name].value for c in of_windows])
            assert np.ptp(noise) > 0


@pytest.mark.long
def test_neither_order_nor_tiling_nor_workers_change_an_answer(
    reduced: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not a digit: two causes, candidates in reverse, a reduction in other pieces, processes."""
    run = reduced({"lag": {"share": 0.004}, "row_noise": {"row_rms": 6.0}})
    found = diagnosed(run, only=FEW)
    assert {cause["effect"] for cause in found["causes"]} == {"lag", "row_noise"}
    other = run.parent / "other"
    pieces = Runtime(cluster="processes", workers=2, memory=1 << 30)
    ingest.run(run.parent / "acq", other, ingest.Config(), pieces)
    reduce.run(other, reduce.Config(), pieces)
    monkeypatch.setattr(
        stage, "known_effects", lambda own: dict(reversed(known_effects(own).items()))
    )
    diagnose.run(other, diagnose.Config(only=FEW), pieces)
    again = json.loads((other / "products" / "diagnosis.json").read_text())
    curves = [
        sorted(
            json.loads((r / "diagnose" / "curves.json").read_text()),
            key=lambda c: (c["statistic"], c["set"]),
        )
        for r in (run, other)
    ]
    assert curves[0] == curves[1]
    by_name = [
        {**f, "candidates": sorted(f["candidates"], key=lambda c: c["effect"])}
        for f in (found, again)
    ]
    assert by_name[0] == by_name[1]


@pytest.mark.long
def test_one_set_is_enough_and_its_corrected_map_is_told(reduced: Callable[..., Path]) -> None:
    """From frames to corrected maps by the diagnosis that was made, not one written by hand."""
    one = {"name": "vertical", "baseline_mm": [11.5, 0.0], "count": 240, "peak_e": 45000}
    run = reduced({"ipc": {}}, {"frames.fringes": [one]})
    found = diagnosed(run, only=("ipc", "lag", "row_noise"))
    (cause,) = found["causes"]
    assert cause["effect"] == "ipc"
    assert found["verdict"] == "explained"
    fit.run(run, fit.Config(), SYNC)
    correct.run(run, correct.Config(), SYNC)
    told = json.loads((run / "products" / "correction.json").read_text())
    assert [e["effect"] for e in told["effects"]] == ["ipc"]


@pytest.mark.long
def test_the_window_that_is_off_is_named(
    reduced: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise that no effect makes, in one corner of a detector that is looked at by windows."""
    monkeypatch.setattr(windows, "LARGEST", 60)
    monkeypatch.setattr(windows, "SIDE", 40)
    run = reduced(None, {"detector.shape": [131, 127], "detector.hot_fraction": 0.0})
    assert diagnosed(run, only=("fringe_jitter", "row_noise"))["verdict"] == "no gap"
    acquisition = run.parent / "acq"
    rng = np.random.default_rng(5)
    for file in (*acquisition.glob("vertical/*.fits"), *acquisition.glob("horizontal/*.fits")):
        with fits.open(file, mode="update") as opened:
            cube = np.asarray(opened[0].data)
            corner = cube[:, 80:, 80:]
            noisy = corner + np.rint(60 * rng.standard_normal(corner.shape))
            cube[:, 80:, 80:] = np.clip(noisy, 0, 65535).astype(cube.dtype)
            opened[0].data = cube
    other = run.parent / "other"
    ingest.run(acquisition, other, ingest.Config(), SYNC)
    reduce.run(other, reduce.Config(), SYNC)
    found = diagnosed(other, only=("fringe_jitter", "row_noise"))
    assert found["verdict"] == "unexplained"
    assert found["more_would_tell"]
    places = found["gap"]["places"]
    assert [p["window"] for p in places] == [
        [[9, 49], [9, 49]],
        [[9, 49], [78, 118]],
        [[82, 122], [9, 49]],
        [[82, 122], [78, 118]],
    ]
    *calm, off = (p["domains"]["noise"] for p in places)
    assert off[0] > 6
    assert all(c[0] < 4 for c in calm)
