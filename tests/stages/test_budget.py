"""``pixcal budget``: what it says, and that a simulated and fitted run agrees."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from pixcal.engine.run import Runtime
from pixcal.model.errors import InputError
from pixcal.stages import budget, fit, ingest, reduce, simulate
from pixcal.stages.budget import Config
from pixcal.stages.budget.expected import frames_needed

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "configs/demo.yaml"


def changed(folder: Path, **places: Any) -> Path:
    """The demo's bench with other values, given as ``optics__visibility=0.5``."""
    data = yaml.safe_load(DEMO.read_text(encoding="utf-8"))
    data["frames"] |= {"flat_rate_e_s": 1.3e6, "compress": []}
    for place, value in places.items():
        *path, key = place.split("__")
        section: Any = data
        for step in path:
            section = section[int(step)] if isinstance(section, list) else section[step]
        section[key] = value
    file = folder / "bench.yaml"
    file.write_text(yaml.safe_dump(data), encoding="utf-8")
    return file


@pytest.mark.long
def test_a_simulated_run_reaches_what_was_promised(tmp_path: Path) -> None:
    """`crb_median_px` of the fit, and the real scatter of the fit about the truth."""
    bench = ROOT / "tests/bench.yaml"
    promised = budget.run(bench, Config())
    run = tmp_path / "run"
    runtime = Runtime()
    simulate.run(bench, tmp_path / "acq", simulate.Config(), runtime)
    ingest.run(tmp_path / "acq", run, ingest.Config(), runtime)
    reduce.run(run, reduce.Config(), runtime)
    fit.run(run, fit.Config(), runtime)
    sets = json.loads((run / "products" / "fit.json").read_text())["sets"]
    for name, facts in sets.items():
        expected = promised["sets"][name]
        assert facts["frames"] == expected["planned"]["frames"]
        # 97 random phases are not quite uniform: a percent or two from pixel to pixel.
        assert facts["crb_median_px"] == pytest.approx(expected["planned"]["median_px"], rel=0.03)
        assert facts["sigma_median_px"] == pytest.approx(expected["planned"]["median_px"], rel=0.03)
        assert facts["interfringe_px"] == pytest.approx(expected["interfringe_px"], rel=1e-4)


def test_the_papers_case() -> None:
    """5e-5 px at 5 px and 50 ke-: 11 700 frames at the bound; 12 000 were measured to reach it."""
    found = budget.run(ROOT / "configs/precision.yaml", Config())
    assert found["precision_px"] == 5e-5
    wanted = found["sets"]["vertical"]["wanted"]
    assert wanted["frames"] == pytest.approx(11_700, rel=0.01)
    assert wanted["hours"] == pytest.approx(wanted["frames"] * 0.14 / 3600)
    assert wanted["bytes"] == wanted["frames"] * 128 * 128 * 2
    assert found["joined"]["components"]["delta_fringe"]["wanted"]["frames"] == wanted["frames"]


def test_precision_and_frames_are_two_sides() -> None:
    one = budget.run(DEMO, Config(precision_px=2e-4))
    n = one["sets"]["vertical"]["wanted"]["frames"]
    other = budget.run(DEMO, Config(frames=n))
    assert other["precision_px"] is None
    assert other["sets"]["vertical"]["wanted"] is None
    given = other["sets"]["vertical"]["given"]
    assert given["median_px"] == pytest.approx(2e-4, rel=1e-3)
    assert given["worst_px"] > given["median_px"]
    both = one["joined"]
    assert both["wanted"]["frames"] == max(
        c["wanted"]["frames"] for c in both["components"].values()
    )
    # Two crossed sets: twice the frames of one, and each axis reaches what its set does alone.
    assert both["wanted"]["frames"] == pytest.approx(2 * n, rel=0.02)
    planned = one["joined"]["components"]["delta_x"]["planned"]
    assert planned["frames"] == 480
    assert planned["median_px"] == pytest.approx(
        one["sets"]["vertical"]["planned"]["median_px"], rel=1e-3
    )


def test_files_and_dictionary_are_the_same(tmp_path: Path) -> None:
    found = budget.run(DEMO, Config(5e-5, 300), tmp_path / "deep" / "out")
    assert json.loads((tmp_path / "deep/out/budget.json").read_text()) == found
    assert found["schema"] == "pixcal/budget/1"
    with Image.open(tmp_path / "deep/out/budget.png") as picture:
        assert min(picture.size) > 500
    assert {p.name for p in (tmp_path / "deep/out").iterdir()} == {"budget.json", "budget.png"}


def test_what_limits_is_named(tmp_path: Path) -> None:
    def limit(**places: Any) -> Any:
        found = budget.run(changed(tmp_path, **places), Config())
        return found["sets"]["vertical"]["limited_by"]

    assert limit() == "photons"
    assert limit(optics__visibility=0.3) == "visibility"
    assert limit(detector__read_noise_e=400) == "read_noise"
    # Both beams, narrow, on the middle of the window.
    aimed: dict[str, Any] = {
        "optics__pointing_a_mm": [1.5, 1.0],
        "optics__pointing_b_mm": [-4.5, 1.0],
    }
    bench = yaml.safe_load(DEMO.read_text(encoding="utf-8"))
    aimed["frames__fringes"] = bench["frames"]["fringes"][:1]
    assert limit(optics__beam_radius_mm=0.2, **aimed) == "uneven_light"
    # Beams that hardly meet: no contrast, and pixels without light still have numbers.
    assert limit(optics__beam_radius_mm=0.5) == "visibility"


def test_what_is_left_out_and_what_is_wrong(tmp_path: Path) -> None:
    found = budget.run(DEMO, Config())
    assert not found["warnings"]
    assert any("systematic" in sentence for sentence in found["left_out"])
    assert any(
        "PRNU of 1 % rms, which changes the errors of single pixels by 0.5 % rms" in s
        for s in found["left_out"]
    )
    bright = budget.run(changed(tmp_path, frames__fringes__0__peak_e=49000), Config())
    (sentence,) = bright["warnings"]
    assert sentence.startswith("vertical: the brightest fringe")
    baselines = {"frames__fringes__0__baseline_mm": [0.5, 0.0]}
    coarse = budget.run(changed(tmp_path, **baselines), Config())
    assert any("fringes across the window" in s for s in coarse["warnings"])
    fine = budget.run(changed(tmp_path, frames__fringes__0__baseline_mm=[40.0, 0.0]), Config())
    assert any("below two pixels" in s for s in fine["warnings"])


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"bench.yaml: frames.fringes: lists no fringe set; add"):
        budget.run(changed(tmp_path, frames__fringes=[]), Config())
    ramp = {"phase_law": "ramp", "phase_step_rad": float(np.pi)}
    places = {f"frames__fringes__1__{key}": value for key, value in ramp.items()}
    with pytest.raises(InputError, match="'horizontal': phase_step_rad"):
        budget.run(changed(tmp_path, **places), Config())
    with pytest.raises(InputError, match="'vertical': no light falls on the window"):
        budget.run(changed(tmp_path, optics__beam_radius_mm=0.01), Config())
    for variance in (np.inf, np.nan):
        with pytest.raises(InputError, match="no contrast"):
            frames_needed(variance, 1e-3)
    with pytest.raises(InputError, match="not found"):
        budget.run(tmp_path / "none.yaml", Config())
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"--out .*file"):
        budget.run(DEMO, Config(), tmp_path / "file")
