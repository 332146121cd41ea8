"""The stage that writes the page: what it reads, when it is up to date, and what may be missing."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pixcal.engine.run import Runtime
from pixcal.model.errors import DamagedError, InputError
from pixcal.report import page as page_module
from pixcal.report.summary import detector_headline
from pixcal.stages import report
from pixcal.storage.artefact import build
from pixcal.storage.cube import create_group, write_array
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import read_manifest, write_json

DIAGNOSIS_FORMAT = STAGES["diagnose"].format

SECTIONS = (
    "maps", "allan", "diagnosis", "levels", "temporal", "noise", "detector", "masks", "removed",
    "provenance",
)  # fmt: skip
RUNTIME = Runtime(cluster="sync")
NASTY = "<script>alert('x')</script> & \"quotes\""


def write_maps(folder: Path, **maps: Any) -> None:
    for name, values in maps.items():
        write_array(folder / name, values, dims=("y", "x"), chunks=(128, 128))


def make_run(
    run: Path,
    shape: tuple[int, int] = (67, 131),
    sets: tuple[str, ...] = ("vertical", "horizontal"),
    *,
    stages: tuple[str, ...] = ("ingest", "reduce", "sweep", "fit", "allan", "diagnose"),
    name: str = "CHIP",
    moving: bool = False,
    masked: bool = True,
    seed: int = 3,
) -> Path:
    """A run directory as the stages before the report leave it, made up."""
    rng = np.random.default_rng(seed)
    mask = np.zeros(shape, np.uint8)
    if masked:
        mask[rng.integers(0, shape[0], 9), rng.integers(0, shape[1], 9)] = 1
        mask[shape[0] // 3, :] |= 8
        mask[5, 7] |= 64
    write_ingest(run, sets, name)
    keys = {"ingest": read_manifest(run / "ingest").key}
    write_reduce(run, shape, mask, sets, keys["ingest"], rng)
    if "fit" in stages:
        keys["reduce"] = read_manifest(run / "reduce").key
        with build(run, "sweep", 5, {}, {"reduce": keys["reduce"]}) as made:
            keys["sweep"] = made.key
        write_fit(run, shape, mask, sets, keys["sweep"], moving, rng)
    if "allan" in stages and "fit" in stages:
        write_allan(run, sets)
    if "diagnose" in stages:
        write_diagnose(run)
    return run


def write_ingest(run: Path, sets: tuple[str, ...], name: str) -> None:
    fringes = [{"name": s, "files": [f"{s}/*.fits"], "baseline_mm": [6.0, 0.0]} for s in sets]
    acquisition = {
        "schema": "pixcal/acquisition/1",
        "detector": {"name": name, "pitch_um": 4.4, "gain_e_per_adu": 1.0, "read_noise_e": 16.0},
        "optics": {"wavelength_nm": 632.8, "distance_mm": 400.0},
        "frames": {"bias": ["bias/*.fits"], "dark": [], "flat": [], "fringes": fringes},
    }
    table = {
        "file": ["a.fits", "a.fits", "b.fits"],
        "plane": [0, 1, 0],
        "mjd": [60000.0, None, 60000.1],
        "exptime_s": [0.02, 0.02, 0.02],
        "temperature_c": [None, 21.0, 22.0],
        "time_s": [0.0, 4320.0, 8640.0],
        "time_source": ["header"] * 3,
    }
    with build(run, "ingest", 1, {}, {}) as made:
        write_json(made.folder / "acquisition.json", acquisition)
        write_json(made.folder / "frames.json", {"bias": table})
        made.summary = {"warnings": [f"odd file {NASTY}"]}


def write_reduce(
    run: Path, shape: tuple[int, int], mask: Any, sets: tuple[str, ...], key: str, rng: Any
) -> None:
    facts = {
        "schema": "pixcal/reduce/1",
        "gain_e_per_adu": {"declared": 1.0, "measured": 1.01, "error": 0.004, "used": 1.0},
        "read_noise_e": {"declared": 16.0, "measured": None, "error": None, "used": 16.0},
        "linearity": {
            "intercept_adu": 0.1,
            "levels": [
                {"exptime_s": t, "level_e": 1e6 * t, "deviation_percent": d}
                for t, d in ((0.01, 0.02), (0.02, -0.03), (0.06, None))
            ],
        },
        "sets": {s: {"frames": 60, "mean_e": 2e4} for s in sets},
        "quantisation": {s: {"step_e": 1.0} for s in sets},
        "warnings": ["the lamp is unsteady"],
    }
    with build(run, "reduce", 1, {}, {"ingest": key}) as made:
        write_json(made.folder / "reduce.json", facts)
        group = made.folder / "calibration.zarr"
        create_group(group)
        normal = rng.normal(size=(4, *shape)).astype(np.float32)
        write_maps(
            group,
            bias=500 + normal[0],
            dark_rate=np.zeros(shape, np.float32),
            flat=1 + 0.01 * normal[2],
            read_noise=16 + normal[3],
            mask=mask & 1,
        )


def set_facts(n: int) -> dict[str, Any]:
    angle = n * np.pi / 2
    return {
        "model": "paraxial",
        "frames": 60,
        "interfringe_px": 9.6,
        "kx": float(np.cos(angle)) * 0.65,
        "ky": float(np.sin(angle)) * 0.65,
        "sigma_median_px": 4e-4,
        "crb_median_px": 3.9e-4,
        "chi2_reduced": 1.2,
        "sigma_scale": 1.0954,
        "fringe_vector_moves": False,
        "batch_period_s": 0.14,
        "batch_note": "",
        "geometry": {"kx_sigma": 1e-6},
        "removed_modes": ["1", "x", "y", "cos(2*psi)", "d psi / d baseline_x", "odd one"],
    }


def write_fit(
    run: Path,
    shape: tuple[int, int],
    mask: Any,
    sets: tuple[str, ...],
    key: str,
    moving: bool,
    rng: Any,
) -> None:
    outputs = ["delta_x", "delta_y"] if len(sets) > 1 else ["delta_fringe"]
    facts = {name: set_facts(n) for n, name in enumerate(sets)}
    bad = mask != 0
    if np.all(bad):
        facts = {name: own | {"sigma_median_px": None} for name, own in facts.items()}

    def holes(values: Any) -> Any:
        return np.where(bad, np.nan, values).astype(np.float32)

    with build(run, "fit", 1, {"model": "auto"}, {"sweep": key}) as made:
        group = made.folder / "fit.zarr"
        create_group(group)
        for output in outputs:
            maps = {
                output: holes(4e-3 * rng.normal(size=shape)),
                f"{output}_sigma": holes(np.full(shape, 4e-4)),
            }
            write_maps(group, **maps)
        write_maps(group, mask=mask)
        for name in sets:
            create_group(group / name)
            write_maps(
                group / name,
                iota=(2e4 + rng.normal(size=shape)).astype(np.float32),
                alpha=(1.8e4 + rng.normal(size=shape)).astype(np.float32),
                chi2=(1.2 * rng.chisquare(57, shape) / 57).astype(np.float32),
                mask=mask,
            )
            frames = rng.normal(size=(5, 60))
            columns = {
                "time": 0.14 * np.arange(60),
                "B": 1 + 0.02 * frames[0],
                "A": 1 + 0.01 * frames[1],
                "phi": rng.uniform(-np.pi, np.pi, 60),
                "dkx": 1e-6 * frames[2] * moving,
                "dky": 1e-6 * frames[3] * moving,
            }
            for column, values in columns.items():
                write_array(group / name / column, values, dims=("time",))
        write_json(
            made.folder / "fit.json",
            {
                "schema": "pixcal/fit/1",
                "sets": facts,
                "outputs": outputs,
                "sets_chi2_reduced": 1.0 if len(sets) > 2 else None,
            },
        )


def write_allan(run: Path, sets: tuple[str, ...]) -> None:
    frames = [8, 16, 24, 32, 64]
    law = [1.1e-3 / float(np.sqrt(n)) for n in frames]
    entry = {
        "frames": frames,
        "seconds": [0.14 * n for n in frames],
        "adev_px": law,
        "adev_err_px": [0.02 * v for v in law],
        "adev_lo_px": [0.98 * v for v in law],
        "adev_hi_px": [1.02 * v for v in law],
        "white_expected_px": law,
        "slope": -0.5,
        "slope_err": 0.01,
        "knee_frames": 40.0,
        "n_batches": 24,
        "batch_frames": 8,
        "gaps": 0,
        "region": None,
        "warnings": ["short batches"],
    }
    with build(run, "allan", 1, {}, {"fit": read_manifest(run / "fit").key}) as made:
        write_json(
            made.folder / "allan.json",
            {"schema": "pixcal/allan/1", "sets": dict.fromkeys(sets, entry)},
        )


def write_diagnose(run: Path, verdict: str = "explained", effects: tuple[str, ...] = ()) -> None:
    """A cause that ``effects`` names, or lag; and the curve that gave it away."""
    band = {"value": [0.0, 1.0], "low": [-0.1, 0.9], "high": [0.1, 1.1]}
    curve = {
        "statistic": "contrast_by_step",
        "set": "one",
        "title": "contrast by step",
        "kind": "linear",
        "domain": "time",
        "quantity": "slope",
        "unit": "",
        "x_label": "frames before",
        "x": [1.0, 2.0],
        "measured": [2.0, 1.0],
        "nominal": band,
        "with_effects": band,
        "z": [9.0, 0.0],
        "z_after": [0.5, 0.0],
        "in_gap": True,
        "left": 0.0,
        "weight": 81.0,
        "size": 9.0,
        "significance": 9.0,
        "significance_after": -37.0,
    }
    cause = {
        "effect": "lag",
        "title": "left behind",
        "parameters": {"share": 0.002},
        "uncertainty": {"share": 1e-5},
        "units": {"share": ""},
        "strengths": ["share"],
        "meanings": {"share": "share of the charge"},
        "about": "Charge stays.",
        "gap_closed": 0.97,
        "gap_closed_interval": [0.95, 0.98],
        "gain_over_rest": 0.97,
        "p_value": 1e-30,
        "sigmas": 30.0,
        "why": NASTY,
        "given_away_by": [{"statistic": "contrast_by_step", "set": "one"}],
        "not_told_apart_from": [],
        "would_decide": [],
        "remedy": "flush the sensor",
        "on_map": {"rms_px": 0.0, "max_px": 0.0, "action": "not measured"},
    }
    facts = {
        "schema": "pixcal/diagnosis/1",
        "verdict": verdict,
        "statistics": 1,
        "candidates": [],
        "more_would_tell": ["dark frames"],
        "causes": [cause | {"effect": name} for name in effects or ("lag",)],
        "gap": {
            "total": 1.0,
            "after": 0.03,
            "interval": [0.02, 0.05],
            "where": [],
            "absolute": [],
            "domains": {"time": [1.0, 0.03]},
        },
    }
    inputs = {"reduce": read_manifest(run / "reduce").key}
    with build(
        run, "diagnose", DIAGNOSIS_FORMAT, {"effects": list(effects), "nominal": {}}, inputs
    ) as made:
        write_json(made.folder / "diagnosis.json", facts)
        write_json(made.folder / "curves.json", [curve])


def page_of(run: Path) -> str:
    report.run(run, report.Config(), RUNTIME)
    return (run / "products" / "report.html").read_text(encoding="utf-8")


def words(page: str) -> str:
    return html.unescape(re.sub(r"<[^>]*>", " ", page))


def section(page: str, name: str) -> str:
    return page.split(f'<section id="{name}">')[1].split("</section>")[0]


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of words: drawing takes most of the time."""
    monkeypatch.setattr(page_module, "png", lambda _figure: b"")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = make_run(tmp_path_factory.mktemp("whole") / "run", name=NASTY, moving=True)
    page_of(run)
    return run


