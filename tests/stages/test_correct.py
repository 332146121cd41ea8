"""Maps without the effects of a diagnosis: at the bound, the same however it runs."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pixcal
from pixcal.effects import parse_effects
from pixcal.effects.brighter_fatter import BrighterFatter
from pixcal.effects.ipc import Ipc
from pixcal.effects.nonlinearity import Nonlinearity
from pixcal.engine.run import Runtime
from pixcal.kernels.crosstalk import couple
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, FringeMaps
from pixcal.stages import correct, fit
from pixcal.stages.correct import stage as correct_stage
from pixcal.stages.correct.gain import excess, repeating, worsened
from pixcal.stages.correct.sweep_to_correct import RestoredSet, corrected
from pixcal.stages.correct.uncertainty import moved
from pixcal.stages.reduced_set import ReducedSet
from pixcal.stages.treatment import treatments
from pixcal.storage.artefact import build
from pixcal.storage.cube import create_group, write_array
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import write_json
from pixcal.storage.products import read_map
from pixcal.storage.stage import require
from pixcal_cli.main import invoke

DIAGNOSIS_FORMAT = STAGES["diagnose"].format

F64 = np.typing.NDArray[np.float64]
SYNC = Runtime(cluster="sync")
SETS = {"vertical": "delta_x", "horizontal": "delta_y"}
GLOW = """
from dataclasses import dataclass
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Stage

@dataclass(frozen=True)
class Glow(Effect):
    \"\"\"Light of the amplifier.\"\"\"
    name, title, acts_at = "glow", "glow", Stage.LIGHT
    domains, strengths, sources = ("intensity",), ("electrons",), ("nowhere in particular",)
    electrons: float = quantity(100.0, unit="e-", low=0, doc="in every pixel")
