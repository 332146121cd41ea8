"""The diagnosis in the report: true to its numbers, whatever was found, whatever it is called."""

import dataclasses
import html
import io
import math
import re
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pixcal.estimators.test_statistics import DETECTOR, known_statistics
from pixcal.estimators.test_statistics.fringe_set_data import STEPS
from pixcal.estimators.test_statistics.noise import OUTLIERS
from pixcal.report import diagnosis_figures as figures
from pixcal.report import diagnosis_maps as maps
from pixcal.report import diagnosis_words
from pixcal.report import page as page_module
from pixcal.report.contents import Contents, DiagnosisContents
from pixcal.report.diagnosis_figures import Bar, curves_figure, gap_figure
from pixcal.report.diagnosis_words import percent, place, places, with_interval
from pixcal.report.drawing import png
from pixcal.report.page import fill, render
from pixcal.report.summary import cards
from pixcal.report.tables import provenance
from pixcal.storage.manifest import Manifest

NOTICED = 3.7
NASTY = "<script>alert('$\\frac{1}{$')</script> & \"quotes\"\n\t\x07é漢"


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of words: drawing takes most of the time."""
    monkeypatch.setattr(page_module, "png", lambda _figure: b"")


def a_curve(
    statistic: str = "lines",
    of: str = "one",
    domain: str = "noise",
    sigma: float = 9.0,
    after: float = 0.5,
    values: int = 2,
    **changes: Any,
) -> dict[str, Any]:
    """A curve whose last value differs by so many sigma, before and after."""
    last = np.arange(values) == values - 1

    def band(at: float) -> dict[str, list[float]]:
        middle = 1 + 0.01 * at * last
        return {"value": list(middle), "low": list(middle - 0.01), "high": list(middle + 0.01)}

    return {
        "statistic": statistic,
        "set": of,
        "title": f"title of {statistic}",
        "domain": domain,
        "quantity": "values",
        "unit": "",
        "x_label": "bin",
        "kind": "power",
        "x": [float(n) for n in range(values)],
        "measured": list(1 + 0.01 * sigma * last),
        "nominal": band(0.0),
        "with_effects": band(sigma - after),
        "z": list(sigma * last),
        "z_after": list(after * last),
        "in_gap": sigma > NOTICED,
        "weight": sigma**2,
        "left": min(1.0, (after / sigma) ** 2) if after > 2 else 0.0,
        "size": -2 * sigma,
        "significance": sigma,
        "significance_after": after if after > 1 else -37.0,
    } | changes


def a_cause(effect: str = "lag", **changes: Any) -> dict[str, Any]:
    return {
        "effect": effect,
        "title": f"what {effect} is",
        "parameters": {"share": 0.002},
        "uncertainty": {"share": 2e-5},
        "units": {"share": "e-/um"},
        "strengths": ["share"],
        "meanings": {"share": "left behind"},
        "about": "Charge stays.",
        "gap_closed": 0.8,
        "gap_closed_interval": [0.75, 0.83],
        "gain_over_rest": 0.61,
        "p_value": 2e-40,
        "sigmas": 80.0,
        "why": "frames follow others",
        "given_away_by": [{"statistic": "lines", "set": "one"}],
        "not_told_apart_from": [],
        "would_decide": [],
    } | changes


def a_diagnosis(
    verdict: str = "explained",
    causes: tuple[dict[str, Any], ...] | None = None,
    curves: tuple[dict[str, Any], ...] | None = None,
    **gap: Any,
) -> DiagnosisContents:
    if causes is None:
        causes = (a_cause(),) if "explained" in verdict.split() else ()
    if curves is None:
        curves = (a_curve(), a_curve("repeat", domain="space", sigma=5.0), a_curve("o", sigma=1.0))
    facts = {
        "verdict": verdict,
        "causes": list(causes),
        "statistics": 102,
        "more_would_tell": ["dark frames"],
        "gap": {
            "total": 1.0,
            "after": 0.03,
            "interval": [0.01, 0.06],
            "where": [],
            "domains": {
                "space": [0.3, 0.02],
                "time": [0.0, 0.0],
                "intensity": [0.0, 0.0],
                "noise": [0.7, 0.01],
            },
            "absolute": [
                {
                    "quantity": "offset rows",
                    "unit": "px",
                    "measured": 2e-3,
                    "simulated": 3e-5,
                    "after": 1.9e-3,
                    "simulated_interval": [2e-5, 4e-5],
                    "after_interval": [1.8e-3, 2.1e-3],
                    "with_only": {"lag": 1.7e-3, "mine": 4e-5},
                }
            ],
        }
        | gap,
        "candidates": [
            {
                "effect": "ipc",
                "gap_closed": 0.0,
                "rejected_because": "not seen (0.4 sigma)",
                "tried_on_unseen_frames": False,
                "sigmas": 0.4,
            },
            {
                "effect": "mine",
                "gap_closed": 0.11,
                "rejected_because": "no likelier with it",
                "tried_on_unseen_frames": True,
                "sigmas": 5.0,
            },
        ],
        "looked_at": {
            "fitted_on": {
                "window": [[0, 64], [10, 74]],
                "frames": {"flat": [0, 18, 10], "fringes/one": [0, 99, 100]},
            },
            "tried_on": {
                "windows": [[[0, 64], [10, 74]], [[70, 134], [0, 64]]],
                "frames": {"fringes/one": [100, 199, 100]},
            },
        },
    }
    titles = {"lag": "words", "ipc": "crosstalk"}
    return DiagnosisContents(facts, list(curves), titles, NOTICED)


def contents(found: DiagnosisContents | None, **changes: Any) -> Contents:
    frames = {
        "bias": ["b"],
        "dark": ["d"],
        "flat": ["f"],
        "fringes": [{"name": "one", "files": ["x"], "baseline_mm": [6.0, 0.0]}],
    }
    acquisition = {
        "detector": {"pitch_um": 4.4, "gain_e_per_adu": 1.0, "read_noise_e": 16.0},
        "optics": {"wavelength_nm": 632.8, "distance_mm": 400.0},
        "frames": frames | changes.pop("frames", {}),
    }
    return Contents(acquisition=acquisition, stages=(), diagnosis=found, **changes)


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of the page."""

    title: str
    header: list[str]
    rows: list[list[str]]