@pytest.fixture(scope="module")
def page(whole: Path) -> str:
    return (whole / "products" / "report.html").read_text(encoding="utf-8")


def test_all_sections_hold_something(page: str) -> None:
    assert re.findall(r'<section id="(\w+)">', page) == list(SECTIONS)
    for name in SECTIONS:
        assert f'href="#{name}"' in page
        assert "Not measured" not in section(page, name)
        assert any(each in section(page, name) for each in ("<img", "<svg", "<table>"))


def test_the_verdict_says_what_was_reached_and_what_to_check(page: str) -> None:
    text = words(page.split('id="verdict"')[1].split("<nav")[0])
    assert "4.00 × 10⁻⁴ px" in text
    assert "1.76 nm" in text  # 4e-4 of a pitch of 4.4 um
    assert "1.026" in text  # 4e-4 over a bound of 3.9e-4
    assert "−0.500 ± 0.010" in text
    assert "The lamp is unsteady." in text
    assert "1.0954" not in text
    assert "1.095" in text  # errors were scaled
    assert "beyond 40 frames" in text
    assert "short batches" in text


def test_text_of_files_is_escaped(page: str) -> None:
    assert "<script" not in page
    assert html.escape(NASTY, quote=False).split(" &amp;")[0].replace("'", "&#39;") in page
    assert NASTY in words(page)


