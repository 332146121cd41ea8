"""The strict loader: what is written comes back, and every mistake is named by its key."""

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pixcal.model.config import meanings, parse, quantity, to_plain
from pixcal.model.errors import InputError
from pixcal.model.yaml_file import MAX_CONFIG_BYTES, read_yaml, to_yaml


@dataclass(frozen=True)
class Part:
    name: str = quantity(doc="free text")
    weight_kg: float = quantity(1.5, unit="kg", above=0, high=1e6)
    """with its
    packaging"""


@dataclass(frozen=True)
class Whole:
    count: int = quantity(unit="frames", low=1, high=1000)
    mode: str = quantity("fast", choices=("fast", "slow"))
    ratio: float | None = quantity(None, low=-1, high=1)
    active: bool = quantity(False)
    pair: tuple[float, float] = quantity((0.0, 0.0), unit="mm", low=-5, high=5)
    labels: tuple[str, ...] = quantity(())
    first: Part = quantity(Part("a"))
    parts: tuple[Part, ...] = quantity(())


part = st.builds(Part, name=st.text(max_size=20), weight_kg=st.floats(0, 1e6, exclude_min=True))
whole = st.builds(
    Whole,
    count=st.integers(1, 1000),
    mode=st.sampled_from(["fast", "slow"]),
    ratio=st.none() | st.floats(-1, 1),
    active=st.booleans(),
    pair=st.tuples(st.floats(-5, 5), st.floats(-5, 5)),
    labels=st.lists(st.text(max_size=8), max_size=3).map(tuple),
    first=part,
    parts=st.lists(part, max_size=3).map(tuple),
)


@given(whole)
def test_what_is_written_comes_back(config: Whole) -> None:
    assert parse(Whole, to_plain(config), "f") == config
    assert parse(Whole, json.loads(json.dumps(to_plain(config))), "f") == config


@given(config=whole)
def test_yaml_round_trip(config: Whole, tmp_path_factory: pytest.TempPathFactory) -> None:
    file = tmp_path_factory.mktemp("yaml") / "c.yaml"
    file.write_text(to_yaml(config), encoding="utf-8")
    assert parse(Whole, read_yaml(file), str(file)) == config


@pytest.mark.parametrize(
    "text", ["0e0", "1e5", "no", "010", "1:30", "~", "", "\x85", "a: b", "# a"]
)
def test_text_that_looks_like_something_else_stays_text(text: str, tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text(to_yaml(Part(text)), encoding="utf-8")
    assert parse(Part, read_yaml(file), str(file)) == Part(text)


def test_defaults_fill_what_is_absent() -> None:
    assert parse(Whole, {"count": 3}, "f") == Whole(count=3)
    assert parse(Whole, {"count": 3.0}, "f") == Whole(count=3), "a whole float is a whole number"
    assert parse(Whole, {"count": 3, "ratio": 1}, "f").ratio == 1.0


@pytest.mark.parametrize(
    ("data", "names"),
    [
        ({"count": 1, "cuont": 2}, ["cuont", "count"]),
        ({"count": 1, "first": {"name": "a", "weight": 2}}, ["first", "weight", "weight_kg"]),
        ({}, ["count", "missing", "frames"]),
        ({"count": 1, "parts": [{"name": "a"}, {}]}, ["parts[1].name", "missing"]),
        ({"count": "7"}, ["count", "'7'", "bare number", "frames"]),
        ({"count": 1, "first": {"name": "a", "weight_kg": "2 kg"}}, ["weight_kg", "'2 kg'", "kg"]),
        ({"count": True}, ["count", "True"]),
        ({"count": 1.5}, ["count", "whole", "1.5"]),
        ({"count": None}, ["count", "nothing"]),
        ({"count": 0}, ["count", "below 1"]),
        ({"count": 1001}, ["count", "above 1000"]),
        ({"count": 10**30}, ["count", "too large"]),
        ({"count": math.nan}, ["count", "nan"]),
        ({"count": 1, "ratio": math.nan}, ["ratio", "nan"]),
        ({"count": 1, "ratio": -math.inf}, ["ratio", "-inf"]),
        ({"count": 1, "first": {"name": "a", "weight_kg": 0}}, ["first.weight_kg", "greater"]),
        ({"count": 1, "mode": "medium"}, ["mode", "'medium'", "fast, slow"]),
        ({"count": 1, "mode": 3}, ["mode", "text", "3"]),
        ({"count": 1, "active": "yes"}, ["active", "true or false"]),
        ({"count": 1, "active": 1}, ["active", "true or false"]),
        ({"count": 1, "pair": [1.0]}, ["pair", "2 values", "found 1"]),
        ({"count": 1, "pair": [1.0, 6]}, ["pair[1]", "above 5 mm"]),
        ({"count": 1, "pair": "12"}, ["pair", "list"]),
        ({"count": 1, "pair": {"a": 1}}, ["pair", "list", "mapping"]),
        ({"count": 1, "labels": "abc"}, ["labels", "list"]),
        ({"count": 1, "labels": ["a", 2]}, ["labels[1]", "text"]),
        ({"count": 1, "first": ["a"]}, ["first", "keys and values", "list"]),
        ([1], ["keys and values", "a list"]),
    ],
)
def test_a_mistake_is_named(data: Any, names: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        parse(Whole, data, "where.yaml")
    message = str(caught.value)
    assert message.startswith("where.yaml: ")
    assert "\n" not in message
    for name in names:
        assert name in message


junk = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from([f.name for f in dataclasses.fields(Whole)]), inner)
    ),
    max_leaves=10,
)