"""


def seen_through(bench: Any, act: Callable[[F64], F64]) -> Any:
    """A bench whose charge, shot noise included, goes through something before it is read."""

    def read_out(electrons: F64) -> Any:
        read = act(bench.rng.poisson(electrons).astype(float))
        read += bench.rng.normal(0, bench.read_noise, electrons.shape)
        return np.clip(np.rint(read / bench.gain + bench.bias), 0, 65535).astype(np.uint16)

    bench.read_out = read_out
    return bench


def diagnosed(run: Path, *causes: Effect | dict[str, Any], verdict: str = "explained") -> None:
    """Write the diagnosis that a run would have."""
    inputs = {"reduce": require(run, "reduce").key}
    with build(run, "diagnose", DIAGNOSIS_FORMAT, {"own": [], "nominal": {}}, inputs) as made:
        found = [
            {"effect": c.name, "parameters": to_plain(c)} if isinstance(c, Effect) else c
            for c in causes
        ]
        write_json(made.folder / "diagnosis.json", {"verdict": verdict, "causes": found})


def with_calibration(run: Path, bench: Any, reseal: Callable[..., None]) -> Path:
    """What a correction asks of the reduction beyond the frames."""
    write_json(run / "reduce" / "reduce.json", {"read_noise_e": {"used": bench.read_noise}})
    create_group(run / "reduce" / "calibration.zarr")
    for name, value in (("flat", bench.flat), ("dark_rate", np.zeros(bench.shape))):
        write_array(
            run / "reduce" / "calibration.zarr" / name,
            value.astype(np.float32),
            dims=("y", "x"),
            chunks=(128, 128),
        )
    columns = {"exptime_s": [0.02] * bench.frames, "time_s": [*range(bench.frames)]}
    times = {f"fringes/{name}": columns for name in bench.sets}
    write_json(run / "ingest" / "frames.json", times)
    reseal(run / "ingest", run / "reduce")
    return run


@pytest.fixture(scope="module")
def coupled(make_bench, write_reduced, reseal, tmp_path_factory):
    """Four-row crosstalk on a window of two uneven tiles, fitted and corrected."""
    bench = make_bench(shape=(70, 150), frames=120, delta=2e-3)
    seen_through(bench, lambda charge: couple(charge, Ipc().couplings))
    run = write_reduced(bench, tmp_path_factory.mktemp("correct") / "run")
    with_calibration(run, bench, reseal)
    fit.run(run, fit.Config(), SYNC)
    before = {file.name: file.read_bytes() for file in (run / "products").iterdir()}
    diagnosed(run, Ipc())
    correct.run(run, correct.Config(), SYNC)
    return bench, run, before, json.loads((run / "products" / "correction.json").read_text())


@pytest.mark.parametrize(("name", "times"), [("vertical", 1.7), ("horizontal", 15.0)])
def test_corrected_maps_are_at_the_bound_and_their_errors_honest(coupled, name, times):
    """Couplings along the fringes shift them far more than those across (issue 4)."""
    bench, run, _, found = coupled
    truth = bench.delta_x if name == "vertical" else bench.delta_y
    bound = bench.bound(name)
    before, *_ = read_map(run / "products" / f"{SETS[name]}.fits")
    after, sigma, mask, header = read_map(run / "products" / f"{SETS[name]}_corrected.fits")
    errors = [bench.without_modes(m - truth, name) for m in (before, after)]
    assert np.nanstd(errors[0]) > times * bound
    assert np.nanstd(errors[1]) < 1.2 * bound
    assert np.nanstd(errors[1] / sigma) == pytest.approx(1, abs=0.06)
    np.testing.assert_array_equal(np.isnan(after), mask > 0)
    assert header["NEFFECT"] == 1
    assert header["EFFECT1"] == "ipc"
    # What is told is what happened.
    own = found["sets"][name]
    assert own["change"]["rms_px"] == pytest.approx(np.nanstd(after - before), rel=1e-3)
    assert own["change"]["max_px"] == pytest.approx(np.nanmax(abs(after - before)), rel=1e-3)
    assert own["change_by_effect"]["ipc"]["rms_px"] == pytest.approx(own["change"]["rms_px"], 0.01)


def test_the_pattern_of_rows_goes(coupled):
    *_, found = coupled
    rows = found["sets"]["horizontal"]["rows"]
    assert rows["before_px"] > 20 * rows["chance_px"]
    assert rows["after_px"] < 4 * rows["chance_px"]
    columns = found["sets"]["horizontal"]["columns"]
    assert columns["after_px"] < 4 * columns["chance_px"]


def test_halves_of_the_frames_differ_as_their_errors_say(coupled):
    """Neighbours no longer share their noise, so it has grown."""
    *_, found = coupled
    for name in SETS:
        halves = found["sets"][name]["halves"]
        assert halves["after_px"] == pytest.approx(halves["after_expected_px"], rel=0.06)
        assert halves["after_px"] > halves["before_px"]
        sigma = found["sets"][name]["sigma_median_px"]
        assert sigma["after"] == pytest.approx(halves["after_px"], rel=0.06)


def test_errors_of_a_set_whose_halves_disagree_are_enlarged_and_nothing_else(
    coupled, tmp_path, monkeypatch
):
    _, run, *_ = coupled
    again = tmp_path / "run"
    shutil.copytree(run, again)
    shutil.rmtree(again / "corrected")
    factors = iter((2.0, 1.0))
    monkeypatch.setattr(correct_stage, "excess", lambda _: next(factors))
    correct.run(again, correct.Config(), SYNC)
    sets = json.loads((again / "products" / "correction.json").read_text())["sets"]
    assert [own["sigma_enlarged"] for own in sets.values()] == [2.0, 1.0]
    halves = sets["vertical"]["halves"]
    assert halves["after_expected_px"] == pytest.approx(2 * halves["after_px"], rel=0.06)
    for name, factor in (("vertical", 2.0), ("horizontal", 1.0)):
        file = f"{SETS[name]}_corrected.fits"
        (delta, sigma, *_), (delta_again, larger, *_) = (
            read_map(folder / "products" / file) for folder in (run, again)
        )
        np.testing.assert_array_equal(delta_again, delta)
        np.testing.assert_allclose(larger, factor * sigma, rtol=1e-3)


def test_what_the_fit_wrote_is_untouched(coupled):
    _, run, before, _ = coupled
    assert {name: (run / "products" / name).read_bytes() for name in before} == before
    left = {file.name for file in (run / "products").iterdir()} - set(before)
    assert left == {"delta_x_corrected.fits", "delta_y_corrected.fits", "correction.json"}


@pytest.mark.quick(1)
@pytest.mark.parametrize("runtime", [Runtime("threads", workers=2), Runtime("processes", 2)])
def test_the_same_bits_however_it_runs(coupled, tmp_path, runtime):
    _, run, *_ = coupled
    again = tmp_path / "run"
    shutil.copytree(run, again)
    shutil.rmtree(again / "corrected")
    correct.run(again, correct.Config(), runtime)
    for name in ("delta_x_corrected.fits", "delta_y_corrected.fits", "correction.json"):
        first, second = (folder / "products" / name for folder in (run, again))
        assert first.read_bytes().replace(key(run), b"") == second.read_bytes().replace(
            key(again), b""
        )


def key(run: Path) -> bytes:
    return require(run, "corrected").key.encode()


def test_a_piece_with_its_halo_is_undone_as_the_whole():
    """Bands of any height: rows are counted from the window's first, which halos do not move."""
    rng = np.random.default_rng(3)
    x = np.mgrid[:103, :61][1]
    psi = 1.2 * (x + 0.01 * rng.standard_normal(x.shape))
    theta = 2e4 * np.stack([np.ones(x.shape), 0.9 * np.sin(psi), 0.9 * np.cos(psi)])
    ghost, straylight = parse_effects({"ghost_fringes": None, "straylight": None}, "test")
    effects = (Ipc(), straylight, ghost)
    whole = np.sum(corrected(FringeMaps(theta, (1.2, 0.0)), effects)[1], axis=0)
    halo = sum(effect.undo_halo for effect in effects)
    for first, last in ((0, 7), (31, 60), (87, 103)):
        a, b = max(0, first - halo), min(103, last + halo)
        steps = corrected(FringeMaps(theta[:, a:b], (1.2, 0.0), (a, 0)), effects)[1]
        piece = np.sum(steps, axis=0)[first - a : last - a]
        np.testing.assert_allclose(piece, whole[first:last], rtol=0, atol=1e-9)