def test_nothing_comes_from_outside(page: str) -> None:
    links = re.findall(r"""(?:src|href|srcset|action|data)\s*=\s*["']([^"']*)""", page)
    assert links
    for link in links:
        assert link.startswith(("#", "data:image/png;base64,"))
    assert not re.search(r"url\(|@import|<link|<iframe|<script|http-equiv", page)


def test_modes_and_flags_are_in_words(page: str) -> None:
    assert "fringes of half that period" in section(page, "removed")
    assert "the separation of the fibres along x" in section(page, "removed")
    masks = words(section(page, "masks"))
    for flag in ("hot", "dead", "noisy", "saturated", "nonlinear", "no data", "bad fit"):
        assert flag in masks
    assert re.search(r"saturated\s+more than two samples.*?131 \(1\.5\s%\)", masks, re.DOTALL)


def test_numbers_and_keys_are_listed(page: str, whole: Path) -> None:
    provenance = section(page, "provenance")
    for stage in ("ingest", "reduce", "sweep", "fit", "allan", "diagnose"):
        assert read_manifest(whole / stage).key in provenance
    for key in set_facts(0):
        assert key in provenance or key in ("removed_modes", "geometry")
    assert "geometry.kx_sigma" in provenance
    assert "2023-02-25 00:00:00" in provenance  # MJD 60000
    assert "2.40 h" in provenance
    assert "21.0 to 22.0" in provenance


