"""``pixcal compare``: runs that agree, runs that do not, and halves of one."""

import json
import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pixcal.engine.run import Runtime
from pixcal.kernels.optics import PARAMETERS, Geometry, fringe_vector, phase, phase_jacobian
from pixcal.model.errors import DamagedError, InputError, PlanError
from pixcal.stages import compare, fit
from pixcal.stages.compare import Config, stage
from pixcal.storage.cube import create_array, create_group, write_array
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.manifest import Manifest, write_json

F64 = NDArray[np.float64]
SYNC = Runtime("sync")
SHAPE = (141, 187)
"""On uneven tiles; sizes without a common divisor."""


@dataclass
class Maps:
    """A fitted run made of true offsets and noise, without any frames."""

    delta_x: F64
    delta_y: F64
    sigma: dict[str, float] = field(default_factory=lambda: {"vertical": 8e-4, "horizontal": 6e-4})
    vectors: dict[str, tuple[float, float]] = field(
        default_factory=lambda: {"vertical": (0.65, 0.01), "horizontal": (-0.01, 0.62)}
    )
    batches: int = 0
    seed: int = 0
    model: str = "paraxial"
    phases: dict[str, float] = field(default_factory=dict)
    geometry: dict[str, float] = field(default_factory=dict)

    def write(self, run: Path, **patterns: F64) -> Path:
        """Write what ``pixcal fit`` leaves; ``patterns`` are added to a set's map."""
        rng = np.random.default_rng(self.seed)
        shape = self.delta_x.shape
        sets: dict[str, Any] = {}
        detector = {"pitch_um": 4.4, "gain_e_per_adu": 1.0, "read_noise_e": 16.0}
        frames = [{"name": n, "files": ["x"], "baseline_mm": [6.0, 1.0]} for n in self.vectors]
        acquisition = {
            "schema": "pixcal/acquisition/1",
            "detector": detector,
            "optics": {"wavelength_nm": 632.8, "distance_mm": 400.0},
            "frames": {"fringes": frames},
        }
        for folder in ("ingest", "fit"):
            (run / folder).mkdir(parents=True)
        write_json(run / "ingest" / "acquisition.json", acquisition)
        create_group(run / "fit" / "fit.zarr")
        for name, (kx, ky) in self.vectors.items():
            k = np.hypot(kx, ky)
            delta = (kx * self.delta_x + ky * self.delta_y) / k + patterns.get(name, 0.0)
            self._write_set(run / "fit" / "fit.zarr" / name, delta, self.sigma[name], rng)
            sets[name] = {
                "frames": 200,
                "interfringe_px": 2 * np.pi / k,
                "model": self.model,
                "axis": [kx / k, ky / k],
                "kx": kx,
                "ky": ky,
                "phase_at_origin_rad": self.phases.get(name, 0.0),
                "geometry": self.geometry,
            }
        write_json(run / "fit" / "fit.json", {"sets": sets, "shape": list(shape)})
        manifest = Manifest("fit", 1, f"key of {run.name}", {}, {})
        write_json(run / "fit" / "manifest.json", asdict(manifest))
        return run

    def _write_set(self, group: Path, delta: F64, sigma: float, rng: Any) -> None:
        create_group(group)
        # Brighter in the middle: errors that differ over the window.
        y, x = (np.linspace(-1, 1, n) for n in delta.shape)
        sigmas = sigma * (1 + 0.2 * (y[:, None] ** 2 + x[None, :] ** 2))
        noise = sigmas * rng.normal(size=delta.shape)
        if self.batches:
            n = self.batches
            parts = sigmas * np.sqrt(n) * rng.normal(size=(n, *delta.shape))
            noise = parts.mean(axis=0)
            counts = np.full(n, 20, np.int32)
            self._write(group / "batch_delta", delta + parts)
            self._write(group / "batch_sigma", np.broadcast_to(sigmas * np.sqrt(n), parts.shape))
            write_array(group / "batch_count", counts, dims=("batch",))
        self._write(group / "delta", delta + noise)
        self._write(group / "sigma", sigmas)
        self._write(group / "iota", np.full(delta.shape, 2e4))
        self._write(group / "alpha", np.full(delta.shape, 1.9e4))

    def _write(self, path: Path, values: Any) -> None:
        chunks = (*values.shape[:-2], 128, 128)
        dims = ("batch", "y", "x")[-values.ndim :]
        writer = create_array(path, values.shape, "<f4", dims=dims, chunks=chunks)
        writer.write((0,) * values.ndim, np.asarray(values, np.float32))
        writer.finish()


