"""What holds for every effect that is found, whatever it is."""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from all_frames import frames_of
from numpy.typing import NDArray

import pixcal.effects
from blind_examination.draw import draw_examination
from doc_pages import effect_table
from pixcal.effects import effects, known_effects, parse_effects
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.model.config import meanings, parse, to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, FringeMaps, Stage
from pixcal.simulation.exposure import Camera, states_of
from pixcal.simulation.own_effect import effect_of_file
from pixcal.simulation.recording import Recording, recordings
from pixcal.stages.diagnose.nominal import Measured

ROOT = Path(__file__).parents[2]
GLOW = ROOT / "docs" / "examples" / "glow.py"
"""An effect from outside, as the documentation shows how to write one."""
KNOWN = known_effects([GLOW, *sorted((Path(__file__).parent / "own").glob("*.py"))])
EVERY = pytest.mark.parametrize("cls", KNOWN.values(), ids=KNOWN)
EVERY_OF_PIXCAL = pytest.mark.parametrize("cls", effects().values(), ids=effects())
EVERY_BUT_EXAMPLES = pytest.mark.parametrize(
    "cls",
    [c if n in effects() else pytest.param(c, marks=pytest.mark.long) for n, c in KNOWN.items()],
    ids=KNOWN,
)
PAGES = sorted((ROOT / "docs" / "reference" / "effects").glob("*.md"))
"""What effects are, their sources, and pictures of what they do to the offsets; optional."""
DOMAINS = {"space", "time", "intensity", "noise"}
SELDOM = {"cosmic_hits": 1e6}
"""Times the default strength at which an effect shows in a dozen small frames; 3 for others."""
SHORT = {
    "detector.shape": [71, 37],
    "frames.bias": 3,
    "frames.darks": [{"exptime_s": 0.5, "count": 2}],
    "frames.flats": [{"exptime_s": 0.01, "count": 2}],
    "frames.fringes.0.count": 5,
    "frames.fringes.1.count": 3,
}


@pytest.fixture(scope="module")
def short(make_effect_bench: Callable[..., Bench]) -> Bench:
    return make_effect_bench(SHORT)


def all_frames(bench: Bench, *on: Effect) -> dict[str, NDArray[np.uint16]]:
    return {r.stem: frames_of(bench, r, on) for r in recordings(bench)}


def strong(cls: type[Effect]) -> Effect:
    return cls().scaled(SELDOM.get(cls.name, 3.0))


def by_stem(bench: Bench) -> dict[str, Recording]:
    return {r.stem: r for r in recordings(bench)}


@EVERY
def test_it_says_what_it_is(cls: type[Effect]) -> None:
    assert KNOWN[cls.name] is cls
    assert isinstance(cls.acts_at, Stage)
    assert cls.title
    assert set(cls.domains) <= DOMAINS
    assert cls.domains
    assert all(len(source) > 10 for source in cls.sources)
    assert cls.sources
    names = {f.name for f in dataclasses.fields(cls)}
    assert set(cls.strengths) <= names
    assert cls.strengths
    words = meanings(cls)
    for field in dataclasses.fields(cls):
        assert words[field.name] or dataclasses.is_dataclass(field.type), field.name


def test_which_of_one_stage_acts_first_is_said_and_not_left_to_names() -> None:
    ordered = [cls for cls in effects().values() if "order" in vars(cls)]
    assert len({(cls.acts_at, cls.order) for cls in ordered}) == len(ordered)
    # Those without an order come last of their stage.
    own = effect_of_file(GLOW)()
    assert own.sort_key > max(cls().sort_key for cls in ordered if cls.acts_at == own.acts_at)


def test_what_was_measured_of_a_bench_is_set_before_any_effect_acts() -> None:
    first = Measured.acts_at, Measured.order
    assert first < min((cls.acts_at, cls.order) for cls in effects().values())


@EVERY
def test_its_parameters_are_read_as_they_are_written(cls: type[Effect]) -> None:
    for effect in (cls(), cls().scaled(0.5)):
        assert parse(cls, to_plain(effect), "file") == effect
        assert parse_effects({cls.name: to_plain(effect)}, "file", KNOWN) == (effect,)
    assert parse_effects({cls.name: None}, "file", KNOWN) == (cls(),)


@EVERY
def test_of_no_strength_it_changes_nothing(cls: type[Effect], short: Bench) -> None:
    null = cls().scaled(0.0)
    assert null.is_null
    assert not cls().is_null
    plain = all_frames(short)
    for name, frames in all_frames(short, null).items():
        assert np.array_equal(frames, plain[name]), name


@EVERY
def test_as_in_the_literature_it_changes_some_frames(cls: type[Effect], short: Bench) -> None:
    plain, on = all_frames(short), all_frames(short, strong(cls))
    assert any(not np.array_equal(plain[n], on[n]) for n in plain)


@EVERY
def test_frames_do_not_depend_on_how_the_work_is_cut(cls: type[Effect], short: Bench) -> None:
    effect = strong(cls)
    for recording in recordings(short):
        whole = frames_of(short, recording, [effect])
        for rows in ((0, 13), (13, 66), (66, 71)):
            for frames in (range(recording.count - 1, recording.count), range(1)):
                for frame, samples in Camera(short, rows, [effect]).expose(recording, frames):
                    assert np.array_equal(samples, whole[frame, rows[0] : rows[1]])


