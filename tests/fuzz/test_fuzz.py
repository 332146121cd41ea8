"""Some cases of every kind of bad input, and the laws that judge them (docs/appendix/fuzz.md)."""

import os
import time
from collections import Counter
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from fuzzing import laws
from fuzzing.kinds import KINDS
from fuzzing.laws import Broken, Case, Kind, Refused, judged, pixcal
from fuzzing.night import Night, _check_flags
from pixcal.model.errors import InputError
from pixcal_cli.main import cli

PAGE = Path(__file__).parents[2] / "docs" / "appendix" / "fuzz.md"
CASES = {"markup": 2, "own-effects": 30}
"""Cases of a kind in the short version, where not a fortieth of those of the long one."""


@pytest.mark.quick(12)
@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_bad_input_is_refused_in_one_line_or_told_truly(kind: Kind) -> None:
    found: Counter[str] = Counter()
    for number in range(CASES.get(kind.name, max(3, kind.cases // 40))):
        verdict = judged(kind, number)
        assert verdict.outcome != "failed", f"--kind {kind.name} --case {number}: {verdict.why}"
        found[verdict.outcome] += 1
    assert found


def test_a_case_is_the_same_every_time() -> None:
    drawn: list[Any] = []
    kind = Kind("x", "", lambda case: drawn.append(case.rng.random()))
    assert judged(kind, 3).outcome == "truthful"
    judged(kind, 3)
    judged(kind, 4)
    assert drawn[0] == drawn[1] != drawn[2]


def test_the_page_has_a_row_of_each_kind_without_a_failure() -> None:
    rows = [r for r in PAGE.read_text(encoding="utf-8").splitlines() if r.startswith("| ")]
    table = {cells[0]: cells[1:] for r in rows if len(cells := r.strip("| ").split(" | ")) == 5}
    for kind in KINDS.values():
        cases, refused, truthful, failed = map(int, table[kind.title])
        assert cases == refused + truthful
        assert cases >= kind.cases
        assert failed == 0


# The laws find what is wrong.


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A command ``odd`` that does what the fixture's key ``body`` says."""
    does: dict[str, Any] = {}
    odd = click.Command("odd", callback=lambda: does["body"]())
    monkeypatch.setitem(cli.commands, "odd", odd)
    return does


def fails(error: BaseException) -> Any:
    def body() -> None:
        raise error

    return body


@pytest.mark.parametrize(
    ("body", "told"),
    [
        (fails(RuntimeError("x")), "exit code 1"),
        (fails(SystemExit(2)), "left by"),
        (fails(InputError("a.yaml: gain; mend it\N{BELL}")), None),
        (fails(InputError("b.yaml: gain; mend it")), "names none of a.yaml"),
        (fails(InputError("a.yaml: gain")), "what mends it"),
        (fails(InputError("a.yaml: Traceback; mend it")), "Traceback"),
        (fails(InputError("a.yaml: " + "gain; mend it " * 60)), "characters"),
        (lambda: click.echo("odd", err=True), "on stderr"),
        (lambda: os.write(2, b"from below") and None, "on stderr"),
        (fails(InputError("a.yaml: gain; mend it")), None),
    ],
)
def test_the_law_of_the_line(command: dict[str, Any], body: Any, told: str | None) -> None:
    command["body"] = body
    if told is None:
        with pytest.raises(Refused, match=r"a\.yaml"):
            pixcal("odd", names=["a.yaml"])
        return
    with pytest.raises(Broken, match=told):
        pixcal("odd", names=["a.yaml"])


def test_two_lines_are_one_too_many() -> None:
    with pytest.raises(Broken, match="not one line"):
        laws.check_line("pixcal: a; b\nmore\n", [], "odd")


def test_the_law_of_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(laws, "SECONDS", 0.2)
    verdict = judged(Kind("slow", "", lambda case: time.sleep(20)), 0)
    assert verdict.outcome == "failed"
    assert "still at work" in verdict.why


def test_the_law_of_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def hungry(case: Case) -> None:
        assert np.ones(laws.MEMORY // 8).sum() > 0

    verdict = judged(Kind("hungry", "", hungry), 0)
    assert verdict.outcome == "failed"
    assert "MiB are planned" in verdict.why


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda z: z, None),
        (lambda z: np.where(np.arange(z.size).reshape(z.shape) == 77, 8.0, z), "SIGMA"),
        (lambda z: 1.7 * z, "times SIGMA|of .* SIGMA"),
        (lambda z: z + 40 * np.sin(1.18 * np.arange(z.shape[1])), None),
    ],
)
def test_the_law_of_the_map(spoil: Any, told: str | None) -> None:
    rng = np.random.default_rng(3)
    night = Night(rng, (23, 29), count=4, vectors={"vertical": (1.18, 0.0)})
    error = spoil(rng.normal(0, 1.0, night.shape))
    sigma, sets = np.ones(night.shape), {"vertical": {"model": "paraxial"}}
    if told is None:
        night._check_errors("delta_fringe", error, sigma, sets)
        return
    with pytest.raises(Broken, match=told):
        night._check_errors("delta_fringe", error, sigma, sets)


def test_the_law_of_the_flags() -> None:
    value, sigma, mask = np.zeros((4, 5)), np.ones((4, 5)), np.zeros((4, 5), np.uint8)
    _check_flags("map", value, sigma, mask)
    mask[1, 2] = 4
    with pytest.raises(Broken, match="1 pixels have a value and a flag"):
        _check_flags("map", value, sigma, mask)
    value[1, 2] = np.nan
    with pytest.raises(Broken, match="SIGMA is not there"):
        _check_flags("map", value, sigma, mask)