@given(st.dictionaries(st.sampled_from([f.name for f in dataclasses.fields(Whole)]), junk))
def test_any_data_is_read_or_refused_in_one_line(data: dict[str, Any]) -> None:
    try:
        config = parse(Whole, {"count": 1} | data, "f")
    except InputError as error:
        message = str(error)
    else:
        assert parse(Whole, to_plain(config), "f") == config
        return
    assert message.startswith("f: ")
    assert "\n" not in message


def test_a_mistake_is_short_whatever_was_written() -> None:
    for data in ({"m" * 10**5: 1}, {"mode": "m" * 10**5}, {"count": "m" * 10**5}):
        with pytest.raises(InputError) as caught:
            parse(Whole, {"count": 1} | data, "f")
        assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("cuont: 1\ncount: 2", 1),
        ("count: 1\nratio: 2", 2),
        ("count: 1\npair:\n  - 1\n  - 6", 2),
        ("count: 1\nfirst:\n  weight_kg: 2\n", 2),
        ("count: 1\nfirst:\n  name: a\n  weight_kg: x\n", 4),
        ("count: 1\nparts:\n- name: a\n- name: b\n  weight: 3\n", 5),
        ("mode: fast", None),
    ],
)
def test_a_mistake_in_a_file_has_its_line(tmp_path: Path, text: str, line: int | None) -> None:
    file = tmp_path / "c.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        parse(Whole, read_yaml(file), str(file))
    assert str(caught.value).endswith(f" (line {line})") == (line is not None)


def test_mutable_defaults_are_refused() -> None:
    with pytest.raises(TypeError):
        quantity([])


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("a: 1\nb: 2\na: 3\n", ["line 3", "'a'", "twice"]),
        ("a: {b: 1, b: 2}", ["'b'", "twice"]),
        ("a: &x 1\nb: *x\n", ["aliases", "line 2"]),
        ("a: !!python/name:os.system x", ["tags", "line 1"]),
        ("a: !!float 1", ["tags"]),
        ("1: a", ["line 1", "'1' is not a name"]),
        ("{pitch_um: 4,4}", ["line 1", "decimal point, not a comma"]),
        ("a:\n\tb: 1", ["line 2", "spaces, not by tabs"]),
        ("? [a]\n: 1", ["line 1", "not a name"]),
        ("a: [1, 2", ["not valid YAML"]),
        ("a: 1\n\tb: 2", ["not valid YAML"]),
        ("a: " + "9" * 5000, ["not valid YAML"]),
        ("a\0b", ["not valid YAML"]),
        ("", ["keys and values"]),
        ("just words", ["keys and values"]),
        ("- a\n- b", ["keys and values"]),
        ("[" * 500_000, ["nested too deeply"]),
        ("{a: " * 200_000, ["nested too deeply"]),
        ("- " * 400_000, ["nested too deeply"]),
        ("#" * (MAX_CONFIG_BYTES + 1), ["larger than"]),
    ],
    ids=lambda value: None if isinstance(value, list) else repr(value[:20]),
)
def test_what_is_not_plain_yaml_is_refused(tmp_path: Path, text: str, names: list[str]) -> None:
    file = tmp_path / "c.yaml"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        read_yaml(file)
    message = str(caught.value)
    assert message.startswith(f"{file}: ")
    assert "\n" not in message
    for name in names:
        assert name in message


@given(data=st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(
    data: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = tmp_path_factory.mktemp("bytes") / "c.yaml"
    file.write_bytes(data)
    try:
        read = read_yaml(file)
    except InputError as error:
        message = str(error)
    else:
        assert isinstance(read, dict)
        return
    assert message.startswith(f"{file}: ")
    assert len(message.splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("010", 10),
        ("+3", 3),
        ("4e2", 400.0),
        ("6.328E-7", 6.328e-7),
        ("-.5", -0.5),
        ("1:30", "1:30"),
        ("1_000", "1_000"),
        ("0x10", "0x10"),
        ("no", "no"),
        ("on", "on"),
        ("2026-01-01", "2026-01-01"),
        ("true", True),
        ("~", None),
        ("", None),
        ("null", None),
        ("<<", "<<"),
    ],
)
def test_bare_words_mean_what_yaml_1_2_says(tmp_path: Path, text: str, value: Any) -> None:
    file = tmp_path / "c.yaml"
    file.write_text(f"a: {text}\n")
    read = read_yaml(file)["a"]
    assert read == value
    assert type(read) is type(value)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    latin = tmp_path / "latin.yaml"
    latin.write_bytes("name: \xe9".encode("latin-1"))
    for file in (tmp_path / "absent.yaml", tmp_path, latin):
        with pytest.raises(InputError, match="cannot be read") as caught:
            read_yaml(file)
        assert str(caught.value).startswith(f"{file}: ")


@dataclass(frozen=True)
class Heavy(Part):
    colour: str = quantity("red")
    number: int = quantity(0, doc="of the batch")


def test_what_a_field_means_stands_in_doc_or_below_it_and_is_inherited() -> None:
    words = {"name": "free text", "weight_kg": "with its packaging", "number": "of the batch"}
    assert meanings(Heavy) == {**words, "colour": ""}
