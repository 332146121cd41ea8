"""The verdict: numbers as they are, and worries where there is cause."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pixcal.report.contents import Contents, MapContents, SetContents
from pixcal.report.findings import findings
from pixcal.report.map_summary import ArraySource, summarise, summarise_flags
from pixcal.report.page import fill
from pixcal.report.summary import cards, headline

WHITE = {"slope": -0.499, "slope_err": 0.004, "knee_frames": None, "frames": [1], "warnings": []}


def contents(
    facts: dict[str, Any] | None = None,
    allan: dict[str, Any] | None = None,
    *,
    masked: int = 0,
    consistency: float | None = None,
    warnings: tuple[str, ...] = (),
) -> Contents:
    shape = (20, 30)
    flags = np.zeros(shape, np.uint8)
    flags.ravel()[:masked] = 1
    delta = np.random.default_rng(0).normal(0, 6e-3, shape)
    chosen = {
        "frames": 600,
        "sigma_median_px": 2e-4,
        "crb_median_px": 2e-4,
        "sigma_scale": 1.0,
        "batch_period_s": 0.14,
    } | (facts or {})
    one = summarise(ArraySource(np.ones(shape)))
    series = dict.fromkeys(("time", "B", "A", "phi", "dkx", "dky"), np.zeros(3))
    summary = summarise_flags(ArraySource(flags))
    fringes = SetContents("s", chosen, one, one, one, summary, series, allan or dict(WHITE))
    sigma = summarise(ArraySource(np.full(shape, 2e-4)))
    return Contents(
        acquisition={
            "detector": {"pitch_um": 5.0},
            "frames": {"flat": ["f"], "fringes": [{"name": "s"}]},
        },
        stages=(),
        fit={"sets_chi2_reduced": consistency},
        offsets=(MapContents("delta_x", summarise(ArraySource(delta)), sigma, None),),
        sets=(fringes,),
        flags=summary,
        warnings=warnings,
    )


def level_of(found: Contents, words: str) -> str:
    (finding,) = (f for f in findings(found) if words in f.text)
    return finding.level


def test_a_good_run_has_nothing_to_check() -> None:
    assert {f.level for f in findings(contents())} == {"good"}
    assert {c.level for c in cards(contents())} == {"good"}


def test_precision_is_given_in_pixels_and_nanometres() -> None:
    assert headline(contents()) == "Median error (1σ): δx 2.0 × 10⁻⁴ px (1.0 nm)."


@pytest.mark.parametrize(("ratio", "level"), [(1.0, "good"), (1.3, "check"), (2.0, "bad")])
def test_the_bound(ratio: float, level: str) -> None:
    found = contents({"sigma_median_px": ratio * 2e-4})
    assert level_of(found, "Cramér–Rao") == level


@pytest.mark.parametrize(("scale", "level"), [(1.05, "check"), (0.9, "check"), (1.5, "bad")])
def test_scaled_errors_are_pointed_out(scale: float, level: str) -> None:
    assert level_of(contents({"sigma_scale": scale}), "errors were multiplied") == level


def test_scaled_errors_are_not_pointed_out_without_need() -> None:
    texts = [f.text for f in findings(contents({"sigma_scale": 1.01}))]
    assert not any("multiplied" in text for text in texts)


@pytest.mark.parametrize(
    ("changes", "level", "words"),
    [
        ({}, "good", "square root of the number of frames"),
        ({"slope": -0.4}, "check", "slope −0.4000 ± 0.0040, not −0.5"),
        ({"knee_frames": 13_000.0}, "check", "beyond 13\u202f000 frames"),
    ],
)
def test_the_allan_deviation(changes: dict[str, Any], level: str, words: str) -> None:
    found = contents(allan=WHITE | changes)
    assert level_of(found, words) == level
    (card,) = (c for c in cards(found) if "Allan" in c.title)
    assert card.level == level


@pytest.mark.parametrize(("masked", "level"), [(0, "good"), (20, "check"), (300, "bad")])
def test_masked_pixels(masked: int, level: str) -> None:
    (card,) = (c for c in cards(contents(masked=masked)) if c.title == "masked pixels")
    assert card.level == level
    assert card.detail == f"{masked} of 600"


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        ({"fringe_vector_moves": True}, "fringe vector varies"),
        (
            {"model": "hyperbolic", "geometry": {"centre_x_mm": 79.0, "centre_x_nominal_mm": 0.0}},
            "79.0 mm from their nominal position along x",
        ),
    ],
)
def test_what_the_fit_says_of_the_bench(facts: dict[str, Any], words: str) -> None:
    assert level_of(contents(facts), words) == "check"


@pytest.mark.parametrize(("chi2", "level"), [(1.01, "good"), (3.0, "bad")])
def test_sets_that_do_not_agree(chi2: float, level: str) -> None:
    assert level_of(contents(consistency=chi2), "measure the same offsets") == level


def test_the_way_to_the_precision_wanted() -> None:
    # (2e-4 / 5e-5)² = 16 times 600 frames of 0.14 s.
    assert level_of(contents(), "needs 9\u202f600 frames (22.4 min") == "good"
    assert (
        level_of(contents({"sigma_median_px": 4e-5}), "reaches the target of 5 × 10⁻⁵ px") == "good"
    )


def test_warnings_are_sentences_and_worries_come_first() -> None:
    found = findings(contents({"sigma_scale": 1.5}, warnings=("the lamp flickers",)))
    assert [f.level for f in found] == sorted(
        (f.level for f in found), key=("bad", "check", "good").index
    )
    assert "The lamp flickers." in [f.text for f in found]


def test_a_finding_on_several_sets_is_one_sentence() -> None:
    one = contents({"sigma_median_px": 2.6e-4, "fringe_vector_moves": True})
    other = contents({"sigma_median_px": 2.8e-4, "fringe_vector_moves": True})
    both = replace(one, sets=(one.sets[0], replace(other.sets[0], name="other")))
    texts = [f.text for f in findings(both)]
    assert (
        "All sets: the fringe vector varies from frame to frame; it was fitted in each frame."
    ) in texts
    (bound,) = (text for text in texts if "Cramér–Rao" in text)
    assert bound.endswith("1.300 for s and 1.400 for other.")
    assert len(texts) == len(findings(one))


def test_corrected_maps_are_shown_beside_those_of_the_fit() -> None:
    run = contents()
    assert "corrected" not in fill("maps", run)
    shown = fill("maps", replace(run, corrected=run.offsets))
    assert shown.index("Map of δx.") < shown.index("Map of δx, corrected.")
    assert shown.count("Use this map") == 1