def test_what_errors_of_parameters_leave_is_told(coupled, tmp_path):
    """With a share that is off by its error the map is off by as much as is said."""
    _, run, *_ = coupled
    again = tmp_path / "run"
    shutil.copytree(run, again)
    plain = to_plain(Ipc())
    plain["couplings"][0]["share"] += 0.004
    cause = {"effect": "ipc", "parameters": plain, "uncertainty": {"couplings[0].share": 0.004}}
    diagnosed(again, cause)
    correct.run(again, correct.Config(), SYNC)
    found = json.loads((again / "products" / "correction.json").read_text())
    for name, product in SETS.items():
        a, b = (read_map(r / "products" / f"{product}_corrected.fits")[0] for r in (run, again))
        told = found["sets"][name]["parameter_error_px"]["ipc"]
        assert told == pytest.approx(np.nanstd(a - b), rel=0.1)


def test_a_parameter_at_its_limit_is_moved_to_the_other_side():
    (ghost,) = parse_effects({"ghost_fringes": {"share": 0.9, "beat_rad_px": [0.3, 0.2]}}, "test")
    shares = [e.share for e in moved(ghost, {"share": 0.01})]
    assert shares == [pytest.approx(0.89)]
    beats = [e.beat_rad_px for e in moved(ghost, {"beat_rad_px[1]": 0.1})]
    assert beats == [(0.3, pytest.approx(0.3))]
    assert moved(ghost, {"no such": 0.1}) == []


def test_work_is_not_done_twice_and_lost_products_come_back(coupled, tmp_path):
    _, run, *_ = coupled
    again = tmp_path / "run"
    shutil.copytree(run, again)
    made = (again / "corrected" / "manifest.json").stat().st_mtime_ns
    product = again / "products" / "delta_y_corrected.fits"
    content = product.read_bytes()
    product.unlink()
    correct.run(again, correct.Config(), SYNC)
    assert (again / "corrected" / "manifest.json").stat().st_mtime_ns == made
    assert product.read_bytes() == content


def test_without_a_gap_the_maps_of_the_fit_stand(coupled, tmp_path):
    """Those of an earlier diagnosis go."""
    _, run, before, _ = coupled
    again = tmp_path / "run"
    shutil.copytree(run, again)
    diagnosed(again, verdict="no gap")
    correct.run(again, correct.Config(), SYNC)
    found = json.loads((again / "products" / "correction.json").read_text())
    assert found["verdict"] == "no gap"
    assert found["effects"] == found["outputs"] == []
    assert {f.name for f in (again / "products").iterdir()} == {*before, "correction.json"}


