"""The shell command: help, options, exit codes, one line for every error, results on stdout."""

import contextlib
import dataclasses
import errno
import io
import json
import os
import shlex
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from itertools import product
from pathlib import Path
from typing import Any, get_args, get_type_hints

import click
import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given
from hypothesis import strategies as st

from pixcal import __version__
from pixcal.engine.run import Runtime
from pixcal.model.errors import DamagedError, InputError
from pixcal.report import page as report_page
from pixcal.stages import fit, reduce
from pixcal_cli import diagnosis_results, main, results
from pixcal_cli.click_options import memory_size, region
from pixcal_cli.main import cli, explain, invoke

PIXCAL = Path(sys.executable).with_name("pixcal")
STAGES = ["ingest", "reduce", "fit", "allan", "diagnose", "report"]
SHOWN = {"diagnose": "diagnosis"}
"""Stages whose results have another name."""
COMMANDS = [
    "run",
    *STAGES[:4],
    "crests",
    "diagnose",
    "astrometry",
    "centroids",
    "wcs",
    "electrons",
    "report",
    "compare",
    "simulate",
    "budget",
    "blind",
]


def shell(*args: str, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [PIXCAL, *args], capture_output=True, text=True, timeout=60, check=False, **options
    )


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, tuple[Any, ...]]]:
    """The stages' bodies replaced by ones that only note their arguments."""
    made: list[tuple[str, tuple[Any, ...]]] = []
    for name in [*STAGES, "simulate"]:

        def note(*args: Any, name: str = name) -> None:
            made.append((name, args))

        monkeypatch.setattr(f"pixcal.stages.{name}.run", note)
        shown = diagnosis_results if name == "diagnose" else results
        monkeypatch.setattr(shown, f"show_{SHOWN.get(name, name)}", lambda run: None)
    monkeypatch.setattr(results, "show_run", lambda run, fitted, diagnosed: None)
    return made


def replace_body(monkeypatch: pytest.MonkeyPatch, name: str, error: BaseException) -> None:
    def body(*_args: Any) -> None:
        raise error

    monkeypatch.setattr(f"pixcal.stages.{name}.run", body)


def examples_of(command: click.Command) -> list[str]:
    return [line.strip() for line in (command.epilog or "").splitlines() if "pixcal " in line]


def test_the_commands_are_listed_in_the_order_of_the_data() -> None:
    assert list(cli.commands) == COMMANDS
    shown = shell("--help")
    assert shown.returncode == 0
    assert shown.stdout == shell().stdout, "without a command, the help"
    listed = shown.stdout.partition("Commands:\n")[2].partition("\n\n")[0]
    assert [line.split()[0] for line in listed.splitlines()] == COMMANDS


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke([name, "--help"]) == 0
    text = capsys.readouterr().out
    for example in examples_of(cli.commands[name]):
        assert f"\n    {example}\n" in text


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_the_examples_are_understood(name: str) -> None:
    command = cli.commands[name] if name else cli
    lines = examples_of(command)
    assert lines
    for line in lines:
        program, chosen, *args = shlex.split(line)
        assert program == "pixcal"
        assert chosen == name or not name
        cli.commands[chosen].make_context(chosen, args)


def test_the_example_that_is_broken_would_be_found() -> None:
    with pytest.raises(click.UsageError):
        cli.commands["fit"].make_context("fit", ["demo", "--modle", "paraxial"])


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["--version"]) == 0
    assert capsys.readouterr().out == f"pixcal, version {__version__}\n"


def test_the_shell_completes_commands_and_options() -> None:
    script = shell(env=os.environ | {"_PIXCAL_COMPLETE": "bash_source"})
    assert "complete -o nosort -F _pixcal_completion pixcal" in script.stdout
    for words, expected in {"pixcal al": "allan", "pixcal fit --mo": "--model"}.items():
        env = {"_PIXCAL_COMPLETE": "bash_complete", "COMP_WORDS": words}
        env["COMP_CWORD"] = str(len(words.split()) - 1)
        assert f"plain,{expected}\n" in shell(env=os.environ | env).stdout


def loaded_with(module: str) -> set[str]:
    code = f"import sys, {module}; print(*sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(out.stdout.split())