def test_it_is_skipped_until_an_input_changes(whole: Path) -> None:
    before = (whole / "report" / "manifest.json").stat().st_mtime_ns
    (whole / "products" / "report.html").unlink()
    manifest = report.run(whole, report.Config(), RUNTIME)
    assert (whole / "report" / "manifest.json").stat().st_mtime_ns == before
    assert (whole / "products" / "report.html").exists()
    assert manifest.inputs["allan"] == read_manifest(whole / "allan").key
    assert set(manifest.inputs) == {"ingest", "reduce", "sweep", "fit", "allan", "diagnose"}


@pytest.mark.long
def test_the_same_inputs_give_the_same_page_whatever_the_workers(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", (41, 53), ("one",))
    first = page_of(run)
    shutil.rmtree(run / "report")
    report.run(run, report.Config(), Runtime(cluster="threads", workers=2))
    assert (run / "products" / "report.html").read_text(encoding="utf-8") == first


@pytest.mark.usefixtures("without_figures")
def test_a_new_fit_makes_a_new_page_and_an_old_allan_is_pointed_out(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", (41, 53), ("one",))
    assert "earlier fit" not in words(page_of(run))
    shutil.rmtree(run / "fit")
    mask = np.zeros((41, 53), np.uint8)
    write_fit(run, (41, 53), mask, ("one",), "another sweep", False, np.random.default_rng(1))
    text = words(page_of(run))
    assert "Allan was made from an earlier fit: run 'pixcal allan' again." in text
    assert "Fit was made from an earlier sweep: run 'pixcal fit' again." in text


@pytest.mark.usefixtures("without_figures")
def test_another_diagnosis_makes_another_page(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", (23, 29), ("one",), stages=("ingest", "reduce"))
    assert "Not run: run 'pixcal diagnose RUN'" in words(section(page_of(run), "diagnosis"))
    write_diagnose(run)
    found = words(section(page_of(run), "diagnosis"))
    assert "left behind (lag) accounts for" in found
    assert "Charge stays." in found
    assert "share of the charge" in found
    assert NASTY in found
    shutil.rmtree(run / "diagnose")
    write_diagnose(run, "partly explained", ("lag", "own_effect"))
    assert "(lag) and left behind (own_effect) close" in words(page_of(run))
    shutil.rmtree(run / "reduce")
    write_reduce(run, (23, 29), np.zeros((23, 29), np.uint8), (), "k", np.random.default_rng(0))
    assert "Diagnose was made from an earlier reduce: run 'pixcal diagnose' again." in (
        words(page_of(run))
    )


@pytest.mark.usefixtures("without_figures")
def test_one_set_gives_the_fringe_axis(tmp_path: Path) -> None:
    page = page_of(make_run(tmp_path / "run", (23, 40), ("diagonal",), masked=False))
    assert "δ along the fringe axis" in section(page, "maps")
    assert "<svg" not in section(page, "masks")  # nothing is flagged: the table says it


@pytest.mark.usefixtures("without_figures")
def test_three_sets_are_compared(tmp_path: Path) -> None:
    page = page_of(make_run(tmp_path / "run", (31, 30), ("a", "b", "c")))
    assert "measure the same offsets agree" in words(page)


@pytest.mark.usefixtures("without_figures")
def test_without_allan_the_rest_is_shown(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", (23, 40), ("one",), stages=("ingest", "reduce", "fit"))
    page = page_of(run)
    assert "Not measured: there is no Allan deviation; run 'pixcal allan RUN', then" in words(page)
    assert "<img" in section(page, "maps")


@pytest.mark.parametrize("sets", [(), ("vertical",)])
def test_without_a_fit_the_detector_is_shown(tmp_path: Path, sets: tuple[str, ...]) -> None:
    page = page_of(make_run(tmp_path / "run", (37, 29), sets, stages=("ingest", "reduce")))
    of_fringes = ["maps", "levels", "temporal", "noise", "allan", "removed"]
    shown = [name for name in SECTIONS if sets or name not in of_fringes]
    assert re.findall(r'<section id="(\w+)">', page) == shown
    assert "<img" in section(page, "detector")
    for name in of_fringes[:4] if sets else ():
        assert "there is no fit; run 'pixcal fit RUN'" in words(section(page, name))


def test_a_gain_far_off_the_declared_one_is_told_at_once() -> None:
    gain = {"declared": 3.64, "measured": 2.592, "error": 0.015, "used": 3.64}
    told = "The detector: gain 2.592 ± 0.015 e⁻/ADU instead of the declared 3.640."
    assert detector_headline({"gain_e_per_adu": gain}) == told
    for near in ({"declared": 2.6}, {"error": 0.4}):
        assert "declared" not in detector_headline({"gain_e_per_adu": gain | near})


@pytest.mark.usefixtures("without_figures")
def test_a_detector_without_fringes_is_no_bench(tmp_path: Path) -> None:
    stages = ("ingest", "reduce", "diagnose")
    page = words(page_of(make_run(tmp_path / "run", (37, 29), (), stages=stages)))
    assert "CHIP: detector" in page
    assert "0.2000 ± 0.0010 %  30 σ  flush the sensor" in page
    assert "The detector: gain 1.0100 ± 0.0040 e⁻/ADU, read noise 16.00 e⁻ (declared)." in page
    for word in ("fibre", "fringe", "632.8", "offset", "bench"):
        assert word not in page.split("Origin of the results")[0], word


@pytest.mark.usefixtures("without_figures")
def test_without_calibration_maps_the_page_says_so(tmp_path: Path, reseal: Any) -> None:
    run = make_run(tmp_path / "run", (20, 20), ("one",))
    shutil.rmtree(run / "reduce" / "calibration.zarr")
    (run / "reduce" / "reduce.json").unlink()
    reseal(run / "reduce")
    assert "Not measured: the reduction left no calibration maps" in words(page_of(run))


def test_all_pixels_masked_is_no_error(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", (20, 33), ("one",))
    shutil.rmtree(run / "fit")
    mask = np.full((20, 33), 32, np.uint8)
    write_fit(run, (20, 33), mask, ("one",), "k", False, np.random.default_rng(1))
    assert "No pixel has a valid offset" in words(page_of(run))


@pytest.mark.long
def test_large_maps_are_shown_in_means_of_blocks(tmp_path: Path) -> None:
    page = page_of(make_run(tmp_path / "run", (131, 907), ("one",)))
    text = words(page)
    assert "Each point is the mean of 3 × 3 px." in text
    assert "pixel by pixel" in text
    assert len(page) < 5_000_000


def test_a_run_without_reduce_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such run directory"):
        report.run(tmp_path / "none", report.Config(), RUNTIME)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="run 'pixcal reduce"):
        report.run(tmp_path / "empty", report.Config(), RUNTIME)


def test_a_damaged_map_is_named_and_no_page_is_left(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", (20, 20), ("one",))
    chunk = run / "fit" / "fit.zarr" / "delta_fringe" / "c" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-9])
    with pytest.raises(DamagedError, match="delta_fringe"):
        page_of(run)
    assert not (run / "report").exists()
    assert not (run / "products" / "report.html").exists()


def browse(page: Path, folder: Path) -> tuple[Any, list[str]]:
    """Picture (y, x, rgb) of a page in a browser that reaches nobody, and what the page asked."""
    folder.mkdir()
    shot, log = folder / "page.png", folder / "net.json"
    subprocess.run(
        [
            "chromium",
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--hide-scrollbars",
            "--host-resolver-rules=MAP * ~NOTFOUND",
            f"--user-data-dir={folder / 'profile'}",
            f"--screenshot={shot}",
            f"--log-net-log={log}",
            "--window-size=1200,3000",
            page.as_uri(),
        ],
        check=True,
        capture_output=True,
        timeout=120,
    )
    asked = [event.get("params", {}) for event in json.loads(log.read_text())["events"]]
    # A page from a file has the origin "null"; the browser's own services have none.
    urls = [found["url"] for found in asked if found.get("initiator") == "null"]
    return np.asarray(Image.open(shot).convert("RGB")).astype(int), urls


@pytest.mark.long
@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_a_browser_shows_it_and_asks_for_nothing(whole: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.html"
    other.write_text('<img src="http://127.0.0.1:9/x.png">')
    blank, asked = browse(other, tmp_path / "other")
    assert asked == ["http://127.0.0.1:9/x.png"]
    assert not shows_a_report(blank)
    picture, asked = browse(whole / "products" / "report.html", tmp_path / "report")
    assert asked == []
    assert shows_a_report(picture)


def shows_a_report(picture: Any) -> bool:
    """Whether there are many colours, rows are filled all the way down, and maps are coloured."""
    filled = (np.abs(picture - picture[0, 0]).sum(axis=2) > 30).any(axis=1)
    coloured = np.ptp(picture, axis=2) > 60
    colours = len(np.unique(picture.reshape(-1, 3), axis=0))
    return bool(colours > 200 and filled[200:2800].mean() > 0.8 and coloured[600:].mean() > 0.01)