@EVERY
def test_windows_share_what_happens_to_frames_and_not_the_noise_of_pixels(
    cls: type[Effect], short: Bench
) -> None:
    recording = by_stem(short)["vertical"]
    other = dataclasses.replace(recording, window=1)
    for one, same in zip(
        dataclasses.astuple(states_of(recording, [strong(cls)])),
        dataclasses.astuple(states_of(other, [strong(cls)])),
        strict=True,
    ):
        np.testing.assert_array_equal(one, same)
    here, there = (frames_of(short, r, [strong(cls)]) for r in (recording, other))
    difference = here.astype(float) - there
    assert difference.std() > np.sqrt(2) * short.detector.read_noise_e
    # The level of a frame is the same but for the noise of its pixels and the place of hits.
    if cls.name != "cosmic_hits":
        noise = np.sqrt(2 * (here.mean() + short.detector.read_noise_e**2 + 3**2 * 100))
        assert np.abs(difference.mean(axis=(1, 2))).max() < 6 * noise / np.sqrt(here[0].size)


@EVERY_BUT_EXAMPLES
def test_it_is_not_claimed_where_it_is_not(
    cls: type[Effect], acquired: Callable[..., Evidence]
) -> None:
    found = cls.estimate(acquired())
    if found is None:
        return
    assert isinstance(found.effect, cls)
    assert all(error > 0 for error in found.errors.values())
    assert found.significance < 4
    assert found.why


@EVERY
def test_what_is_undone_is_what_was_done(cls: type[Effect]) -> None:
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:41, :53]
    k = (1.2, 0.1)
    psi = k[0] * (x + 0.01 * rng.standard_normal(x.shape)) + k[1] * y
    iota = 20_000 * (1 + 0.01 * rng.standard_normal(x.shape))
    maps = FringeMaps(np.stack([iota, 0.9 * iota * np.sin(psi), 0.9 * iota * np.cos(psi)]), k)
    changed = cls().predict(maps)
    if changed is None:
        return
    assert not np.allclose(changed.theta, maps.theta, rtol=1e-6)
    null = cls().scaled(0.0).predict(maps)
    assert null is not None
    np.testing.assert_allclose(null.theta, maps.theta, rtol=1e-12)
    back = cls().undo(changed)
    if back is not None:
        np.testing.assert_allclose(back.theta, maps.theta, atol=2e-5 * iota.mean())


@EVERY_OF_PIXCAL
def test_its_file_is_named_like_it(cls: type[Effect]) -> None:
    assert cls.name == cls.__module__.rpartition(".")[2]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_tells_every_parameter_of_its_effect(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for field in dataclasses.fields(effects()[page.stem]):
        assert f"`{field.name}`" in text, f"parameter {field.name} is not told"


def test_names_and_keys_that_are_not_known_are_refused() -> None:
    with pytest.raises(InputError, match=r"bench.yaml: effects: unknown effect 'colour'; known"):
        parse_effects({"colour": {}}, "bench.yaml")
    name = next(iter(effects()))
    with pytest.raises(InputError, match=rf"bench.yaml: effects.{name}: unknown key 'hue'"):
        parse_effects({name: {"hue": 1}}, "bench.yaml")


OWN = '''
from dataclasses import dataclass
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Stage

@dataclass(frozen=True)
class Glow(Effect):
    """Light of the amplifier."""
    name, title, acts_at = "glow", "glow", Stage.LIGHT
    domains, strengths, sources = ("intensity",), ("electrons",), ("nowhere in particular",)
    electrons: float = quantity(100.0, unit="e-", low=0, doc="in every pixel")

    def photons(self, mean, shot):
        return mean + self.electrons
'''


def test_an_effect_of_the_users_own_is_one_file(tmp_path: Path, short: Bench) -> None:
    file = tmp_path / "glow.py"
    file.write_text(OWN)
    cls = effect_of_file(file)
    (glow,) = parse_effects({"glow": {"electrons": 250.0}}, "bench", {"glow": cls})
    bias = by_stem(short)["bias"]
    difference = frames_of(short, bias, [glow]).astype(float) - frames_of(short, bias)
    assert difference.mean() == pytest.approx(250, abs=1)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("x = 1", "0 effects found"),
        ("import nowhere_to_be_found", "cannot be imported"),
        ("def", "cannot be imported"),
        (None, "not found"),
    ],
)
def test_a_file_without_an_effect_is_refused(tmp_path: Path, text: str | None, reason: str) -> None:
    file = tmp_path / "own.py"
    if text is not None:
        file.write_text(text)
    with pytest.raises(InputError, match=reason):
        effect_of_file(file)


def test_a_file_in_the_folder_is_all_that_a_new_effect_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = GLOW.read_text(encoding="utf-8").replace('"glow"', '"amplifier_light"')
    (tmp_path / "amplifier_light.py").write_text(text, encoding="utf-8")
    before, table = set(effects()), effect_table()
    monkeypatch.setattr(pixcal.effects, "__path__", [*pixcal.effects.__path__, str(tmp_path)])
    effects.cache_clear()
    try:
        assert set(effects()) == before | {"amplifier_light"}
        assert parse_effects({"amplifier_light": {"rate": 1.0}}, "file")[0].sort_key
        assert effect_table() == table
        assert draw_examination(len(before), 17, "small", "own").truths
    finally:
        effects.cache_clear()
        sys.modules.pop("pixcal.effects.amplifier_light", None)