@pytest.fixture(scope="module")
def truth() -> tuple[F64, F64]:
    """Offsets of every pixel, and steps between blocks of 47 x 62."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(2):
        steps = np.kron(rng.normal(0, 2e-3, (3, 4)), np.ones((47, 62)))[: SHAPE[0], : SHAPE[1]]
        found.append(rng.normal(0, 2e-3, SHAPE) + steps)
    return found[0], found[1]


@pytest.fixture
def make(truth: tuple[F64, F64], tmp_path: Path) -> Any:
    """Write a run: ``make("name", seed=3, vertical=pattern)``."""

    def write(name: str, *, patterns: dict[str, F64] | None = None, **options: Any) -> Path:
        return Maps(*truth, **options).write(tmp_path / name, **(patterns or {}))

    return write


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes longer than all the rest: one test does it."""
    monkeypatch.setattr(stage, "png", lambda figure: b"")
    monkeypatch.setattr(stage, "compare_figure", lambda *_: None)


def result(out: Path, *runs: Path, config: Config | None = None, runtime: Runtime = SYNC) -> Any:
    compare.run(runs, out, config or Config(), runtime)
    return json.loads((out / "compare.json").read_text())


def only_pair(out: Path, *runs: Path, **options: Any) -> Any:
    (pair,) = result(out, *runs, **options)["pairs"]
    return pair["components"]


def without_plane(delta: F64) -> F64:
    y, x = np.mgrid[: delta.shape[0], : delta.shape[1]]
    plane = np.stack([np.ones(delta.size), x.ravel(), y.ravel()], axis=1)
    fit_of = np.linalg.lstsq(plane, delta.ravel(), rcond=None)[0]
    return np.asarray(delta - (plane @ fit_of).reshape(delta.shape))


OTHER = {"vertical": (0.52, -0.008), "horizontal": (0.012, 0.71)}


def test_simulated_and_fitted_runs_agree_within_their_noise(
    make_bench: Any, write_reduced: Any, tmp_path: Path
) -> None:
    """The same pixels under other baselines, other frames, other noise; and one against itself."""
    benches = [
        make_bench(shape=(81, 95), frames=140, interfringe=i, seed=s, laser_noise=0.02)
        for i, s in ((6.0, 4), (8.5, 5))
    ]
    benches[1].delta_x, benches[1].delta_y = benches[0].delta_x, benches[0].delta_y
    runs = [write_reduced(b, tmp_path / f"run{n}") for n, b in enumerate(benches)]
    for run in runs:
        fit.run(run, fit.Config(), Runtime())
    found = only_pair(tmp_path / "out", *runs)
    for name, facts in found.items():
        assert facts["verdict"] == "agree", (name, facts["evidence"])
        assert facts["modes_removed"] >= 11
        assert facts["ratio"] == pytest.approx(1.0, abs=3 * facts["ratio_error"])
        assert abs(facts["slope"] - 1) < 4 * facts["slope_error"]
        # True offsets of 6e-3 px, less what eleven modes of 7695 pixels take of them.
        assert facts["common"]["px"] == pytest.approx(6e-3, rel=0.03)
        assert not facts["suspicion"]
    # Two sides of one run: shorter, so noisier by sqrt 2 than each whole.
    halves = only_pair(tmp_path / "halves", runs[0])
    for name, facts in halves.items():
        assert facts["verdict"] == "agree", (name, facts["evidence"])
        assert facts["ratio"] == pytest.approx(1.0, abs=3 * facts["ratio_error"])
        whole = json.loads((runs[0] / "products" / "fit.json").read_text())["sets"]
        sigma = whole["vertical" if name == "delta_x" else "horizontal"]["sigma_median_px"]
        # Batches of 16 frames each fit their own level and contrast, and 12 frames are left over.
        assert 2 * sigma < facts["expected_px"] < 1.15 * 2 * sigma