@dataclasses.dataclass(frozen=True)
class Shown:
    """The section on the diagnosis, as a reader of the page has it."""

    page: str

    @property
    def text(self) -> str:
        return words(self.page)

    def marked(self, tag: str, role: str = "") -> list[str]:
        """Text of the elements of a kind."""
        start = f'<{tag} class="{role}[^"]*">' if role else f"<{tag}>"
        return [words(m) for m in re.findall(f"{start}(.*?)</{tag}>", self.page, re.DOTALL)]

    @property
    def answer(self) -> str:
        (text,) = self.marked("p", "answer")
        return text

    def answered(self, level: str) -> bool:
        return f'<p class="answer {level}">' in self.page

    @property
    def plates(self) -> list[str]:
        return [html.unescape(title) for title in re.findall(r'<img [^>]*alt="([^"]*)"', self.page)]

    def tables(self, title: str) -> list[Table]:
        made = []
        for part in re.findall(r"<table[^>]*>(.*?)</table>", self.page, re.DOTALL):
            rows = [
                [words(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL)]
                for row in re.findall(r"<tr>(.*?)</tr>", part, re.DOTALL)
            ]
            caption = words(re.findall(r"<caption>(.*?)</caption>", part, re.DOTALL)[0])
            made.append(Table(caption, rows[0], rows[1:]))
        return [table for table in made if table.title.startswith(title)]


def words(text: str) -> str:
    """Text without tags, its lines joined."""
    return re.sub(r"[ \n]+", " ", html.unescape(re.sub(r"<[^>]*>", " ", text))).strip()


def diagnosis(of: Contents) -> Shown:
    return Shown(fill("diagnosis", of))


def text_of(shown: Shown) -> str:
    return shown.text


def table(shown: Shown, title: str) -> Table:
    (found,) = shown.tables(title)
    return found


@pytest.mark.usefixtures("without_figures")
@pytest.mark.parametrize("verdict", ["no gap", "explained", "partly explained"])
def test_frames_that_were_not_split_are_not_called_held_out(verdict: str) -> None:
    found = a_diagnosis(verdict, curves=(a_curve("a", sigma=9.0, after=0.5),))
    used = found.facts["looked_at"]
    for shared in ([], ["flat"]):
        of = dataclasses.replace(
            found, facts=found.facts | {"looked_at": used | {"shared": shared}}
        )
        shown = diagnosis(contents(of))
        assert ("held-out" in shown.answer) != bool(shared)
        assert ("tested on the other, except flat frames" in shown.text) == bool(shared)