def test_what_the_fit_takes_up_is_said(coupled, tmp_path):
    _, run, *_ = coupled
    again = tmp_path / "run"
    shutil.copytree(run, again)
    names = ("intensity_noise", "telegraph_noise", "row_noise")
    diagnosed(again, *parse_effects(dict.fromkeys(names), "test"))
    correct.run(again, correct.Config(), SYNC)
    found = json.loads((again / "products" / "correction.json").read_text())
    assert [e["treatment"] for e in found["effects"]] == [
        "absorbed by the fit",
        "not corrected",
        "not corrected",
    ]
    assert found["outputs"] == []


def test_effects_known_before_the_diagnosis_are_undone_too(tmp_path):
    found = treatments([], {"ipc": to_plain(Ipc())}, "auto", {"only": "paraxial"}, (), tmp_path)
    assert [t.effect for t in found.on_maps] == [Ipc()]
    assert found.every[0].origin == "nominal"


@pytest.mark.parametrize(
    ("asked", "taken", "how"),
    [
        ("auto", "hyperbolic", "in the fit"),
        ("auto", "paraxial", "in the corrected fit"),
        ("paraxial", "paraxial", "not corrected"),
    ],
)
def test_bent_fringes_are_for_the_shape_that_is_fitted(tmp_path, asked, taken, how):
    causes = [{"effect": "hyperbolic_fringes", "parameters": {}}]
    found = treatments(causes, {}, asked, {"one": "hyperbolic", "two": taken}, (), tmp_path)
    assert found.every[0].how == how
    assert found.curved == (how == "in the corrected fit")
    assert ("--model hyperbolic" in found.every[0].why) == (how == "not corrected")


def test_bent_fringes_that_the_fit_did_not_see_are_fitted(coupled, tmp_path):
    _, run, *_ = coupled
    again = tmp_path / "run"
    shutil.copytree(run, again)
    diagnosed(again, *parse_effects({"hyperbolic_fringes": None}, "test"))
    correct.run(again, correct.Config(), SYNC)
    found = json.loads((again / "products" / "correction.json").read_text())
    assert found["outputs"] == ["delta_x", "delta_y"]
    assert {s["fit"]["model"] for s in found["sets"].values()} == {"hyperbolic"}
    header = read_map(again / "products" / "delta_x_corrected.fits")[3]
    assert (header["MODEL"], header["NEFFECT"]) == ("hyperbolic", 0)


def test_every_effect_of_pixcal_has_a_treatment_with_a_reason(tmp_path):
    from pixcal.effects import effects

    causes = [{"effect": name, "parameters": {}} for name in effects()]
    for one in treatments(causes, {}, "auto", {"only": "paraxial"}, (), tmp_path).every:
        assert "its file" not in one.why, one.effect.name
    assert not any(kind.absorbed_because and kind.left_because for kind in effects().values())


def test_without_a_diagnosis_it_says_what_to_run(make_bench, write_reduced, tmp_path):
    run = write_reduced(make_bench(shape=(30, 31), frames=40), tmp_path / "run")
    with pytest.raises(InputError, match=r"diagnose: not there yet; run 'pixcal diagnose"):
        correct.run(run, correct.Config(), SYNC)
    assert not (run / "fit").exists()
    of = {"own": [], "nominal": {}}
    with build(run, "diagnose", DIAGNOSIS_FORMAT, of, {"reduce": "earlier"}) as made:
        write_json(made.folder / "diagnosis.json", {"verdict": "no gap", "causes": []})
    with pytest.raises(InputError, match="reduced differently; run 'pixcal diagnose"):
        correct.run(run, correct.Config(), SYNC)


def test_an_effect_of_the_users_own_is_asked_for(coupled, tmp_path):
    _, run, *_ = coupled
    again = tmp_path / "run"
    shutil.copytree(run, again)
    file = tmp_path / "glow.py"
    file.write_text(GLOW)
    (glow,) = treatments(
        [{"effect": "glow", "parameters": {}}], {}, "auto", {}, (file,), run / "diagnose"
    ).every
    assert glow.why == "its file has no method to correct it"
    diagnosed(again, glow.effect)
    with pytest.raises(InputError, match=r"'glow' is not an effect of pixcal; .* --own FILE"):
        correct.run(again, correct.Config(), SYNC)
    spoilt = GLOW + "\n    def undo(self, maps):\n        return None\n"
    file.write_text(spoilt)
    with pytest.raises(InputError, match="'glow': undo does not return finite maps"):
        correct.run(again, correct.Config(with_diagnosis=True, own=(file,)), SYNC)