def test_the_list_of_commands_cuts_no_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["--help"]) == 0
    assert "..." not in capsys.readouterr().out.split("Commands:")[1]


def test_help_loads_no_heavy_library() -> None:
    loaded = loaded_with("pixcal_cli.main")
    assert "pixcal_cli.main" in loaded
    assert not loaded & {"numpy", "dask", "zarr", "numba", "astropy", "scipy", "matplotlib"}


@pytest.mark.long
def test_a_run_loads_no_library_that_few_runs_need() -> None:
    loaded = loaded_with("pixcal.stages.whole_run")
    assert "pixcal.stages.whole_run" in loaded
    assert not loaded & {"scipy.stats", "scipy.signal", "distributed", "pandas"}


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("fi", ["'fi'", "pixcal --help"]),
        ("--foo", ["--foo"]),
        ("fit", ["RUN", "pixcal fit --help"]),
        ("fit RUN --modle auto", ["--modle", "--model"]),
        ("fit RUN --model round", ["--model", "'round'", "hyperbolic"]),
        ("fit RUN other", ["other"]),
        ("ingest ACQ", ["--out"]),
        ("fit RUN --memory 2Q", ["--memory", "'2Q'", "2GiB"]),
        ("fit RUN --memory 12", ["--memory", "'12'", "1 MiB"]),
        ("fit RUN --workers -1", ["--workers", "-1"]),
        ("fit RUN --workers two", ["--workers", "'two'"]),
        ("fit RUN --cluster slurm", ["--cluster", "slurm", "threads"]),
        ("allan RUN --region 1:2", ["--region", "'1:2'", "y0:y1,x0:x1"]),
        ("allan RUN --region 9:9,0:4", ["--region", "'9:9,0:4'", "empty"]),
        *((f"{stage} nowhere", ["nowhere", "pixcal ingest"]) for stage in STAGES[1:]),
        ("ingest nowhere --out r", ["nowhere", "acquisition.yaml"]),
        ("run nowhere --out r", ["nowhere", "acquisition.yaml"]),
        ("simulate nowhere.yaml --out a", ["nowhere.yaml"]),
    ],
)
def test_an_error_is_one_line_that_names_it(
    line: str,
    names: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert invoke(line.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("pixcal: ")
    assert err.count("\n") == 1
    assert err.endswith("\n")
    for name in names:
        assert name in err


@pytest.mark.parametrize(
    ("error", "code", "names"),
    [
        (InputError("a.yaml: detector.pitch_um: missing"), 2, ["a.yaml: detector.pitch_um"]),
        (DamagedError("c/0/0", "chunk missing"), 2, ["c/0/0: chunk missing"]),
        (KeyboardInterrupt(), 1, ["interrupted", "again to resume"]),
        (OSError(errno.ENOSPC, "No space left", "/x/y"), 1, ["/x/y", "disk full", "resume"]),
        (OSError(errno.EDQUOT, "Quota exceeded"), 1, ["disk full", "resume"]),
        (PermissionError(errno.EACCES, "denied", "/x/y"), 2, ["/x/y", "no permission"]),
        (OSError(errno.EIO, "Input/output error", "/x/y"), 1, ["/x/y", "Input/output error"]),
        (OSError("odd"), 1, ["internal error", "odd"]),
        (MemoryError(), 1, ["out of memory", "--workers"]),
        (RuntimeError("two\nlines"), 1, ["internal error: RuntimeError: two lines", "DEBUG"]),
    ],
)
def test_an_error_inside_a_stage_is_one_line(
    error: BaseException,
    code: int,
    names: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv("PIXCAL_DEBUG", raising=False)
    replace_body(monkeypatch, "reduce", error)
    assert invoke(["reduce", "RUN"]) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.strip().splitlines()) == 1
    for name in names:
        assert name in err


@pytest.mark.parametrize("said_of_it", ["Error calling __set_name__", "release unlocked lock"])
def test_an_interruption_is_one_whatever_a_library_makes_of_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], said_of_it: str
) -> None:
    """As Python 3.11 does with one that comes while a class is made, or a lock is taken."""
    error = RuntimeError(said_of_it)
    replace_body(monkeypatch, "reduce", error)
    for asked, said in ((False, "internal error"), (True, "interrupted; ")):
        if asked:
            main._interrupted.set()
        try:
            assert invoke(["reduce", "RUN"]) == 1
        finally:
            main._interrupted.clear()
        assert said in capsys.readouterr().err