def test_a_run_that_was_not_diagnosed_says_what_to_run() -> None:
    shown = diagnosis(contents(None))
    assert shown.text.startswith("Not run: run 'pixcal diagnose RUN'")
    assert not shown.plates
    assert not any("diagnosis" in card.title for card in cards(contents(None)))


@pytest.mark.usefixtures("without_figures")
def test_no_gap_is_said_at_once_and_what_came_nearest_is_shown() -> None:
    curves = (a_curve("a", sigma=1.0, after=1.0), a_curve("b", sigma=3.1, after=3.1))
    found = a_diagnosis("no gap", curves=curves, total=0.0, after=0.0, interval=[0.0, 0.0])
    shown = diagnosis(contents(found))
    assert shown.answered("good")
    assert shown.answer.startswith("No gap")
    assert "none of 102 statistics" in shown.answer
    assert not shown.marked("p", "advice")
    found.facts["not_tested"] = {"flat frames": ["nonlinearity", "lag"]}
    last = "Not tested: nonlinearity, lag (needs flat frames)."
    assert diagnosis(contents(found)).marked("p", "advice") == [last]
    found.facts.update(not_tested={}, not_compared=["outliers of A"])
    last = "Not tested: outliers of A (no counterpart in the simulations)."
    assert diagnosis(contents(found)).marked("p", "advice") == [last]
    nearest = table(shown, "Largest deviations, none of them significant")
    assert [row[1] for row in nearest.rows] == ["title of b (values)", "title of a (values)"]
    assert "with causes" not in text_of(shown)
    (card,) = (c for c in cards(contents(found)) if c.title == "diagnosis")
    assert (card.value, card.level) == ("no gap", "good")


@pytest.mark.usefixtures("without_figures")
def test_unexplained_says_where_and_what_could_tell_more() -> None:
    found = a_diagnosis("unexplained", after=1.0, interval=[0.9, 1.1])
    shown = diagnosis(contents(found))
    assert shown.answered("bad")
    assert "in 2 of 102 statistics, mostly in noise. None of the 2 effects" in (shown.answer)
    advice = shown.marked("p", "advice")
    assert len(advice) == 1
    assert "dark frames" in advice[0]
    assert shown.plates == ["The gap", "The largest differences"]
    assert "with causes" not in text_of(shown)


@pytest.mark.usefixtures("without_figures")
def test_causes_come_with_their_numbers() -> None:
    causes = (a_cause(), a_cause("mine", p_value=3e-4, gap_closed=0.2, gain_over_rest=0.05))
    shown = diagnosis(contents(a_diagnosis(causes=causes)))
    assert shown.answer.startswith(
        "Explained: what lag is (lag) and what mine is (mine) account for"
    )
    assert "residual gap is 3.0\u00a0% (90\u00a0% interval 1.0 to 6.0\u00a0%)" in shown.answer
    assert [row[:4] for row in table(shown, "Causes").rows] == [
        ["1. what lag is (lag)", "80\u00a0% [75, 83]", "61\u00a0%", "< 10⁻¹²"],
        ["2. what mine is (mine)", "20\u00a0% [75, 83]", "5.0\u00a0%", "3.0\u00a0×\u00a010⁻⁴"],
    ]
    assert "Charge stays. Evidence: frames follow others." in text_of(shown)
    assert list(table(shown, "Parameters of lag").rows) == [
        ["share", "0.002000 ± 0.000020", "e⁻/µm", "left behind"]
    ]
    units = table(shown, "Differences in physical units (1σ intervals)")
    assert units.header[2:] == ["measured", "nominal", "with causes", "lag only", "mine only"]
    assert list(units.rows[0])[2:] == [
        "0.00200",
        "3.00\u00a0×\u00a010⁻⁵ [2.00\u00a0×\u00a010⁻⁵, 4.00\u00a0×\u00a010⁻⁵]",
        "0.00190 [0.00180, 0.00210]",
        "0.00170",
        "4.00\u00a0×\u00a010⁻⁵",
    ]
    assert shown.plates == [
        "The gap",
        "Evidence for what lag is (lag)",
        "Evidence for what mine is (mine)",
    ]
    assert "No statistic differs significantly any more." in text_of(shown)


