"""Simulations of a bench: none is made twice, and parameters are moved by their errors."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pixcal.effects.lag import Lag
from pixcal.effects.row_noise import RowNoise
from pixcal.engine.run import Runtime
from pixcal.estimators.test_statistics import Curve
from pixcal.simulation.effect import Effect, Estimate
from pixcal.stages.diagnose import trial
from pixcal.stages.diagnose.benches import (
    LEAST_SIMULATIONS,
    SEARCH_SAMPLES,
    SIMULATIONS,
    affordable,
)
from pixcal.stages.diagnose.trial import Trials

LAG, ROWS = Lag(share=0.002), RowNoise()
KNOWN = {"lag": Estimate(LAG, {"share": 2e-4}, 10.0, "")}


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[tuple[Effect, ...], int, int]]:
    """What is simulated; a lag of more than 0.0021 is refused."""
    items: list[tuple[tuple[Effect, ...], int, int]] = []

    def simulated(windows: Any, scratch: Path, signatures: Any, item: Any) -> Any:
        items.append(item)
        effects, seed, window = item
        if any(isinstance(e, Lag) and e.share > 0.0021 for e in effects):
            return "too much lag"
        value = np.array([float(seed + 10 * window)])
        return {("lines", "detector"): Curve(np.zeros(1), value)}

    monkeypatch.setattr(trial, "_kept_or_made", simulated)
    return items


def trials(tmp_path: Path, windows: int = 1) -> Trials:
    places: Any = tuple(range(windows))
    return Trials(places, tmp_path, Runtime(cluster="sync", quiet=True), (), KNOWN, 3)


def share(effects: tuple[Effect, ...]) -> float:
    (lag,) = (e for e in effects if isinstance(e, Lag))
    return lag.share


def test_the_first_are_exact_and_the_others_moved(tmp_path: Path, made: list[Any]) -> None:
    (found,) = trials(tmp_path).curves([(LAG, ROWS)], 8, "test")
    assert len(found) == 8
    first = {seed: share(effects) for effects, seed, _ in made}
    assert all(first[seed] == 0.002 for seed in range(3))
    assert len({first[seed] for seed in range(3, 8)}) == 5
    assert all(ROWS in effects for effects, *_ in made)


def test_samples_of_all_windows_limit_a_search(tmp_path: Path) -> None:
    held_out = {"bias": np.arange(7), "fringes/vertical": np.arange(29)}
    windows: Any = tuple(
        SimpleNamespace(part=((5, 5 + rows), (3, 14)), test=held_out) for rows in (13, 17)
    )
    some = Trials(windows, tmp_path, Runtime(cluster="sync", quiet=True))
    assert some.samples == (13 + 17) * 11 * (7 + 29)
    assert affordable(some.samples) == affordable(0) == SIMULATIONS
    assert affordable(SEARCH_SAMPLES // 200) == 200
    assert affordable(SEARCH_SAMPLES) == LEAST_SIMULATIONS


def test_what_is_refused_as_moved_is_taken_as_it_was(tmp_path: Path, made: list[Any]) -> None:
    (found,) = trials(tmp_path).curves([(LAG,)], 40, "test")
    assert len(found) == 40
    refused = {seed for effects, seed, _ in made if share(effects) > 0.0021}
    assert refused
    again = [seed for effects, seed, _ in made if seed >= 3 and share(effects) == 0.002]
    assert set(again) == refused


def test_nothing_is_made_twice(tmp_path: Path, made: list[Any]) -> None:
    one = trials(tmp_path, windows=2)
    one.curves([(ROWS,), (ROWS, LAG)], 3, "test")
    count = len(made)
    assert count == 2 * 2 * 3
    ((mean, *_),) = one.curves([(LAG, ROWS)], 3, "test")
    assert len(made) == count
    assert not isinstance(mean, str)
    assert mean["lines", "detector"].value == pytest.approx([5.0])
    (apart,) = one.of_window(1, (LAG, ROWS), 1)
    assert apart["lines", "detector"].value == pytest.approx([10.0])


def test_what_is_done_beside_is_done_once_and_only_if_any_is_made(
    tmp_path: Path, made: list[Any]
) -> None:
    one, times = trials(tmp_path), list[int]()
    plain = trials(tmp_path / "plain").curves([(ROWS,)], 5, "test")
    made.clear()
    found = one.curves([(ROWS,)], 5, "test", lambda: times.append(len(made)))
    again = one.curves([(ROWS,)], 5, "test", lambda: times.append(len(made)))
    assert times == [0]
    assert len(made) == 5
    np.testing.assert_equal(
        *([[c["lines", "detector"].value for c in f] for (f,) in (plain, found)])
    )  # type: ignore[index]
    assert again == found