def test_a_file_of_the_users_own_may_be_in_any_encoding_of_python(coupled, tmp_path):
    """What depends on it depends on its bytes."""
    _, run, *_ = coupled
    again = tmp_path / "run"
    shutil.copytree(run, again)
    file = tmp_path / "glow.py"
    keys = set()
    for author in ("Andr\xe9", "Ren\xe9"):
        file.write_bytes(f"# coding: latin-1\n# by {author}\n{GLOW}".encode("latin-1"))
        diagnosed(again, {"effect": "glow", "parameters": {}})
        keys.add(correct.run(again, correct.Config(with_diagnosis=True, own=(file,)), SYNC).key)
    assert len(keys) == 2


@pytest.fixture(scope="module")
def bent(make_bench, write_reduced, reseal, tmp_path_factory):
    """A response that is not linear: few frames, and more of it than there is, to see it well."""
    bench = make_bench(
        shape=(50, 61),
        frames=60,
        delta=2e-3,
        response=0.01,
        sets={"low": (0.0, 4.0), "high": (0.0, 6.0)},
        interfringe=None,
    )
    effect = Nonlinearity(quadratic=-0.08)
    seen_through(bench, lambda charge: effect.response(charge.astype(np.float32)).astype(float))
    run = write_reduced(bench, tmp_path_factory.mktemp("correct") / "run")
    with_calibration(run, bench, reseal)
    diagnosed(run, effect)
    correct.run(run, correct.Config(), SYNC)
    return bench, run, json.loads((run / "products" / "correction.json").read_text())


def test_what_acts_on_samples_is_undone_as_they_are_swept_again(bent):
    bench, run, found = bent
    (effect,) = found["effects"]
    assert effect["treatment"] == "corrected on samples"
    for name in ("low", "high"):
        own = found["sets"][name]
        assert own["chi2_reduced"]["before"] > 1.3
        assert own["chi2_reduced"]["after"] == pytest.approx(1.0, abs=0.03)
        assert own["change_by_effect"]["nonlinearity"] == own["change"]
    before, *_ = read_map(run / "products" / "delta_fringe.fits")
    after, sigma, *_ = read_map(run / "products" / "delta_fringe_corrected.fits")
    errors = [m - bench.delta_y for m in (before, after)]
    modes = np.concatenate([bench.modes(name) for name in ("low", "high")])
    rms = []
    for error in errors:
        c = np.linalg.lstsq(modes.reshape(len(modes), -1).T, error.ravel(), rcond=None)[0]
        rms.append(np.std(error - np.tensordot(c, modes, 1)))
    assert rms[0] > 1.3 * rms[1]
    assert rms[1] == pytest.approx(np.median(sigma), rel=0.08)


def test_sets_along_one_axis_tell_how_much_was_gained(bent):
    *_, found = bent
    (pair,) = found["pairs"]
    assert pair["sets"] == ["low", "high"]
    assert pair["before_px"] > 1.2 * pair["after_px"]
    assert pair["after_px"] == pytest.approx(pair["after_expected_px"], rel=0.08)
    chi2 = found["sets_chi2_reduced"]
    assert chi2["after"] == pytest.approx(1.0, abs=0.1)


def test_samples_of_a_tile_are_freed_as_those_of_the_whole_frame(coupled):
    """What spreads charge to neighbours spreads it from tile to tile."""
    _, run, *_ = coupled
    folder = run / "reduce" / "reduced.zarr" / "vertical"
    effects = (BrighterFatter(shift_px_per_e=2e-6),)
    source = RestoredSet(
        folder, effects, run / "reduce" / "calibration.zarr", np.full(120, 0.02, np.float32)
    )
    plain = ReducedSet(folder)
    stored = plain.signal.read((64, 66))
    charge = stored * np.float32(plain.coding.scale) + np.float32(plain.coding.offset)
    whole = effects[0].undo_samples(charge.astype(np.float32))
    for at in source.tiles():
        y, x = source.ranges(at)
        codes = source.codes(at, 1)[:2]
        found = codes * source.coding.scale + source.coding.offset
        expected = whole[:, slice(*y), slice(*x)]
        assert np.abs(found - expected).max() <= 0.51 * source.coding.scale
        assert np.abs(expected - charge[:, slice(*y), slice(*x)]).max() > 20