@pytest.mark.parametrize("where", ["in the command", "as Python ends"])
def test_a_lock_that_is_never_released_does_not_outlast_ctrl_c(where: str) -> None:
    """A thread that waits for ever, and for which the command or the interpreter waits."""
    code = f"""
import os, signal, threading
from pixcal_cli import main, steps
main.PATIENCE_S = 1
def wait(**_):
    thread = threading.Thread(target=threading.Event().wait)
    thread.start()
    try:
        os.kill(os.getpid(), signal.SIGINT)
    finally:
        {where == "in the command"} and thread.join()
steps.allan.callback = wait
signal.signal(signal.SIGINT, signal.default_int_handler)
main.main()
"""
    line = [sys.executable, "-c", code, "allan", "RUN"]
    ended = subprocess.run(line, capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr == "pixcal: interrupted; run the same command again to resume\n"


@pytest.mark.parametrize("out", ["file", "file/run"])
@pytest.mark.parametrize("command", ["run", "ingest"])
def test_a_run_that_is_a_file_is_named(
    command: str,
    out: str,
    make_bench: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    make_bench(shape=(8, 8), frames=2).write(tmp_path / "acq")
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("kept")
    assert invoke([command, "acq", "--out", out]) == 2
    assert capsys.readouterr().err == f"pixcal: {out}: not a directory; choose another RUN\n"
    assert Path("file").read_text() == "kept"


def test_the_traceback_is_shown_on_demand(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PIXCAL_DEBUG", "1")
    replace_body(monkeypatch, "reduce", ZeroDivisionError("x"))
    assert invoke(["reduce", "RUN"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_a_reader_that_went_away_is_no_complaint() -> None:
    read, write = os.pipe()
    os.close(read)
    found = subprocess.run(
        [PIXCAL, "--help"], stdout=write, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(write)
    assert (found.returncode, found.stderr) == (1, "")
    assert explain(BrokenPipeError()) == (1, "")


def test_a_full_disk_under_stdout_is_one_line() -> None:
    with Path("/dev/full").open("w") as full:
        found = subprocess.run(
            [PIXCAL, "--help"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert found.returncode == 1
    assert found.stderr.count("\n") == 1
    assert "disk full" in found.stderr


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("512MiB", 512 << 20),
        ("2GiB", 2 << 30),
        ("2G", 2 << 30),
        ("2g", 2 << 30),
        ("2 GiB", 2 << 30),
        ("2GB", 2 * 10**9),
        ("1.5GiB", 3 << 29),
        ("1TiB", 1 << 40),
        ("1048576", 1 << 20),
        ("1048576B", 1 << 20),
        ("4096K", 4 << 20),
    ],
)
def test_sizes(text: str, size: int) -> None:
    assert memory_size(text) == size


@given(st.integers(1 << 20, 1 << 45))
def test_plain_bytes_are_kept(size: int) -> None:
    assert memory_size(str(size)) == size


@pytest.mark.parametrize("text", ["", "GiB", "-1GiB", "1e9", "2iB", "2GiBB", "0", "nan", "２GiB x"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(click.BadParameter):
        memory_size(text)


def test_regions() -> None:
    assert region("0:64,128:256") == (0, 64, 128, 256)
    for text in ("", "0:64", "0:64,3:2", "a:b,c:d", "-1:3,0:4", "0:64,0:64,0:64"):
        with pytest.raises(click.BadParameter):
            region(text)


@pytest.mark.usefixtures("calls")
@pytest.mark.parametrize("name", [*STAGES, "simulate"])
def test_a_success_prints_nothing_on_stderr(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert invoke(examples_of(cli.commands[name])[0].split()[1:]) == 0
    out, err = capsys.readouterr()
    assert out.startswith(f"{name}: ")
    assert err == ""


ACQUISITION: dict[str, Any] = {
    "schema": "pixcal/acquisition/1",
    "detector": {"pitch_um": 4.4, "gain_e_per_adu": 1.0, "read_noise_e": 16.0},
    "optics": {"wavelength_nm": 632.8, "distance_mm": 400.0},
    "frames": {"bias": ["bias/*.fits"]},
}


@pytest.mark.parametrize("fringes", [True, False])
def test_run_does_all_steps_that_the_acquisition_allows(
    fringes: bool, calls: list[tuple[str, tuple[Any, ...]]], tmp_path: Path
) -> None:
    vertical = {"name": "vertical", "files": ["v/*.fits"], "baseline_mm": [6.0, 0.0]}
    frames = ACQUISITION["frames"] | {"fringes": [vertical] if fringes else []}
    (tmp_path / "acquisition.yaml").write_text(json.dumps(ACQUISITION | {"frames": frames}))
    assert invoke(["run", str(tmp_path), "--out", "RUN", "--model", "paraxial"]) == 0
    steps = STAGES if fringes else ["ingest", "reduce", "diagnose", "report"]
    assert [name for name, _ in calls] == steps
    calls.clear()
    assert invoke(["run", str(tmp_path), "--out", "RUN", "--no-diagnose"]) == 0
    assert [name for name, _ in calls] == [name for name in steps if name != "diagnose"]
    calls.clear()
    assert invoke(["run", str(tmp_path), "--out", "RUN", "--model", "paraxial"]) == 0
    if fringes:
        assert calls[2][1][1].model == "paraxial"


def test_options_reach_the_stage(calls: list[tuple[str, tuple[Any, ...]]]) -> None:
    line = "fit RUN --model hyperbolic --quiet --cluster sync --workers 3 --memory 1GiB"
    assert invoke(line.split()) == 0
    ((name, (run, config, runtime)),) = calls
    assert name == "fit"
    assert run == Path("RUN")
    assert config.model == "hyperbolic"
    assert runtime == Runtime(cluster="sync", workers=3, memory=1 << 30, quiet=True)


def test_progress_is_shown_unless_quiet(calls: list[tuple[str, tuple[Any, ...]]]) -> None:
    assert invoke(["reduce", "RUN"]) == 0
    assert calls[0][1][-1] == Runtime(quiet=False)


def test_new_and_up_to_date_are_told_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = tmp_path / "fit/manifest.json"
    manifest.parent.mkdir()
    for time, expected in enumerate(("written", "up to date", "written")):
        with results.announce("fit", tmp_path / "fit"):
            if expected == "written":
                manifest.write_text(expected)
                os.utime(manifest, ns=(time, time))
        assert capsys.readouterr().out == f"fit: {tmp_path / 'fit'} ({expected})\n"


def cells(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines()]


def test_the_rows_of_a_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = {
        "model": "paraxial",
        "frames": 300,
        "interfringe_px": 9.58712,
        "sigma_median_px": 5.13e-4,
        "crb_median_px": 5.0e-4,
        "chi2_reduced": 1.0023,
    }
    (tmp_path / "fit").mkdir()
    (tmp_path / "fit/fit.json").write_text(
        json.dumps({"sets": {"vertical": found, "b": found | {"chi2_reduced": None}}})
    )
    results.show_fit(tmp_path)
    rows = cells(capsys.readouterr().out)
    assert " ".join(rows[1]) == "vertical paraxial 300 9.5871 0.000513 0.0005 1.03 1.002"
    assert rows[2][-1] == "-"


def test_the_rows_of_an_allan_deviation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = {
        "frames": [8, 16],
        "adev_px": [2e-3, 1.4142e-3],
        "adev_err_px": [1e-5, 3e-5],
        "white_expected_px": [2e-3, 1.4e-3],
        "slope": -0.4987,
        "slope_err": 0.0123,
        "knee_frames": None,
        "warnings": [],
        "regions": {},
    }
    short = found | {"adev_px": [], "warnings": ["too short"], "regions": {"0:8,0:9": found}}
    (tmp_path / "allan").mkdir()
    (tmp_path / "allan/allan.json").write_text(
        json.dumps({"sets": {"a": found, "b": found | {"knee_frames": 16}, "c": short}})
    )
    results.show_allan(tmp_path)
    _, a, b, c, of_region, note = (" ".join(row) for row in cells(capsys.readouterr().out))
    assert a == "a all -0.499 ± 0.012 none 16 0.001414 ± 0.000030 0.0014"
    assert b == a.replace("a all", "b all").replace("none", "16 frames")
    assert c == "c all - - - - -"
    assert of_region == a.replace("a all", "c 0:8,0:9")
    assert note == "note: c: too short"


def test_a_diagnosis_tells_how_large_a_difference_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    large = {
        "domain": "noise",
        "title": "tone",
        "place": "all frames",
        "measured": 0.5,
        "unit": "σ",
        "simulated": 0.1,
        "after": 0.4,
        "size": -1506.4,
        "significance": 7.34,
    }
    where = [large, large | {"size": 8.34}, large | {"significance": 0.0}]
    gap = {"after": 1.0, "interval": [0.9, 1.0], "where": where}
    found = {"verdict": "unexplained", "causes": [], "gap": gap, "more_would_tell": []}
    (tmp_path / "diagnose").mkdir()
    (tmp_path / "diagnose/diagnosis.json").write_text(json.dumps(found))
    diagnosis_results.show_diagnosis(tmp_path)
    *_, header, first, second = cells(capsys.readouterr().out)
    assert header[-3:] == ["difference/scatter", "significance", "σ"]
    assert first[-2:] == ["1506", "7.3"]
    assert second[-2:] == ["8.3", "7.3"]


def test_a_diagnosis_names_frames_that_would_decide(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cause: dict[str, Any] = {
        "effect": "lag",
        "gap_closed": 0.9,
        "gap_closed_interval": [0.8, 0.95],
        "gain_over_rest": 0.9,
        "p_value": 1e-12,
        "not_told_apart_from": ["ipc", "glow"],
        "would_decide": ["dark frames", "a second baseline along x and y"],
        "law": "charge of the last frame",
        "gap_closed_by_law": 0.7,
    }
    sure = cause | {
        "law": "white",
        "gap_closed_by_law": 0.9,
        "effect": "row_noise",
        "p_value": 1.1e-12,
        "not_told_apart_from": [],
        "would_decide": [],
    }
    stays = {"title": "tone", "place": "all frames", "stays": True, "significance": 0.0}
    found = {
        "verdict": "partly explained",
        "causes": [cause, sure],
        "gap": {"after": 0.5, "interval": [0.4, 0.6], "where": [stays]},
        "more_would_tell": ["flat frames", "a fringe set along another axis"],
    }
    (tmp_path / "diagnose").mkdir()
    file = tmp_path / "diagnose/diagnosis.json"
    file.write_text(json.dumps(found))
    diagnosis_results.show_diagnosis(tmp_path)
    verdict, still, gap, _, lag, row_noise, *frames = (
        " ".join(row) for row in cells(capsys.readouterr().out)
    )
    assert verdict == "partly explained; residual gap: 50 % (90 % interval 40 to 60 %)"
    assert still == "still different with all causes: tone, all frames"
    assert gap.startswith("gap: sum of all significant differences")
    assert lag == "lag 90.0 % (80.0 to 95.0 %) 90.0 % < 10⁻¹² ipc, glow"
    assert row_noise == "row_noise 90.0 % (80.0 to 95.0 %) 90.0 % 1.1 × 10⁻¹² -"
    assert frames == [
        "lag: charge of the last frame; the law alone closes 70.0 %",
        "recommended frames to distinguish lag from ipc or glow: "
        "dark frames; a second baseline along x and y",
        "row_noise: white",
        "recommended frames: flat frames; a fringe set along another axis",
    ]
    file.write_text(json.dumps(found | {"causes": [sure], "more_would_tell": []}))
    diagnosis_results.show_diagnosis(tmp_path)
    assert "recommended" not in capsys.readouterr().out


@pytest.mark.parametrize("names", ["", " , ", ","])
def test_candidates_without_a_name_are_refused(
    names: str, calls: list[tuple[str, tuple[Any, ...]]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert invoke(["diagnose", "RUN", "--effects", names]) == 2
    assert not calls
    assert f"--effects {names!r}: names no effect; give names" in capsys.readouterr().err
    assert invoke(["diagnose", "RUN"]) == 0
    assert invoke(["diagnose", "RUN", "--effects", "lag, ipc,-row_noise,"]) == 0
    every, some = (args[1] for _, args in calls)
    assert (every.only, every.without) == ((), ())
    assert (some.only, some.without) == (("lag", "ipc"), ("row_noise",))


def test_a_damaged_result_is_named(tmp_path: Path) -> None:
    (tmp_path / "fit").mkdir()
    (tmp_path / "fit/fit.json").write_text("{")
    with pytest.raises(DamagedError, match=r"fit\.json"):
        results.show_fit(tmp_path)


def typed(folder: Path, line: str) -> tuple[str, str]:
    """What a successful command, typed in a folder, prints on stdout and on stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.chdir(folder), redirect_stdout(out), redirect_stderr(err):
        code = invoke(line.split())
    assert code == 0, err.getvalue()
    return out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def bench_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated acquisition, ACQ, and RUN made from it by one command."""
    folder = tmp_path_factory.mktemp("bench")
    bench = Path(__file__).parents[1] / "bench.yaml"
    for line in (f"simulate {bench} --out ACQ --quiet", "run ACQ --out RUN --quiet"):
        out, err = typed(folder, line)
        assert err == ""
        (folder / f"{line.split()[0]}.out").write_text(out)
    return folder


@pytest.mark.long
def test_run_prints_where_and_what(bench_run: Path) -> None:
    lines = (bench_run / "run.out").read_text().splitlines()
    made = [*STAGES[:5], "corrected", STAGES[5]]
    assert lines[: len(made)] == [f"{stage}: RUN/{stage} (written)" for stage in made]
    for name in ("vertical", "horizontal"):
        assert len([line for line in lines if line.split()[:1] == [name]]) >= 2
    for name in ("delta_x.fits", "delta_y.fits", "fit.json", "allan.json", "report.html"):
        assert f"  RUN/products/{name}" in lines


@pytest.mark.long
def test_what_is_up_to_date_is_left_alone(bench_run: Path) -> None:
    def products() -> dict[str, bytes]:
        return {p.name: p.read_bytes() for p in (bench_run / "RUN/products").iterdir()}

    before = products()
    again, _ = typed(bench_run, "run ACQ --out RUN")
    first = (bench_run / "run.out").read_text()
    assert again == first.replace("(written)", "(up to date)")
    assert products() == before


@pytest.mark.long
@pytest.mark.parametrize(
    ("stages", "files"),
    [(STAGES[:4], ("fit.json", "allan.json")), (STAGES, ("fit.json", "diagnosis.json"))],
    ids=["to allan", "all"],
)
def test_the_steps_one_by_one_give_the_same(
    bench_run: Path, monkeypatch: pytest.MonkeyPatch, stages: list[str], files: tuple[str, ...]
) -> None:
    """Also with another number of workers and other memory; progress goes to stderr only."""
    monkeypatch.setattr(report_page, "png", lambda figure: b"")
    steps = f"STEPS-{len(stages)}"
    for line in (f"ingest ACQ --out {steps}", *(f"{stage} {steps}" for stage in stages[1:])):
        out, err = typed(bench_run, f"{line} --cluster sync --memory 3GiB")
        assert out.startswith(f"{line.split()[0]}: {steps}/{line.split()[0]} (written)\n")
        assert "━" not in out
        assert "━" in err
    one, other = bench_run / "RUN/products", bench_run / steps / "products"
    for name in files:
        assert (one / name).read_bytes() == (other / name).read_bytes()
    for name, hdu in product(("delta_x.fits", "delta_y.fits"), (0, "SIGMA", "MASK")):
        maps = [fits.getdata(folder / name, hdu) for folder in (one, other)]
        np.testing.assert_array_equal(*maps)


@pytest.mark.parametrize(
    ("command", "name", "config"), [("fit", "model", fit.Config), ("reduce", "gain", reduce.Config)]
)
def test_the_choices_are_those_of_the_stage(command: str, name: str, config: type) -> None:
    (option,) = (p for p in cli.commands[command].params if p.name == name)
    (field,) = (f for f in dataclasses.fields(config) if f.name == name)
    assert isinstance(option.type, click.Choice)
    choices = get_args(get_type_hints(config)[name]) or field.metadata["choices"]
    assert set(option.type.choices) == set(choices)
    assert option.default == field.default