@pytest.mark.usefixtures("without_figures")
def test_parameters_of_any_shape_are_listed() -> None:
    couplings = [{"dy": n, "share": 0.01 * n, "every": 4} for n in range(1, 21)]
    cause = a_cause(
        parameters={
            "couplings": couplings,
            "pair": [1.0, 2.0],
            "on": True,
            "kind": "slow",
            "none": None,
        },
        uncertainty={"couplings[3].share": 0.001, "pair[1]": 0.1},
    )
    shown = diagnosis(contents(a_diagnosis(causes=(cause,))))
    assert [row[:2] for row in table(shown, "Parameters").rows] == [
        ["pair", "1 (not fitted), 2.00 ± 0.10"],
        ["on", "yes"],
        ["kind", "slow"],
    ]
    assert "The same in all rows: every = 4." in text_of(shown)
    first, rest = shown.tables("coupl")
    assert list(first.header) == ["dy", "share"]
    assert first.rows[3] == ["4", "0.0400 ± 0.0010"]
    assert len(first.rows) == 12
    assert [row[0] for row in rest.rows] == [str(n) for n in range(13, 21)]


@pytest.mark.usefixtures("without_figures")
def test_a_replay_is_not_shown_as_a_strength_of_zero() -> None:
    tracks = [{"set": name, "value": [-0.02, 0.02]} for name in ("vertical", "horizontal")]
    cause = a_cause(
        parameters={"rms": 0.0, "line_hz": 100.0, "rate": 0.5, "tracks": tracks},
        uncertainty={"rms": 0.0012, "rate": 0.1},
    )
    shown = diagnosis(contents(a_diagnosis(causes=(cause,))))
    assert [row[0] for row in table(shown, "Parameters").rows] == ["rate"]
    assert [row[0] for row in table(shown, "tracks").rows] == ["vertical", "horizontal"]


def test_options_with_parameters_are_named_in_the_provenance() -> None:
    effects = [{"effect": "ipc", "parameters": {"share": 0.1}}, {"effect": "lag"}]
    config = {"effects": effects, "own": []}
    stage = vars(Manifest("corrected", 2, "k", config, {}))
    stages, _ = provenance(Contents({"detector": {}}, (stage,)))
    assert stages.rows[0][-1] == "effects ipc, lag; own –"


@pytest.mark.usefixtures("without_figures")
def test_every_difference_is_listed_once_the_worst_of_each_domain_first() -> None:
    domains = {"space": 20, "noise": 9, "time": 2, "intensity": 1}
    curves = tuple(
        a_curve(f"{domain}{n}", domain=domain, sigma=40.0 - n)
        for domain, count in domains.items()
        for n in range(count)
    )
    shown = diagnosis(contents(a_diagnosis(curves=(*curves, a_curve("quiet", sigma=1.0)))))
    first, rest = table(shown, "Statistics that differ"), table(shown, "Other statistics")
    assert len(first.rows) == 12
    assert {row[0] for row in first.rows} == set(domains)
    for rows in (first.rows, rest.rows):
        order = [row[0] for row in rows]
        assert order == sorted(order, key=list(dict.fromkeys(order)).index)
        for domain in set(order):
            sizes = [float(row[5]) for row in rows if row[0] == domain]
            assert sizes == sorted(sizes, reverse=True)
    listed = [row[1] for row in (*first.rows, *rest.rows)]
    assert sorted(listed) == sorted(f"{c['title']} (values)" for c in curves)
    # On a phone the cells are stacked, each after its heading.
    (part,) = re.findall(r'<table class="stacked">.{9,30}Statistics.*?</table>', shown.page, re.S)
    (row, *_) = re.findall(r"<tbody>\n<tr>(.*?)</tr>", part, re.DOTALL)
    assert re.findall(r'data-head="(.*?)"', row) == list(first.header)


@pytest.mark.usefixtures("without_figures")
def test_values_that_hardly_differ_are_shown_with_the_digits_that_tell() -> None:
    nominal = {key: [1.0, 1.0007] for key in ("value", "low", "high")}
    curve = a_curve(unit="px", measured=[1.0, 1.0012], nominal=nominal)
    shown = diagnosis(contents(a_diagnosis(curves=(curve,))))
    (row,) = table(shown, "Statistics that differ").rows
    assert row[3:5] == ["1.0012 px", "1.0007"]
    assert row[5:7] == ["18", "9.0"]