def test_samples_without_weight_stay_without(coupled):
    _, run, *_ = coupled
    folder = run / "reduce" / "reduced.zarr" / "vertical"
    source = RestoredSet(
        folder, (Nonlinearity(),), run / "reduce" / "calibration.zarr", np.ones(120, np.float32)
    )
    codes = np.array([[1000, 65535, 3000]], np.uint16)
    found = source._restored(codes, np.ones((1, 3), np.float32), np.zeros((1, 3), np.float32))
    assert found[0, 1] == 65535
    assert (found[0, [0, 2]] < 65535).all()


def test_a_pattern_is_told_from_what_changes_slowly():
    rows = np.arange(61)
    slow = 0.03 * rows
    pattern = np.array([3.0, -1.0, -1.0, -1.0])[rows % 4]
    assert repeating(slow) == pytest.approx(0, abs=1e-12)
    assert repeating(slow + pattern) == pytest.approx(np.sqrt(3.0))
    holes = slow + pattern
    holes[[5, 40]] = np.nan
    assert repeating(holes) == pytest.approx(np.sqrt(3.0), rel=0.02)
    holes[::4] = np.nan
    assert repeating(holes) is None


def test_the_command_prints_a_table_and_refuses_in_one_line(
    coupled, tmp_path, capsys: pytest.CaptureFixture[str]
):
    _, run, *_ = coupled
    again = tmp_path / "run"
    shutil.copytree(run, again)
    command = ["fit", str(again), "--with-diagnosis", "--quiet"]
    assert invoke(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"fit: {again}/fit (up to date)"
    assert lines[1] == f"corrected: {again}/corrected (up to date)"
    assert any(line.split()[:4] == ["ipc", "corrected", "on", "maps"] for line in lines)
    assert "second baseline" in lines[-1]
    diagnosed(again, verdict="no gap")
    assert invoke(command) == 0
    assert "no gap: the diagnosis found no effect" in capsys.readouterr().out
    assert invoke(["fit", str(again), "--own", "glow.py"]) == 2
    assert "--with-diagnosis" in capsys.readouterr().err
    shutil.rmtree(again / "diagnose")
    assert invoke(command) == 2
    assert f"run 'pixcal diagnose {again}' first" in capsys.readouterr().err


def test_from_python(coupled, tmp_path):
    _, run, *_ = coupled
    again = tmp_path / "run"
    shutil.copytree(run, again)
    (again / "products" / "correction.json").unlink()
    pixcal.fit(again, with_diagnosis=True, runtime=SYNC)
    assert (again / "products" / "correction.json").exists()


def _pattern(before: float, after: float) -> dict[str, float]:
    return {"period_px": 4, "before_px": before, "after_px": after, "chance_px": 1e-4}


def test_a_correction_that_leaves_a_larger_pattern_is_refused() -> None:
    good = {"pixels": 10_000, "rows": _pattern(3e-3, 1e-4), "columns": _pattern(1e-4, 2e-4)}
    assert worsened({"vertical": good}, []) == ""
    assert worsened({"vertical": good | {"rows": None}}, []) == ""
    bad = good | {"columns": _pattern(1e-4, 1e-3)}
    assert "pattern of columns grows" in worsened({"vertical": good, "horizontal": bad}, [])


@pytest.mark.parametrize(("after", "factor"), [(0.9e-3, 1.0), (1.04e-3, 1.0), (2.1e-3, 2.1)])
def test_errors_cover_the_difference_of_the_halves(after: float, factor: float) -> None:
    halves = {"after_px": after, "after_expected_px": 1e-3}
    assert excess({"pixels": 10_000, "halves": halves}) == pytest.approx(factor)
    assert excess({"pixels": 100, "halves": halves | {"after_px": 1.1e-3}}) == 1
    assert excess({"pixels": 10_000, "halves": None}) == 1


def test_a_correction_that_moves_sets_apart_is_refused() -> None:
    sets = {n: {"pixels": 10_000, "rows": None, "columns": None} for n in ("short", "long")}
    pair = {
        "sets": ["short", "long"],
        "before_px": 1.2e-3,
        "before_expected_px": 1e-3,
        "after_px": 1.0e-3,
        "after_expected_px": 1e-3,
    }
    assert worsened(sets, [pair]) == ""
    assert worsened(sets, [pair | {"after_px": 1.21e-3}]) == ""
    assert "differ by 0.0013 px" in worsened(sets, [pair | {"after_px": 1.3e-3}])
    # Closer than before, with errors that have become smaller still.
    closer = {"before_px": 1.3e-3, "after_px": 1.25e-3, "after_expected_px": 0.8e-3}
    assert worsened(sets, [pair | closer]) == ""