def test_what_is_common_and_what_is_noise(make: Any, truth: Any, tmp_path: Path) -> None:
    one, two = make("one", seed=1), make("two", seed=2, vectors=OTHER)
    out = tmp_path / "out"
    found = only_pair(out, one, two)
    assert set(found) == {"delta_x", "delta_y"}
    for (name, facts), delta in zip(found.items(), truth, strict=True):
        assert facts["verdict"] == "agree", facts["evidence"]
        assert facts["common"]["px"] == pytest.approx(np.std(without_plane(delta)), rel=0.01)
        assert facts["pixels"] == SHAPE[0] * SHAPE[1]
        assert facts["pull_spread"] == pytest.approx(1, abs=0.02)
        sizes = [s["side_px"] for s in facts["scales"]]
        assert sizes == [1, 2, 4, 8, 16, 32]
        # The scales add up, in squares and in degrees of freedom.
        for key in ("difference_px", "expected_px"):
            total = np.sqrt(sum(s[key] ** 2 for s in facts["scales"]))
            assert total == pytest.approx(facts[key], rel=1e-4)
        freedom = sum(s["freedom"] for s in facts["scales"])
        assert freedom == pytest.approx(facts["pixels"] - facts["modes_removed"])
        # White offsets hold three quarters of their variance in single pixels.
        first = facts["scales"][0]["common"]["variance_px2"]
        assert first == pytest.approx(0.75 * 4e-6, rel=0.05), name
    assert {p.name for p in out.iterdir()} >= {"compare.json", "compare.png", "manifest.json"}