@pytest.mark.usefixtures("without_figures")
def test_what_remains_is_named_and_what_is_new_is_a_warning() -> None:
    curves = (
        a_curve("gone"),
        a_curve("stays", domain="time", sigma=9.0, after=8.0),
        a_curve("new", domain="intensity", sigma=0.5, after=-6.0, significance_after=5.0),
    )
    found = a_diagnosis(
        "partly explained",
        curves=curves,
        after=0.31,
        interval=[0.25, 0.36],
        domains={"space": [0.5, 0.0], "time": [0.5, 0.2], "intensity": [0, 0], "noise": [0, 0]},
    )
    shown = diagnosis(contents(found))
    assert "69\u00a0% of the gap" in shown.answer
    assert "31\u00a0% (90\u00a0% interval 25 to 36\u00a0%), mostly in time, " in shown.answer
    rest = table(shown, "Statistics that still differ")
    assert [row[1] for row in rest.rows] == ["title of stays (values)", "title of new (values)"]
    assert rest.rows[0][-2:] == ["8.0", "79\u00a0%"]
    assert rest.rows[1][-2:] == ["5.0", "new"]
    assert "Of these, 1 did not differ before" in text_of(shown)


@pytest.mark.usefixtures("without_figures")
def test_what_was_considered_and_looked_at_is_folded() -> None:
    shown = diagnosis(contents(a_diagnosis()))
    tried = table(shown, "Rejected effects")
    fold = shown.page.split("2 other effects were considered and rejected</summary>")[1]
    assert "Rejected effects" in fold.split("</details>")[0]
    assert list(tried.rows) == [
        ["mine", "+5.0", "11\u00a0%", "no likelier with it"],
        ["crosstalk (ipc)", "+0.4", "–", "not seen (0.4 sigma)"],
    ]
    frames = table(shown, "Frames and windows")
    assert frames.rows[0] == [
        "window",
        "rows 0 to 63, columns 10 to 73",
        "rows 0 to 63, columns 10 to 73; rows 70 to 133, columns 0 to 63",
    ]
    assert frames.rows[1] == ["flat", "10 of the frames 0 to 18", "–"]
    assert frames.rows[2] == ["fringes/one", "frames 0 to 99", "frames 100 to 199"]


@pytest.mark.usefixtures("without_figures")
def test_a_cause_names_its_law_and_what_that_closes_where_it_differs() -> None:
    law = "rows exposed while the phase steps"
    for by_law, ends in ((0.5, ". The law alone closes 50\u00a0% of the gap."), (0.79, ".")):
        cause = a_cause(law=law, gap_closed_by_law=by_law)
        shown = diagnosis(contents(a_diagnosis(causes=(cause,))))
        assert f"Law: {law}{ends}" in text_of(shown)
    assert "Law:" not in text_of(diagnosis(contents(a_diagnosis())))
    cause = a_cause(law="", gap_closed_by_law=0.5)
    shown = text_of(diagnosis(contents(a_diagnosis(causes=(cause,)))))
    assert "The law alone closes 50" in shown
    assert "Law:" not in shown


@pytest.mark.usefixtures("without_figures")
def test_a_richer_nominal_bench_is_named() -> None:
    stage = {"stage": "diagnose", "config": {"nominal": {"ipc": {}, "lag": {}}}}
    assert "Included from the start: ipc and lag." in (
        diagnosis(dataclasses.replace(contents(a_diagnosis()), stages=(stage,))).text
    )
    assert "straight fringes" not in diagnosis(contents(a_diagnosis(), frames={"fringes": []})).text


@pytest.mark.usefixtures("without_figures")
def test_effects_that_are_not_told_apart_are_named_with_what_would_decide() -> None:
    cause = a_cause(not_told_apart_from=["ipc", "mine"], would_decide=["dark frames", "flats"])
    shown = diagnosis(contents(a_diagnosis(causes=(cause,))))
    assert table(shown, "Causes").rows[0][-1] == "ipc or mine"
    words = (
        "The data cannot distinguish it from crosstalk (ipc) or mine. "
        "Recommended frames: dark frames and flats."
    )
    assert words in text_of(shown)


# The map of where


