"""An effect from outside pixcal: one file, through the commands, simulated and measured."""

import inspect
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

import pixcal
from pixcal.effects import effects, known_effects
from pixcal.engine.run import Runtime
from pixcal.model.errors import InputError, PixcalError
from pixcal.simulation.forward import STEPS, ForwardModel
from pixcal.simulation.own_effect import effect_of_file
from pixcal.stages.evidence import load_evidence
from pixcal_cli.main import cli

ROOT = Path(__file__).parents[2]
GLOW = ROOT / "docs" / "examples" / "glow.py"
BENCH = """
schema: pixcal/bench/1
seed: 5
detector: {shape: [61, 67], pitch_um: 4.4, gain_e_per_adu: 0.5, read_noise_e: 8.0, dark_e_s: 10.0}
optics: {wavelength_nm: 632.8, distance_mm: 400.0, beam_radius_mm: 35.0}
frames:
  exptime_s: 0.02
  period_s: 0.14
  per_file: 100
  bias: 30
  darks: [{exptime_s: 2.0, count: 30}]
effects:
  glow: {rate: 120.0}
"""
SYNC = Runtime(cluster="sync")


@pytest.fixture(scope="module")
def acquisition(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulated by the command, as a user does."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "bench.yaml").write_text(BENCH)
    arguments = [str(folder / "bench.yaml"), "--out", str(folder / "acq"), "--own", str(GLOW)]
    found = CliRunner().invoke(cli, ["simulate", *arguments, "--quiet", "--cluster", "sync"])
    assert found.exit_code == 0, found.output
    return folder / "acq"


def test_the_frames_have_it(acquisition: Path) -> None:
    (dark,) = acquisition.glob("dark/*.fits")
    frames = fits.getdata(dark).astype(float)
    y, x = np.mgrid[:61, :67]
    light = (frames.mean(axis=0) - 500) * 0.5
    expected = 2.0 * (10.0 + 120.0 * np.exp(-np.hypot(y, x) / 15.0))
    # Shot and read noise of thirty frames.
    error = np.sqrt((expected + 64) / 30)
    assert np.std((light - expected) / error) == pytest.approx(1, abs=0.05)


def test_it_is_measured_with_its_error(acquisition: Path, tmp_path: Path) -> None:
    cls = effect_of_file(GLOW)
    run = pixcal.ingest(acquisition, tmp_path / "run", runtime=SYNC)
    pixcal.reduce(run, runtime=SYNC)
    found = cls.estimate(load_evidence(run.path))
    assert found is not None
    assert found.effect.name == "glow"
    assert abs(found.effect.rate - 120.0) < 3 * found.errors["rate"]  # type: ignore[attr-defined]
    assert found.significance > 10


def test_other_workers_make_the_same_frames(acquisition: Path, tmp_path: Path) -> None:
    """Processes of their own, which have never seen the file."""
    (tmp_path / "bench.yaml").write_text(BENCH)
    runtime = Runtime(cluster="processes", workers=2)
    again = pixcal.simulate(tmp_path / "bench.yaml", tmp_path / "acq", own=[GLOW], runtime=runtime)
    for file in sorted(acquisition.rglob("*.fits")):
        assert (again / file.relative_to(acquisition)).read_bytes() == file.read_bytes()


def test_another_file_is_another_acquisition(acquisition: Path, tmp_path: Path) -> None:
    """The truth keeps the file; one that was changed is simulated anew."""
    bench, truth = acquisition.parent / "bench.yaml", acquisition.with_name("acq-truth")
    assert (truth / "glow.py").read_bytes() == GLOW.read_bytes()
    before = (acquisition / "manifest.json").read_text()
    pixcal.simulate(bench, acquisition, own=[GLOW], runtime=SYNC)
    assert (acquisition / "manifest.json").read_text() == before
    changed = tmp_path / "glow.py"
    changed.write_text(GLOW.read_text().replace("15.0", "16.0"))
    pixcal.simulate(bench, tmp_path / "acq", own=[changed], runtime=SYNC)
    assert (tmp_path / "acq" / "manifest.json").read_text() != before


def test_without_its_file_the_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bench.yaml").write_text(BENCH)
    with pytest.raises(InputError, match="effects: unknown effect 'glow'; known are"):
        pixcal.simulate(tmp_path / "bench.yaml", tmp_path / "acq", runtime=SYNC)


def test_a_name_that_is_taken_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(GLOW.read_text().replace('"glow"', '"ipc"'))
    with pytest.raises(InputError, match=r"mine.py: there is an effect 'ipc' already; rename"):
        known_effects([file])
    with pytest.raises(InputError, match="'glow' already"):
        known_effects([GLOW, GLOW])
    assert known_effects() == effects()


@pytest.mark.parametrize("written", ["", "domains = ()", 'domains = ("spatial",)'])
def test_where_it_shows_must_be_said(tmp_path: Path, written: str) -> None:
    file = tmp_path / "mine.py"
    text = GLOW.read_text()
    given = 'domains, strengths = ("space", "intensity"), ("rate",)'
    assert given in text
    file.write_text(text.replace(given, f'strengths = ("rate",)\n    {written}'))
    with pytest.raises(InputError, match="domains is missing or not a tuple; choose from space"):
        known_effects([file])


def test_it_cannot_act_before_the_light_of_the_bench(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(GLOW.read_text() + "\n    order = -2\n")
    with pytest.raises(InputError, match=r"mine.py: .*order is below zero"):
        known_effects([file])


@pytest.mark.parametrize(
    ("starts", "reason"),
    [
        ("[1]", "TypeError: does not return a list of LightStart for Glow"),
        ("[LightStart(cls(), ('rat',))]", "ValueError: free: rat is not a parameter"),
        ("[cls.nothing]", "AttributeError: .*nothing"),
    ],
)
def test_starts_that_cannot_be_used_name_the_file(tmp_path: Path, starts: str, reason: str) -> None:
    file = tmp_path / "mine.py"
    text = GLOW.read_text().replace("import Effect", "import Effect, LightStart")
    file.write_text(
        text + f"\n    @classmethod\n    def starts(cls, evidence):\n        return {starts}\n"
    )
    with pytest.raises(PixcalError, match=rf"mine.py: starts: {reason}.*; fix the file"):
        known_effects([file])["glow"].starts(None)  # type: ignore[arg-type]


@pytest.mark.parametrize("step", STEPS)
def test_a_step_that_fails_names_the_file(tmp_path: Path, step: str) -> None:
    """Of every step of the forward model, that of the pixels included."""
    (tmp_path / "mine.py").write_text(
        f"{GLOW.read_text()}\n    def {step}(self, *given):\n        return 1 / 0\n"
    )
    effect = effect_of_file(tmp_path / "mine.py")
    with pytest.raises(InputError, match=rf"mine.py: {step}: ZeroDivisionError.*; fix the file"):
        getattr(effect(), step)(np.zeros(3))


def test_every_step_of_the_forward_model_is_checked() -> None:
    """Those that give back what they are given, changed."""
    steps = set()
    for name, method in inspect.getmembers(ForwardModel, inspect.isfunction):
        signature = inspect.signature(method)
        _, *given = signature.parameters.values()
        if name[0] != "_" and given and given[0].annotation is signature.return_annotation:
            steps.add(name)
    assert steps == set(STEPS)