def test_a_pattern_on_one_side_is_found_at_its_scale_with_its_size(
    make: Any, tmp_path: Path
) -> None:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    tiles = 5e-4 * np.where((y // 16 + x // 16) % 2, 1.0, -1.0)
    one, two = make("one", seed=1), make("two", seed=2, patterns={"vertical": tiles})
    facts = only_pair(tmp_path / "out", one, two)["delta_x"]
    assert facts["verdict"] == "differ"
    scale = {s["side_px"]: s for s in facts["scales"]}
    excess = scale[16]["beyond_noise"]
    assert excess["px"] == pytest.approx(5e-4, abs=3 * excess["error_px"])
    assert excess["error_px"] < 0.15 * excess["px"]
    assert scale[16]["significance"] == max(s["significance"] for s in facts["scales"]) > 10
    assert all(abs(scale[n]["significance"]) < 4 for n in (1, 2, 4, 8))
    own = [facts["own"][n]["variance_px2"] for n in (0, 1)]
    errors = [facts["own"][n]["variance_error_px2"] for n in (0, 1)]
    assert own[1] == pytest.approx(25e-8, abs=4 * errors[1])
    assert abs(own[0]) < 4 * errors[0]
    # delta_y has its own set, and no pattern.
    assert only_pair(tmp_path / "out", one, two)["delta_y"]["verdict"] == "agree"


def test_a_pattern_on_both_sides_is_common(make: Any, tmp_path: Path) -> None:
    _, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    bars = 1.5e-3 * np.where(x // 16 % 2, 1.0, -1.0)
    runs = [make(f"run{n}", seed=n, patterns={"vertical": bars}) for n in (1, 2)]
    plain = [make(f"plain{n}", seed=n) for n in (3, 4)]
    with_bars = only_pair(tmp_path / "a", *runs)["delta_x"]
    without = only_pair(tmp_path / "b", *plain)["delta_x"]
    assert with_bars["verdict"] == "agree"
    more = [
        a["common"]["variance_px2"] - b["common"]["variance_px2"]
        for a, b in zip(with_bars["scales"], without["scales"], strict=True)
    ]
    assert more[4] == pytest.approx(1.5e-3**2, rel=0.15)


def test_rows_blocks_and_pixels_are_named(make: Any, tmp_path: Path) -> None:
    y, _ = np.mgrid[: SHAPE[0], : SHAPE[1]]
    saw = np.array([3e-4, -1e-4, -3e-4, 1e-4])[y % 4]
    patch = np.zeros(SHAPE)
    patch[64:96, 96:144] = 5e-4
    patch[10, 20] = patch[101, 7] = 0.02
    one = make("one", seed=1)
    two = make("two", seed=2, patterns={"vertical": patch, "horizontal": saw})
    found = only_pair(tmp_path / "out", one, two)
    rows = found["delta_y"]["rows"]
    assert rows["period"]["px"] == pytest.approx(4.0, rel=0.01)
    assert rows["period"]["amplitude_px"] == pytest.approx(3.16e-4, rel=0.15)
    assert rows["significance"] > 10
    assert found["delta_y"]["columns"]["significance"] < 4
    assert any(e.startswith("rows: period 4") for e in found["delta_y"]["evidence"])
    facts = found["delta_x"]
    worst = {(p["y"], p["x"]) for p in facts["outliers"]["worst"]}
    assert worst == {(10, 20), (101, 7)}
    assert facts["outliers"]["beyond_5_sigma"] == facts["pixels_left_out"] == 2
    assert "2 single pixels" in facts["evidence"]
    blocks = [b for b in facts["blocks"]["worst"] if b["kind"] == "mean"]
    assert blocks
    for block in blocks:
        assert block["y"][0] >= 64 - 8
        assert block["x"][0] >= 96 - 8
        assert block["y"][1] <= 96 + 8
        assert block["x"][1] <= 144 + 8
        assert block["difference_px"] == pytest.approx(5e-4, abs=4 * block["error_px"])


def test_modes_that_one_side_cannot_know_are_no_difference(make: Any, tmp_path: Path) -> None:
    """A plane and the fringes of either side, at its own frequency and twice it."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    kx, ky = OTHER["vertical"]
    psi = kx * x + ky * y
    modes = 2e-3 * (x / 100 - y / 70 + 1) + 1e-3 * np.cos(psi + 1) + 5e-4 * np.sin(2 * psi)
    one = make("one", seed=1)
    two = make("two", seed=2, vectors=OTHER, patterns={"vertical": modes})
    assert only_pair(tmp_path / "out", one, two)["delta_x"]["verdict"] == "agree"
    # The same fringes are a difference where no side could have left them.
    same = make("same", seed=2, patterns={"vertical": modes})
    assert only_pair(tmp_path / "other", one, same)["delta_x"]["verdict"] == "differ"


def test_modes_of_hyperbolic_fringes(make: Any, tmp_path: Path) -> None:
    """What a fibre's place does to the fringes is no difference when it was fitted."""
    pitch, middle = 4.4e-3, [(n - 1) / 2 * 4.4e-3 for n in SHAPE[::-1]]
    values = [middle[0] + 15, middle[1] - 12, 400.0, 5.95, 0.1, 0.2]
    geometry = Geometry(632.8e-6, pitch, *values)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    kx, ky = (float(v) for v in fringe_vector(93.0, 70.0, geometry))
    moved = phase_jacobian(x, y, geometry) @ [0.3, -0.2, 1.0, 1e-3, 1e-3, 0.1] / np.hypot(kx, ky)
    curved = moved - moved.mean() + 1e-3 * np.sin(2 * phase(x, y, geometry))
    curved = curved / np.std(without_plane(curved)) * 1e-3
    facts = {f"{n}_mm": v for n, v in zip(PARAMETERS, values, strict=True)}
    sets = {"vectors": {"vertical": (kx, ky)}, "sigma": {"vertical": 8e-4}}
    one = make("one", seed=1, **sets)
    exact = {"model": "hyperbolic", "geometry": facts, **sets}
    origin = {"vertical": float(phase(0.0, 0.0, geometry))}
    two = make("two", seed=2, patterns={"vertical": curved}, phases=origin, **exact)
    facts = only_pair(tmp_path / "out", one, two)["delta_fringe"]
    assert facts["verdict"] == "agree", facts["evidence"]
    straight = make("straight", seed=2, patterns={"vertical": curved}, **sets)
    assert only_pair(tmp_path / "no", one, straight)["delta_fringe"]["verdict"] == "differ"


def test_errors_that_are_too_small_show_at_every_scale(make: Any, tmp_path: Path) -> None:
    quiet = {"vertical": 8e-4, "horizontal": 6e-4}
    one = make("one", seed=1, sigma=quiet)
    rng = np.random.default_rng(8)
    two = make("two", seed=2, patterns={"vertical": rng.normal(0, 8e-4, SHAPE)})
    facts = only_pair(tmp_path / "out", one, two)["delta_x"]
    for scale in facts["scales"]:
        assert scale["ratio"] == pytest.approx(1.22, abs=4 * scale["ratio_error"])
    assert facts["beyond_noise"]["px"] == pytest.approx(8e-4, rel=0.1)
    # A small misfit of SIGMA is not a difference; one may ask for more.
    slight = make("slight", seed=3, patterns={"vertical": rng.normal(0, 2.5e-4, SHAPE)})
    assert only_pair(tmp_path / "slightly", one, slight)["delta_x"]["verdict"] == "agree"
    strict = only_pair(tmp_path / "strict", one, slight, config=Config(sigma_accuracy=0.0))
    assert strict["delta_x"]["scales"][0]["significance"] > 2


def test_a_map_and_its_copy_agree_too_well(make: Any, tmp_path: Path) -> None:
    one = make("one", seed=1)
    shutil.copytree(one, tmp_path / "copy")
    facts = only_pair(tmp_path / "out", one, tmp_path / "copy")["delta_x"]
    # A difference of sums of squares: zero to the root of a float's precision.
    assert facts["difference_px"] < 1e-7 * max(facts["rms_px"])
    assert "share frames" in facts["suspicion"]


def test_halves_and_odd_batches(make: Any, tmp_path: Path) -> None:
    run = make("run", seed=3, batches=7)
    for split, labels in (
        ("halves", ("run, first half", "run, second half")),
        ("odd-even", ("run, odd batches", "run, even batches")),
    ):
        whole = result(tmp_path / split, run, config=Config(split=split))
        assert tuple(side["label"] for side in whole["sides"]) == labels
        for facts in whole["pairs"][0]["components"].values():
            assert facts["verdict"] == "agree", facts["evidence"]
            assert facts["ratio"] == pytest.approx(1.0, abs=3 * facts["ratio_error"])
    frames = [side["frames_of_part"]["vertical"] for side in whole["sides"]]
    assert frames == [80, 60]


def test_a_drift_shows_between_halves_and_not_between_odd_and_even(
    make: Any, tmp_path: Path
) -> None:
    run = make("run", seed=3, batches=8)
    y, _ = np.mgrid[: SHAPE[0], : SHAPE[1]]
    path = run / "fit/fit.zarr/vertical/batch_delta"
    values = ArrayReader(path).read()
    values += (np.linspace(-1, 1, 8)[:, None, None] * 3e-3 * (y // 20 % 2)).astype(np.float32)
    shutil.rmtree(path)
    writer = create_array(path, values.shape, "<f4", dims=("batch", "y", "x"), chunks=(8, 128, 128))
    writer.write((0, 0, 0), values)
    writer.finish()
    halves = only_pair(tmp_path / "halves", run)["delta_x"]
    assert halves["verdict"] == "differ"
    assert halves["rows"]["period"]["px"] == pytest.approx(40, rel=0.2)
    other = only_pair(tmp_path / "odd", run, config=Config(split="odd-even"))["delta_x"]
    assert other["beyond_noise"]["variance_px2"] < 0.1 * halves["beyond_noise"]["variance_px2"]


@pytest.mark.long
def test_three_runs_tell_which_is_odd(make: Any, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    steps = np.kron(rng.normal(0, 1e-3, (18, 24)), np.ones((8, 8)))[: SHAPE[0], : SHAPE[1]]
    runs = [
        make("one", seed=1),
        make("two", seed=2, patterns={"vertical": steps}),
        make("three", seed=3),
    ]
    whole = result(tmp_path / "out", *runs)
    assert [p["sides"] for p in whole["pairs"]] == [[0, 1], [0, 2], [1, 2]]
    own = whole["summary"]["delta_x"]["own"]
    assert own[1]["px"] == pytest.approx(np.std(steps), abs=3 * own[1]["error_px"])
    for n in (0, 2):
        assert abs(own[n]["variance_px2"]) < 4 * own[n]["variance_error_px2"]
    pictures = {p.name for p in (tmp_path / "out").glob("*.png")}
    assert pictures == {"compare-1-2.png", "compare-1-3.png", "compare-2-3.png"}
    # Compared again with fewer: the old pictures go.
    result(tmp_path / "out", *runs[:2])
    assert {p.name for p in (tmp_path / "out").glob("*.png")} == {"compare.png"}


def test_one_set_against_two(make: Any, tmp_path: Path) -> None:
    """A run with one axis is compared along it, whichever way it points."""
    both = make("both", seed=1)
    single = make("single", seed=2, vectors={"vertical": (-0.4, 0.3)}, sigma={"vertical": 7e-4})
    found = only_pair(tmp_path / "out", both, single)
    assert set(found) == {"delta_fringe"}
    facts = found["delta_fringe"]
    assert facts["direction"] == pytest.approx([-0.8, 0.6])
    assert facts["verdict"] == "agree", facts["evidence"]
    assert facts["slope"] == pytest.approx(1, abs=4 * facts["slope_error"])
    # Both sets have their share of the error along it: 0.8² and 0.6² of theirs.
    sigma = np.sqrt(0.64 * 8e-4**2 + 0.36 * 6e-4**2 + 7e-4**2)
    assert facts["expected_px"] == pytest.approx(sigma * 1.14, rel=0.03)
    backwards = make("back", seed=3, vectors={"a": (0.44, -0.33)}, sigma={"a": 7e-4})
    found = only_pair(tmp_path / "other", single, backwards)
    assert found["delta_fringe"]["slope"] == pytest.approx(1, abs=0.05)


def test_masked_pixels_of_either_side_do_not_count(make: Any, tmp_path: Path) -> None:
    holes = [np.zeros(SHAPE), np.zeros(SHAPE)]
    holes[0][5, :], holes[1][:, 9] = np.nan, np.nan
    runs = [make(f"run{n}", seed=n, patterns={"vertical": hole}) for n, hole in enumerate(holes)]
    facts = only_pair(tmp_path / "out", *runs)["delta_x"]
    assert facts["pixels_missing"] == SHAPE[0] + SHAPE[1] - 1
    assert facts["pixels"] + facts["pixels_missing"] == SHAPE[0] * SHAPE[1]
    assert facts["verdict"] == "agree"
    assert facts["rows"]["worst"]["at"] != 5


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "runtime", [Runtime("threads", workers=3), Runtime("processes", workers=2)]
)
def test_the_same_numbers_however_it_runs(make: Any, tmp_path: Path, runtime: Runtime) -> None:
    one, two = make("one", seed=1), make("two", seed=2)
    a = result(tmp_path / "a", one, two)
    assert result(tmp_path / "b", one, two, runtime=runtime) == a


def test_the_picture(make: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    compare.run([make("one", seed=1), make("two", seed=2)], tmp_path / "out", Config(), SYNC)
    with Image.open(tmp_path / "out" / "compare.png") as picture:
        assert min(picture.size) > 1000


def test_what_is_up_to_date_is_left_alone(make: Any, tmp_path: Path) -> None:
    one, two = make("one", seed=1), make("two", seed=2)
    out = tmp_path / "out"
    first = compare.run([one, two], out, Config(), SYNC)
    before = (out / "compare.json").stat().st_mtime_ns
    assert compare.run([one, two], out, Config(), SYNC) == first
    assert (out / "compare.json").stat().st_mtime_ns == before
    assert compare.run([two, one], out, Config(), SYNC).key != first.key


def test_mistakes_are_named(make: Any, truth: Any, tmp_path: Path) -> None:
    one, out = make("one", seed=1), tmp_path / "out"
    with pytest.raises(InputError, match="nowhere: no such run"):
        compare.run([one, tmp_path / "nowhere"], out, Config(), SYNC)
    small = Maps(truth[0][:99], truth[1][:99]).write(tmp_path / "small")
    with pytest.raises(
        InputError, match=r"small: a window of 187 x 99 px, .*187 x 141.*same shape"
    ):
        compare.run([one, small], out, Config(), SYNC)
    lone = [
        make(n, vectors={n: v}, sigma={n: 1e-3}) for n, v in (("a", (0.6, 0.0)), ("b", (0.3, 0.5)))
    ]
    with pytest.raises(InputError, match="b: its fringes are rotated by 59 degrees"):
        compare.run(lone, out, Config(), SYNC)
    with pytest.raises(InputError, match="single: set 'vertical' has too few batches"):
        compare.run([make("single", batches=1)], out, Config(), SYNC)
    strange = make("strange", model="elliptic")
    with pytest.raises(InputError, match="strange: fitted with 'elliptic'"):
        compare.run([one, strange], out, Config(), SYNC)
    empty = make("empty", patterns={"vertical": np.full(SHAPE, np.nan)})
    with pytest.raises(InputError, match="0 pixels have delta_x in both"):
        compare.run([one, empty], out, Config(), SYNC)
    two = make("two", seed=2)
    with pytest.raises(InputError, match=r"--out .*one: holds other results of pixcal"):
        compare.run([one, two], one, Config(), SYNC)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"--out .*file: is a file"):
        compare.run([one, two], tmp_path / "file", Config(), SYNC)
    with pytest.raises(PlanError, match=r"--memory: the comparison of delta_x"):
        compare.run([one, two], out, Config(), Runtime("sync", memory=64 << 20))
    chunk = next((one / "fit/fit.zarr/vertical/delta/c").rglob("1"))
    target = chunk if chunk.is_file() else next(p for p in chunk.rglob("*") if p.is_file())
    target.write_bytes(target.read_bytes()[:-5])
    with pytest.raises(DamagedError, match="vertical/delta"):
        compare.run([one, two], out, Config(), SYNC)