def a_map(sigma: float, after: float) -> dict[str, Any]:
    """Sixteen cells of which the third of the second row is off."""
    curve = a_curve(domain="space", sigma=sigma, after=after, values=16, x_label="cell of 4 × 4")
    return curve | {k: list(np.roll(curve[k], 7)) for k in ("z", "z_after")}


def test_the_map_shows_the_cell_that_is_off_where_it_lies() -> None:
    (panel,) = maps.panels((70, 90), (), [a_map(8.0, 1.0), a_map(1.0, 0.5), a_curve()])
    assert len(panel.spots) == 16
    (off,) = panel.spots[panel.spots[:, 4] > 1].tolist()
    assert off == [17.5, 35.0, 45.0, 67.5, 8.0, 1.0]
    drawn = [
        picture(maps.where_figure((70, 90), [panel], with_after=after)) for after in (False, True)
    ]
    assert drawn[1].shape[0] > 1.5 * drawn[0].shape[0]
    reddish = (drawn[0][..., 0].astype(int) - drawn[0][..., 2]) > 90
    rows, columns = np.nonzero(reddish)
    assert 0.5 < np.median(rows) / drawn[0].shape[0] < 0.8, "y is upwards, as in the maps"
    assert 0.5 < np.median(columns) / drawn[0].shape[1] < 0.85


def test_windows_of_a_large_detector_are_drawn_where_they_are_and_large_enough() -> None:
    places = [
        {"window": [[0, 128], [5248, 5376]], "domains": {"space": [9.0, 0.4], "noise": [0.5, 0.3]}},
        {"window": [[8192, 8320], [0, 128]], "domains": {"space": [2.0, 0.1], "noise": [1.0, 0.2]}},
    ]
    (panel,) = maps.panels((8320, 5456), places, [a_map(50.0, 50.0)])
    assert panel.title == "space"
    for spot in panel.spots.tolist():
        for (first, last), whole, least in ((spot[:2], 8320, 1000), (spot[2:4], 5456, 600)):
            start, size = maps._shown(first, last, whole)
            assert size > least
            assert start <= first <= last <= start + size <= whole


@pytest.mark.usefixtures("without_figures")
def test_a_gap_that_is_of_no_place_has_no_map() -> None:
    found = a_diagnosis(curves=(a_curve(), a_map(2.0, 1.0)))
    found.facts["looked_at"]["shape"] = [70, 90]
    assert "Where on the detector" not in text_of(diagnosis(contents(found)))
    found = a_diagnosis(curves=(a_curve(), a_map(9.0, 1.0)))
    found.facts["looked_at"]["shape"] = [70, 90]
    assert "Where on the detector" in text_of(diagnosis(contents(found)))


# Places of curves


def test_names_of_places_are_those_of_the_battery() -> None:
    def name(dy: int, dx: int) -> str:
        parts = [
            f"{axis}{'+' if d > 0 else '−'}{abs(d)}" for axis, d in (("x", dx), ("y", dy)) if d
        ]
        return " ".join(parts)

    curve = {"x_label": "neighbour", "x": list(range(len(STEPS)))}
    assert places(curve) == [name(*step) for step in STEPS]
    limits = [*(-x for x in OUTLIERS), *OUTLIERS]
    outliers = places({"x_label": "sigma, low then high", "x": limits})
    assert outliers == [f"{v:+.0f}".replace("-", "−") for v in limits]
    assert set(diagnosis_words._AXES) <= {s.x_label for s in known_statistics().values()}
    assert diagnosis_words.DETECTOR == DETECTOR


def test_no_word_of_an_axis_is_cut_off_in_a_figure() -> None:
    for axis in diagnosis_words._AXES.values():
        assert len(axis.label) <= figures.LABEL
        assert max(map(len, axis.names), default=0) <= figures.NAME


@pytest.mark.parametrize(
    ("label", "x", "words"),
    [
        ("cycles a pixel", [0.25, 0.5], "periods of 2.0 px"),
        ("cycles a frame", [0.1, 0.4], "periods of 2.5 frames"),
        ("period, rows", [2.0, 4.0], "every 4 rows"),
        ("frames before", [1.0, -2.0], "frame t+2"),
        ("harmonic (cosine, sine)", [1.0, 2.25], "sin 2ψ"),
        ("quantile", [0.5, 0.999], "99.9 % quantile"),
        ("left, right, above, below", [0.0, 1.0], "neighbour x+1"),
        ("", [0.0, 1.0], "1"),
        ("own label", [0.0, 0.125], "own label 0.125"),
    ],
)
def test_places_are_in_words(label: str, x: list[float], words: str) -> None:
    assert place({"x_label": label, "x": x}, 1) == words


def test_a_curve_of_one_value_is_of_all_frames() -> None:
    assert place({"x_label": "", "x": [0.0]}, 0) == "all frames"


# Figures


def picture(figure: Any) -> Any:
    return np.asarray(Image.open(io.BytesIO(png(figure))).convert("RGB"))


@pytest.mark.quick(2)
@pytest.mark.parametrize(
    "changes",
    [
        {"values": 1, "x": [0.3], "x_label": "cycles a pixel"},
        {"values": 5, "x": [0.01, 0.02, 0.1, 0.2, 0.5], "x_label": "cycles a frame"},
        {"values": 40},
        {"kind": "linear", "sigma": -9.0, "unit": "px"},
        {"sigma": 1e6, "unit": NASTY},
        {"title": NASTY * 3, "of": NASTY, "x_label": NASTY},
        {"measured": [1.0, math.nan], "z": [0.0, math.inf]},
        {"measured": [0.0, 0.0], "kind": "linear"},
    ],
)
@pytest.mark.filterwarnings("ignore:Glyph:UserWarning")
def test_any_curve_becomes_a_picture(changes: dict[str, Any]) -> None:
    drawn = picture(curves_figure([a_curve(**changes)]))
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 20


@pytest.mark.filterwarnings("ignore:Glyph:UserWarning")
def test_bars_are_as_long_as_their_shares() -> None:
    def lengths(before: float, after: float) -> tuple[int, int]:
        bars = [Bar("all", 1.0, 0.0), Bar(NASTY, before, after)]
        closed = {"gap_closed": 0.5, "gap_closed_interval": [0.4, 0.6], "gain_over_rest": 0.2}
        drawn = picture(gap_figure(bars, {NASTY: closed})).astype(int)
        left = drawn[:, : drawn.shape[1] // 2]
        half = left[left.shape[0] // 3 :][: left.shape[0] // 3]  # the lower row of bars
        red, blue = half[..., 0] - half[..., 2] > 40, half[..., 2] - half[..., 0] > 90
        return int(red.sum(axis=1).max()), int(blue.sum(axis=1).max())

    whole = lengths(1.0, 1.0)
    red, blue = lengths(0.5, 0.25)
    assert red / whole[0] == pytest.approx(0.5, abs=0.04)
    assert blue / whole[1] == pytest.approx(0.25, abs=0.04)


@pytest.mark.filterwarnings("ignore:Glyph:UserWarning")
def test_hostile_text_is_shown_as_it_is_and_does_nothing() -> None:
    cause = a_cause(
        NASTY,
        title=NASTY,
        why=NASTY,
        not_told_apart_from=[NASTY],
        would_decide=[NASTY],
        parameters={NASTY: NASTY, "list": [{NASTY: NASTY}]},
    )
    curves = (a_curve("lines", title=NASTY), a_curve("b", of=NASTY, domain=NASTY, x_label=NASTY))
    found = a_diagnosis(
        causes=(cause,),
        curves=curves,
        domains={NASTY: [0.6, 0.0], "noise": [0.4, 0.0]},
        absolute=[
            {"quantity": NASTY, "unit": NASTY, "measured": 1.0, "simulated": 2.0, "after": 1.0}
        ],
    )
    found.facts["candidates"][0] |= {"effect": NASTY, "rejected_because": NASTY}
    page = render(contents(found))
    assert "<script" not in page
    shown = html.unescape(re.sub(r"<[^>]*>", " ", page))
    assert shown.count("<script>alert('") > 8
    assert 'alt="Evidence for &lt;script&gt;' in page


def test_shares_have_no_digits_that_mean_nothing() -> None:
    assert percent(1.4e-7) == percent(0.0) == "0\u00a0%"
    assert percent(0.00451) == "0.45\u00a0%"
    assert with_interval(0.99612, [0.8618, 1.0]) == "100\u00a0% [86, 100]"
    assert with_interval(2e-7, [0.0, 3e-6]) == "0\u00a0% [0, 0]"
