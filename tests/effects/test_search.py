"""The search for causes, in a world of a few curves where effects do what the test says."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
import pytest

from pixcal.estimators.test_statistics import Curve, Key
from pixcal.estimators.test_statistics.expectation import Reference, signature_key
from pixcal.estimators.test_statistics.gap import compare, flagged
from pixcal.model.arrays import F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import DOMAINS, Effect, Estimate, Stage
from pixcal.stages.diagnose.benches import CONFIRM_SIMULATIONS, SCREEN_SIMULATIONS, SIMULATIONS
from pixcal.stages.diagnose.candidates import Candidate, SearchResult
from pixcal.stages.diagnose.comparison import Comparison, Trial, differing, gap_interval, shrinkage
from pixcal.stages.diagnose.rejection import doubtful, unhelpful
from pixcal.stages.diagnose.search import MAX_CAUSES, Search
from pixcal.stages.diagnose.thresholds import MIN_LOGLIK_GAIN, MIN_LOGLIK_GAIN_WEAK

KEYS: tuple[Key, ...] = (
    ("harmonics", "a"),
    ("neighbours", "a"),
    ("frames_before", "a"),
    ("residual_by_level", "a"),
    ("bits", "a"),
    ("contrast_fringes", "a"),
)
SIZE = 5
NOISE = 1e-3


@dataclass(frozen=True)
class Toy(Effect):
    """Moves some curves by ``size`` times a pattern."""

    name = "toy"
    title = "a toy"
    acts_at = Stage.LIGHT
    domains = DOMAINS
    strengths = ("size",)
    sources = ("the test",)

    label: str = quantity("toy", doc="its name here")
    size: float = quantity(1.0, doc="of the pattern")


PATTERNS: Mapping[str, Mapping[int, float]] = {
    "left": {0: 1.0, 1: 0.5},
    "right": {2: 1.0, 3: -0.5},
    "mimic": {0: 1.0, 1: 0.5, 4: 1.0},
    "unknown": {2: 1.0, 3: 1.0, 4: 1.0, 5: 1.0, 1: 1.0},
    "little": {5: 1.0},
    "more": {4: 1.0, 5: 1.0},
    "weak": {5: 1.0},
    "left, measured": {0: 1.0, 1: 0.5, 5: 10.0},
    "curve": {0: 1.0, 1: 0.5, 2: 1 / 3, 3: -1 / 6, 4: 0.5},
    **{f"single {row}": {row: 1.0} for row in range(len(KEYS))},
}
SINGLE = tuple(f"single {row}" for row in range(len(KEYS)))
"""Effects that move a curve each; one more than are taken."""


def curves(
    effects: Sequence[Effect], seed: int, sizes: Mapping[str, float] = {}
) -> dict[Key, Curve]:
    rng = np.random.default_rng(seed)
    values = NOISE * rng.standard_normal((len(KEYS), SIZE))
    on = {e.label: e.size for e in effects if isinstance(e, Toy)} | dict(sizes)
    for label, size in on.items():
        for row, weight in PATTERNS[label].items():
            values[row] += size * weight * np.linspace(0.5, 1.5, SIZE)
    return {
        key: Curve(np.arange(SIZE, dtype=float), v) for key, v in zip(KEYS, values, strict=True)
    }


REFERENCE = Reference.of([curves((), seed) for seed in range(16)])


def simulate(
    benches: Sequence[Sequence[Effect]], seeds: int, _: str, asked: Sequence[str]
) -> list[list[dict[Key, Curve]] | str]:
    return [
        "not on this bench"
        if any(isinstance(e, Toy) and e.size < 0 for e in bench)
        else [curves(bench, seed) for seed in range(seeds)]
        for bench in benches
    ]


def candidate(label: str, size: float, sigmas: float = 50.0) -> Candidate:
    effect = Toy(label, size)
    object.__setattr__(effect, "name", label)
    return Candidate(label, Estimate(effect, {"size": 0.01 * size}, sigmas, "told"))


def search(
    truth: Mapping[str, float],
    candidates: Sequence[Candidate],
    mimicked: Mapping[str, float] | None = None,
    seed: int = 500,
) -> tuple[SearchResult, float]:
    data = REFERENCE.on_scale(curves((), seed, truth))
    found = Search(REFERENCE, data, simulate, lambda *_: mimicked or {}).run(
        {c.name: c for c in candidates}
    )
    where = differing(found.nominal, found.final, data)
    return found, shrinkage(data, found.nominal, found.final, where).gap.total


def noted(
    data: Mapping[Key, F64], candidates: Mapping[str, Candidate]
) -> tuple[SearchResult, list[str]]:
    """Result of a search, and the label of each bench that it simulated."""
    labels: list[str] = []

    def noting(
        benches: Sequence[Sequence[Effect]], seeds: int, label: str, asked: Sequence[str]
    ) -> list[list[dict[Key, Curve]] | str]:
        labels.extend([label] * len(benches))
        return simulate(benches, seeds, label, asked)

    return Search(REFERENCE, data, noting, lambda *_: {}).run(candidates), labels


def test_what_is_there_is_taken_and_what_is_not_is_left() -> None:
    found, left = search({"left": 0.03}, [candidate("left", 0.0301), candidate("right", 0.03)])
    assert found.accepted == ("left",)
    assert left < 0.05
    assert found.candidates["right"].reason == "does not improve the fit of the held-out frames"


@dataclass(frozen=True)
class ToyOfMaps(Toy):
    """Shows in static maps alone."""

    domains = ("space",)


def test_what_maps_may_have_by_chance_is_not_taken_for_an_effect() -> None:
    """Held-out frames have the same offsets, so a pattern must be beyond chance by itself."""
    weak, strong = 1.7e-3, 1e-2
    for kind, size, accepted in (
        (Toy, weak, ("unknown",)),
        (ToyOfMaps, weak, ()),
        (ToyOfMaps, strong, ("unknown",)),
    ):
        effect = kind("unknown", size)
        object.__setattr__(effect, "name", "unknown")
        one = Candidate("unknown", Estimate(effect, {"size": size / 5}, 5.0, "told"))
        found, _ = search({"unknown": size}, [one])
        assert found.accepted == accepted


@pytest.mark.parametrize(("sigmas", "counts"), [(2.8, False), (6.0, True)])
def test_of_an_effect_in_maps_its_own_significance_must_differ(sigmas: float, counts: bool) -> None:
    """Not as the worst of all statistics: those that share its pattern add nothing."""
    own = signature_key("unknown", "space")
    rng = np.random.default_rng(1)

    def seen(size: float) -> dict[Key, Curve]:
        every = {key: rng.standard_normal(1) for key in (own, *KEYS)}
        every[own] += size
        every[KEYS[0]] += min(size, 2.5)
        return {key: Curve(np.zeros(1), value) for key, value in every.items()}

    reference = Reference.of([seen(0.0) for _ in range(16)])
    center = {key: Curve(np.zeros(1), v.mean(axis=0)) for key, v in reference.values.items()}
    center[own] = Curve(np.zeros(1), center[own].value + sigmas * reference.values[own].std(ddof=1))
    world = Comparison(reference, reference.on_scale(center))
    trial = world.trial((), [seen(sigmas) for _ in range(3)])
    assert (world.gain_where_differing(world.nominal, trial, own) > 2) == counts


def test_two_effects_are_both_found_in_any_order() -> None:
    both = [candidate("left", 0.03), candidate("right", 0.01), candidate("little", 0.02)]
    results = [search({"left": 0.03, "right": 0.01}, order) for order in (both, both[::-1])]
    for found, left in results:
        assert set(found.accepted) == {"left", "right"}
        assert left < 0.05
        assert set(found.without) == {"left", "right"}
    assert results[0][1] == pytest.approx(results[1][1])


@pytest.mark.parametrize("truth", [{"left": 0.03, "right": 0.01}, {"curve": 0.03}])
def test_two_effects_are_found_that_a_curve_takes_up_together(truth: Mapping[str, float]) -> None:
    """Neither adds to the curve; both together in its place leave less."""
    sizes = {"curve": 0.03, "left": 0.03, "right": 0.01, "little": 0.02}
    found, left = search(truth, [candidate(label, size) for label, size in sizes.items()])
    assert set(found.accepted) == set(truth)
    assert left < 0.05
    if "curve" not in truth:
        told = found.candidates["curve"].reason
        assert told == "left and right together explain the held-out frames better"
        assert set(found.without) == set(truth)


def test_a_curve_stays_where_no_two_others_leave_less() -> None:
    sizes = {"curve": 0.03, "left": 0.03, "little": 0.02}
    found, _ = search(
        {"left": 0.03, "right": 0.01}, [candidate(label, size) for label, size in sizes.items()]
    )
    assert found.accepted == ("curve",)


@pytest.mark.parametrize("truth", [{"left": 0.03, "right": 0.01}, {"curve": 0.03}])
def test_a_curve_is_measured_again_without_what_it_takes_up(truth: Mapping[str, float]) -> None:
    """It adds nothing to what it took up: each is measured on frames without the other."""
    alone = {name: truth.get(name, 0.0) for name in ("left", "right")}

    def measure(name: str, without: Sequence[Effect]) -> Estimate | None:
        assert [e.name for e in without] == ["right" if name == "curve" else "curve"]
        label = "left" if name == "curve" else name
        effect = Toy(label, alone[label])
        object.__setattr__(effect, "name", name)
        return Estimate(effect, {"size": 1e-4}, 50.0, "told")

    data = REFERENCE.on_scale(curves((), 500, truth))
    named = {c.name: c for c in (candidate("curve", 0.03), candidate("right", 0.012))}
    found = Search(REFERENCE, data, simulate, lambda *_: {}, measure=measure).run(named)
    assert found.accepted == (("curve", "right") if len(truth) > 1 else ("curve",))
    assert found.candidates["curve"].reason == ""
    where = differing(found.nominal, found.final, data)
    assert shrinkage(data, found.nominal, found.final, where).gap.total < 0.05


def test_of_two_that_are_alike_the_one_that_opens_no_gap_is_taken() -> None:
    found, _ = search(
        {"left": 0.03}, [candidate("mimic", 0.03), candidate("left", 0.03)], {"mimic": 49.0}
    )
    assert found.accepted == ("left",)
    assert found.candidates["mimic"].reason == "explained by left, which has a similar signature"


def test_effects_that_no_unseen_frame_tells_apart_are_named_together() -> None:
    twin = candidate("left", 0.03)
    object.__setattr__(twin, "name", "twin")
    assert twin.estimate is not None
    object.__setattr__(twin.estimate.effect, "name", "twin")
    found, _ = search({"left": 0.03}, [candidate("left", 0.03), twin], {"left": 50.0, "twin": 50.0})
    (first,) = found.accepted
    other = {"left": "twin", "twin": "left"}[first]
    assert found.alike == {first: (other,)}


def test_an_effect_below_its_threshold_is_not_tried() -> None:
    """Where nothing differs 4 standard deviations are asked for; where there is a gap 1.5 beside a
    candidate that is sure, 1 beside others that are not."""
    found, _ = search({}, [candidate("left", 2 * NOISE, sigmas=3.9)])
    assert "3.9 sigma" in found.candidates["left"].reason
    assert found.candidates["left"].alone is None
    found, _ = search({"left": 0.03}, [candidate("left", 0.03, 1.4), candidate("right", 0.03, 4.1)])
    assert not found.accepted
    assert "1.4 sigma" in found.candidates["left"].reason
    found, _ = search({"left": 0.03}, [candidate("left", 0.03, 0.9), candidate("right", 0.03, 3.9)])
    assert not found.accepted
    assert "0.9 sigma" in found.candidates["left"].reason


def test_where_no_candidate_is_sure_the_fainter_one_may_be_the_cause() -> None:
    found, _ = search({"left": 0.03}, [candidate("left", 0.03, 1.1), candidate("mimic", 0.03, 2.0)])
    assert found.accepted == ("left",)
    assert not found.alike


@pytest.mark.parametrize("sigmas", [50.0, 1.6])
def test_one_that_does_as_well_alone_and_nothing_beside_is_not_told_apart(sigmas: float) -> None:
    """However little its own estimate says of what the other brings about in it."""
    twin = candidate("left", 0.03, sigmas)
    object.__setattr__(twin, "name", "twin")
    assert twin.estimate is not None
    object.__setattr__(twin.estimate.effect, "name", "twin")
    found, _ = search({"left": 0.03}, [candidate("left", 0.03, sigmas), twin], {})
    (first,) = found.accepted
    assert found.alike == {first: ({"left": "twin", "twin": "left"}[first],)}


def test_once_nothing_differs_only_what_is_sure_is_tried() -> None:
    tried: list[frozenset[str]] = []

    def noted(
        benches: Sequence[Sequence[Effect]], seeds: int, label: str, asked: Sequence[str]
    ) -> list[list[dict[Key, Curve]] | str]:
        tried.extend(frozenset(e.label for e in b if isinstance(e, Toy)) for b in benches)
        return simulate(benches, seeds, label, asked)

    def sought(sigmas: float, mimicked: float) -> SearchResult:
        tried.clear()
        one, other = candidate("left", 0.03), candidate("right", 2 * NOISE, sigmas)
        data = REFERENCE.on_scale(curves((), 500, {"left": 0.03}))
        found = Search(REFERENCE, data, noted, lambda *_: {"right": mimicked})
        return found.run({"left": one, "right": other})

    assert sought(9.0, 0.0).accepted == ("left",)
    assert frozenset({"left", "right"}) in tried
    for sigmas, mimicked in ((3.0, 0.0), (9.0, 6.0)):
        found = sought(sigmas, mimicked)
        assert found.accepted == ("left",)
        assert frozenset({"left", "right"}) not in tried
        assert "once left is included (3.0 sigma)" in found.candidates["right"].reason


def test_what_will_be_estimated_again_is_asked_for_when_a_bench_is_confirmed() -> None:
    """So that both can be done side by side."""
    asked: list[tuple[tuple[Effect, ...], tuple[str, ...]]] = []
    estimated: list[tuple[tuple[Effect, ...], tuple[str, ...]]] = []

    def noted(
        benches: Sequence[Sequence[Effect]], seeds: int, label: str, names: Sequence[str]
    ) -> list[list[dict[Key, Curve]] | str]:
        if names:
            asked.append((tuple(benches[0]), tuple(names)))
        return simulate(benches, seeds, label, names)

    def estimates(effects: tuple[Effect, ...], names: Sequence[str]) -> dict[str, float]:
        estimated.append((effects, tuple(names)))
        return {}

    data = REFERENCE.on_scale(curves((), 500, {"left": 0.03, "right": 0.02}))
    made = [candidate("left", 0.03), candidate("right", 0.02), candidate("little", 0.02)]
    found = Search(REFERENCE, data, noted, estimates).run({c.name: c for c in made})
    assert set(found.accepted) == {"left", "right"}
    assert len(estimated) == 2
    assert asked == estimated


def test_an_effect_that_is_only_hinted_at_passes_a_higher_mark() -> None:
    found, left = search({"left": 0.03}, [candidate("left", 0.03, sigmas=2.0)])
    assert found.accepted == ("left",)
    assert left < 0.05
    weak = {"left": 0.004}
    found, _ = search(weak, [candidate("left", 0.004, sigmas=2.0)])
    sure, _ = search(weak, [candidate("left", 0.004, sigmas=20.0)])
    gain = sure.final.log_likelihood - sure.nominal.log_likelihood
    assert sure.accepted == ("left",)
    assert (found.accepted == ("left",)) == (gain >= MIN_LOGLIK_GAIN_WEAK)


@pytest.mark.parametrize("size", [0.006, 0.04])
def test_a_stand_in_for_an_unknown_cause_is_not_claimed(size: float) -> None:
    """It makes the data likelier, but little of the gap is closed beside what stays open."""
    found, left = search({"unknown": 0.05, "little": 0.004}, [candidate("little", size)])
    assert not found.accepted
    assert left == pytest.approx(1, abs=0.02)
    assert "stays open" in found.candidates["little"].reason


def test_where_all_candidates_close_little_the_search_ends_with_the_first_round() -> None:
    """Beside a large unknown cause no set of them could be claimed, so none is confirmed."""
    small = {"left": 0.005, "little": 0.006, "right": 0.0}
    data = REFERENCE.on_scale(curves((), 500, small | {"unknown": 0.05}))
    named = {label: candidate(label, size or 0.001) for label, size in small.items()}
    found, asked = noted(data, named)
    assert not found.accepted
    assert set(asked) == {"candidates, round 1", "all candidates"}
    assert asked.count("all candidates") == 1
    assert "stays open" in found.candidates["left"].reason
    assert all(one.reason for one in found.candidates.values())
    assert all(one.alone is not None for one in found.candidates.values())


def test_candidates_that_close_much_together_are_sought_further(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each alone closes little, as when it only undoes what another one opens."""
    monkeypatch.setattr(
        Comparison, "residual", lambda _, trial, *__: 0.1 if len(trial.effects) == 2 else 0.95
    )
    monkeypatch.setattr(Comparison, "settles", lambda *_: False)
    truth = {"left": 0.03, "right": 0.03}
    named = {label: candidate(label, size) for label, size in truth.items()}
    _, asked = noted(REFERENCE.on_scale(curves((), 500, truth)), named)
    assert "all candidates" in asked
    assert "candidates, round 2" in asked


@pytest.mark.parametrize(
    ("true", "beside", "kind", "replayed", "claimed"),
    [
        ("right", {}, Toy, False, True),
        ("right", {"single 1": 0.02}, Toy, False, True),
        ("right", {"single 3": 0.02}, Toy, False, False),
        ("single 2", {}, Toy, False, False),
        ("right", {}, Toy, True, False),
        ("right", {}, ToyOfMaps, False, False),
    ],
    ids=["one other", "two others", "what it changes too", "one missing", "replay", "static maps"],
)
def test_a_cause_is_judged_by_what_it_changes(
    true: str, beside: Mapping[str, float], kind: type[Toy], replayed: bool, claimed: bool
) -> None:
    """However little of the gap that is, if frames agree with all of it that could refute it."""
    effect = kind("right", 0.02)
    object.__setattr__(effect, "name", "right")
    one = Candidate("right", Estimate(effect, {"size": 2e-4}, 50.0, "told"))
    one.replay = effect if replayed else None
    found, left = search({true: 0.02, "single 5": 0.2} | dict(beside), [one])
    assert found.accepted == (("right",) if claimed else ())
    assert left > 0.5


@pytest.mark.parametrize("confirmed", [False, True])
def test_a_law_that_maps_confirm_is_named_beside_an_unknown_cause(confirmed: bool) -> None:
    """Though that changes the same statistics, and others imitate both better."""
    effect = ToyOfMaps("right", 0.02)
    object.__setattr__(effect, "name", "right")
    one = Estimate(effect, {"size": 2e-4}, 50.0, "told", law_predicts=confirmed)
    found, left = search(
        {"right": 0.02, "single 3": 0.02, "single 4": 0.2},
        [Candidate("right", one), candidate("unknown", 0.02), candidate("curve", 0.03)],
    )
    assert found.accepted == (("right",) if confirmed else ())
    assert left > 0.5


@pytest.mark.parametrize("more", [False, True])
def test_its_own_significance_alone_supports_no_cause(more: bool) -> None:
    """Fitted and held-out frames agree in it, whatever the true cause."""
    own, rng = signature_key("toy", "time"), np.random.default_rng(1)

    def seen(size: float) -> dict[Key, Curve]:
        added = {own: size, KEYS[0]: size * more, KEYS[1]: 0.0}
        return {k: Curve(np.zeros(1), rng.standard_normal(1) + of) for k, of in added.items()}

    reference = Reference.of([seen(0.0) for _ in range(16)])
    world = Comparison(reference, reference.on_scale(seen(20.0)))
    trial = world.trial((Toy(),), [seen(20.0) for _ in range(8)])
    assert world.settles(own, world.nominal, trial) == more


def test_causes_that_only_compensate_each_other_are_no_explanation() -> None:
    comparison = Comparison(REFERENCE, REFERENCE.on_scale(curves((), 500, {"single 2": 0.02})))

    def trial(*effects: Effect) -> Trial:
        return comparison.trial(effects, [curves(effects, seed) for seed in range(8)])

    true, one, other = Toy("single 2", 0.02), Toy("single 2", 0.05), Toy("right", -0.05)
    own = signature_key("toy", "time")
    assert comparison.settles(own, comparison.nominal, trial(true))
    assert not comparison.settles(own, trial(one), trial(one, other))


@pytest.mark.parametrize(("made", "accepted"), [(2.0, ("left", "weak")), (20.0, ("left",))])
def test_chance_in_the_simulation_of_a_cause_takes_nothing_from_a_second(
    made: float, accepted: tuple[str, ...]
) -> None:
    """5 sigma, less 2 by chance, had not been enough."""
    truth, own = {"left": 0.03, "weak": 0.003}, [candidate("left", 0.03)]
    found, _ = search(truth, [*own, candidate("weak", 0.003, sigmas=5.0)], {"weak": made})
    assert found.accepted == accepted


def test_a_small_remainder_of_what_another_cause_brings_about_is_not_claimed() -> None:
    both = [candidate("left", 0.03), candidate("little", 0.003)]
    truth = {"left": 0.03, "little": 0.003}
    alone, _ = search(truth, both)
    assert alone.accepted == ("left", "little")
    beside, _ = search(truth, both, {"little": 20.0})
    assert beside.accepted == ("left",)
    assert "40 % of its significance" in beside.candidates["little"].reason


def test_a_small_remainder_that_only_the_held_out_frames_show_is_not_claimed() -> None:
    truth = {"left": 0.03, "right": 0.03, "little": 0.0048}
    strong = [candidate("left", 0.03), candidate("right", 0.03), candidate("little", 0.0048)]
    assert set(search(truth, strong)[0].accepted) == {"left", "right", "little"}
    weak, left = search(truth, [*strong[:2], candidate("little", 0.0048, sigmas=2.8)])
    assert set(weak.accepted) == {"left", "right"}
    assert left < 0.15
    assert "not significant (2.8 sigma) in" in weak.candidates["little"].reason


@pytest.mark.parametrize(
    ("open_still", "closed", "claimed"),
    [
        (0.1, 0.01, False),
        (0.1, 0.03, True),
        (0.02, 0.01, True),
        (0.3, 0.2, False),
        (0.3, 0.4, True),
    ],
)
def test_a_cause_that_closes_much_less_than_stays_open_is_not_claimed(
    monkeypatch: pytest.MonkeyPatch, open_still: float, closed: float, claimed: bool
) -> None:
    """However significant: it may be a proxy for deviations of the first from its law.

    Of a large gap, it must close more than stays open, and not by its own significance.
    """
    comparison = Comparison(REFERENCE, REFERENCE.on_scale(curves((), 500)))
    both, without = (replace(comparison.nominal, log_likelihood=n) for n in (1.0, 0.0))
    left = {both.log_likelihood: open_still, without.log_likelihood: open_still + closed}

    def residual(trial: Trial, _: object, apart: Set[Key] = frozenset()) -> float:
        own = open_still > 0.15 and not apart and trial is without
        return left[trial.log_likelihood] + own

    monkeypatch.setattr(comparison, "residual", residual)
    rejected = doubtful(comparison, both, {"little": without}, {"little": candidate("little", 1.0)})
    assert (rejected is None) == claimed
    assert claimed or "stays open" in rejected[1]


@pytest.mark.parametrize(
    ("open_still", "alone", "claimed"), [(0.5, 1.0, False), (0.5, 0.8, True), (0.1, 1.0, True)]
)
def test_two_causes_that_only_make_good_for_each_other_are_not_claimed(
    monkeypatch: pytest.MonkeyPatch, open_still: float, alone: float, claimed: bool
) -> None:
    """Each opens what the other closes, while alone it closes nothing and much stays open."""
    comparison = Comparison(REFERENCE, REFERENCE.on_scale(curves((), 500)))
    both, without, single = (replace(comparison.nominal, log_likelihood=n) for n in (2.0, 1.0, 0.0))
    left = {2.0: open_still, 1.0: 1.0, 0.0: alone}
    monkeypatch.setattr(comparison, "residual", lambda trial, *_: left[trial.log_likelihood])
    named = {name: replace(candidate(name, 1.0), alone=single) for name in ("left", "right")}
    rejected = doubtful(comparison, both, dict.fromkeys(named, without), named)
    assert (rejected is None) == claimed


@pytest.mark.parametrize(
    ("with_both", "without", "alone", "claimed"),
    [(1.1, 1.0, 0.5, False), (0.5, 0.7, 1.0, False), (0.5, 0.7, 0.8, True), (0.1, 0.7, 1.0, True)],
)
def test_a_cause_that_does_not_reduce_the_differences_is_not_claimed(
    monkeypatch: pytest.MonkeyPatch, with_both: float, without: float, alone: float, claimed: bool
) -> None:
    """They may be less significant, as simulations with it scatter more."""
    comparison = Comparison(REFERENCE, REFERENCE.on_scale(curves((), 500)))
    both, fewer, single = (replace(comparison.nominal, log_likelihood=n) for n in (2.0, 1.0, 0.0))
    size = {2.0: with_both, 1.0: without, 0.0: alone}
    monkeypatch.setattr(comparison, "residual_size", lambda t, _: size[t.log_likelihood])
    named = {name: replace(candidate(name, 1.0), alone=single) for name in ("left", "right")}
    rejected = unhelpful(comparison, both, dict.fromkeys(named, fewer), named)
    assert (rejected is None) == claimed


def test_candidates_without_promise_are_simulated_once() -> None:
    """The best is simulated further in the round that takes it, the others are not."""
    rounds: list[tuple[int, set[str]]] = []

    def noted(
        benches: Sequence[Sequence[Effect]], seeds: int, label: str, asked: Sequence[str]
    ) -> list[list[dict[Key, Curve]] | str]:
        if label == "candidates, round 1":
            rounds.append((seeds, {e.name for bench in benches for e in bench}))
        return simulate(benches, seeds, label, asked)

    data = REFERENCE.on_scale(curves((), 500, {"left": 0.03}))
    named = {c.name: c for c in (candidate("left", 0.03), candidate("right", 0.03))}
    assert Search(REFERENCE, data, noted, lambda *_: {}).run(named).accepted == ("left",)
    assert rounds == [(1, {"left", "right"}), (SCREEN_SIMULATIONS, {"left"})]
    assert named["right"].alone is not None


def test_a_large_share_of_the_gap_is_claimed_whatever_another_cause_brings_about() -> None:
    both = [candidate("left", 0.03), candidate("right", 0.03)]
    found, _ = search({"left": 0.03, "right": 0.018}, both, {"right": 20.0})
    assert set(found.accepted) == {"left", "right"}


@pytest.mark.parametrize("curve", [0.0300, 0.0302])
def test_of_two_that_gain_alike_the_one_that_does_so_by_its_law_is_taken(curve: float) -> None:
    """A measured curve that imitates it may gain a little more."""
    true, other = candidate("left", 0.0301), candidate("left", curve)
    for one in (other, other.estimate.effect):  # type: ignore[union-attr]
        object.__setattr__(one, "name", "other")
    assert other.estimate is not None
    poor = replace(other.estimate.effect, size=0.02)
    other.estimate = replace(other.estimate, law="a poor one", by_law=poor)
    found, _ = search({"left": 0.03}, [other, true], {"left": 50.0, "other": 50.0})
    assert found.accepted == ("left",)
    assert found.alike == {"left": ("other",)}


def test_a_law_is_taken_that_is_likelier_than_the_curve_that_was_measured() -> None:
    """Errors of a curve add up to a difference that the law does not have."""
    curve, law = Toy("left, measured", 0.03), Toy("left", 0.0301)
    for way in (curve, law):
        object.__setattr__(way, "name", "left")
    left = Candidate("left", Estimate(curve, {}, 50.0, "told", law="a good one", by_law=law))
    for true, taken in (("left", law), ("left, measured", curve)):
        found, rest = search({true: 0.03}, [replace(left)])
        assert found.final.effects == (taken,)
        assert rest < 0.05


def test_of_a_vague_law_and_its_replay_the_one_that_leaves_less_of_the_gap_is_taken() -> None:
    data = REFERENCE.on_scale(curves((), 500, {"left": 0.03}))
    judged = Comparison(REFERENCE, data)
    replay = judged.trial((Toy("left", 0.0288),), [curves((Toy("left", 0.0288),), 0)])
    vague = replace(
        replay.expected,
        mean={key: 0.75 * mean for key, mean in data.items()},
        variance={key: 4 * v for key, v in judged.nominal.expected.variance.items()},
    )
    law = replace(replay, expected=vague, log_likelihood=replay.log_likelihood + 1)
    assert judged.replay_fits_better(replay, law)


def test_a_replay_that_is_likelier_than_the_law_is_taken() -> None:
    law = candidate("left", 0.022)
    law.replay = candidate("left", 0.03).estimate.effect  # type: ignore[union-attr]
    found, left = search({"left": 0.03}, [law])
    assert found.final.effects == (law.replay,)
    assert left < 0.05
    assert found.by_law["left"].effects == (law.estimate.effect,)  # type: ignore[union-attr]


def test_a_replay_is_taken_whose_law_is_without_promise() -> None:
    wrong, other = candidate("left", 0.1), candidate("little", 0.002)
    wrong.replay = candidate("left", 0.03).estimate.effect  # type: ignore[union-attr]
    found, left = search({"left": 0.03, "little": 0.002}, [wrong, other])
    assert found.accepted[0] == "left"
    assert found.final.effects[0] == wrong.replay
    assert left < 0.05


def test_where_a_replay_is_not_enough_all_candidates_are_told_so() -> None:
    """It may gain enough for a law, but not for a replay; the others have no promise."""
    wrong, other = candidate("left", 0.1), candidate("right", 0.03)
    wrong.replay = candidate("left", 0.003).estimate.effect  # type: ignore[union-attr]
    found, _ = search({"left": 0.003}, [wrong, other])
    assert not found.accepted
    assert all(c.reason for c in found.candidates.values())


@pytest.mark.parametrize(
    ("companion", "accepted"), [("little", ("left",)), ("more", ("more", "left"))]
)
def test_a_second_cause_needs_what_the_first_one_as_measured_does_not_bring_about(
    companion: str, accepted: tuple[str, ...]
) -> None:
    truth = {"left": 0.003, companion: 0.03}
    left = replace(candidate("left", 0.003), replay=Toy("left, measured", 0.003))
    object.__setattr__(left.replay, "name", "left")
    found, gap = search(truth, [left, candidate(companion, 0.03)])
    assert found.accepted == accepted
    assert gap < 0.05
    if accepted == ("left",):
        assert found.candidates["left"].alone is not None
        assert found.final.effects == (left.replay,)
        assert "left, as measured frame by frame" in found.candidates[companion].reason


def test_a_candidate_that_other_seeds_refuse_is_told_so() -> None:
    def refusing(
        benches: Sequence[Sequence[Effect]], seeds: int, label: str, asked: Sequence[str]
    ) -> list[list[dict[Key, Curve]] | str]:
        made = simulate(benches, seeds, label, asked)
        refused = [seeds > 1 and any(e.name == "left" for e in bench) for bench in benches]
        return ["too bright" if no else one for no, one in zip(refused, made, strict=True)]

    left = candidate("left", 0.03)
    left.replay = candidate("left", 0.0001).estimate.effect  # type: ignore[union-attr]
    data = REFERENCE.on_scale(curves((), 500, {"left": 0.03}))
    found = Search(REFERENCE, data, refusing, lambda *_: {}).run({"left": left})
    assert found.accepted == ()
    assert found.candidates["left"].reason == "cannot be simulated: too bright"


def test_a_cause_beyond_the_most_is_told_that_no_more_were_sought() -> None:
    truth = dict.fromkeys(SINGLE, 0.03)
    found, _ = search(truth, [candidate(label, 0.03) for label in SINGLE])
    (left_out,) = set(SINGLE) - set(found.accepted)
    assert len(found.accepted) == MAX_CAUSES
    assert "the search stops after" in found.candidates[left_out].reason


@pytest.mark.long
def test_an_effect_that_was_hinted_at_and_not_taken_is_told_so() -> None:
    """Seeds differ in how much likelier the unseen frames get: some lie between the two marks."""
    reasons = {}
    for seed in range(800, 840):
        found, _ = search(
            {"left": 0.03, "little": 0.0035},
            [candidate("left", 0.03), candidate("little", 0.0035, sigmas=3.0)],
            None,
            seed,
        )
        reasons[seed] = found.candidates["little"].reason
    told = [r for r in reasons.values() if "rises by only" in r]
    assert told
    for reason in told:
        gain = float(reason.split("by only ")[1].split(";")[0])
        assert MIN_LOGLIK_GAIN <= gain < MIN_LOGLIK_GAIN_WEAK


def test_each_cause_is_weighed_alone_by_as_many_simulations_as_all_together() -> None:
    benches: dict[frozenset[str], int] = {}

    def noted(
        wanted: Sequence[Sequence[Effect]], seeds: int, label: str, asked: Sequence[str]
    ) -> list[list[dict[Key, Curve]] | str]:
        for bench in wanted:
            name = frozenset(e.label for e in bench if isinstance(e, Toy))
            benches[name] = max(benches.get(name, 0), seeds)
        return simulate(wanted, seeds, label, asked)

    sizes = {"left": 0.03, "right": 0.02, "little": 0.03}
    data = REFERENCE.on_scale(curves((), 500, sizes))
    found = Search(REFERENCE, data, noted, lambda *_: {}).run(
        {label: candidate(label, size) for label, size in sizes.items()}
    )
    assert set(found.accepted) == set(sizes)
    for name in sizes:
        assert benches[frozenset({name})] == CONFIRM_SIMULATIONS


def test_what_opens_elsewhere_widens_the_interval_of_what_is_left() -> None:
    """A stand-in that does what the data do not show."""
    data = REFERENCE.on_scale(curves((), 500, {"left": 0.03}))
    benches = [(candidate("mimic", 0.03).estimate.effect,)]  # type: ignore[union-attr]
    (made,) = simulate(benches, CONFIRM_SIMULATIONS, "", ())
    assert not isinstance(made, str)
    tried = Comparison(REFERENCE, data)
    trial = tried.trial(benches[0], made)
    where = flagged(compare(data, tried.nominal.expected))
    told = shrinkage(data, tried.nominal, trial, where)
    opened = flagged(told.after) - where
    assert opened
    assert told.gap.total > 0.2
    assert gap_interval(data, told, trial)[0] > 0.5 * told.gap.total


def test_where_fewer_effects_are_refused_all_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = simulate

    def fails(
        benches: Sequence[Sequence[Effect]], seeds: int, label: str, asked: Sequence[str]
    ) -> list[list[dict[Key, Curve]] | str]:
        return [
            "not by itself"
            if [e.name for e in bench] == ["right"] and seeds > SCREEN_SIMULATIONS
            else made
            for bench, made in zip(benches, plain(benches, seeds, label, asked), strict=True)
        ]

    monkeypatch.setitem(globals(), "simulate", fails)
    truth = {"left": 0.03, "right": 0.02}
    found, left = search(truth, [candidate(label, size) for label, size in truth.items()])
    assert set(found.accepted) == {e.name for e in found.final.effects}
    assert set(found.without) == set(found.accepted)
    assert left < 0.05


def test_nothing_is_claimed_of_nothing() -> None:
    for seed in range(600, 640):
        found, left = search({}, [candidate(label, 2 * NOISE) for label in PATTERNS], None, seed)
        assert not found.accepted
        assert left == 0


def test_what_cannot_be_simulated_is_said() -> None:
    found, _ = search({"left": 0.03}, [candidate("left", -0.03), candidate("right", 0.03)])
    assert found.candidates["left"].reason == "cannot be simulated: not on this bench"


def test_an_estimate_inflated_by_another_effect_is_scaled_down() -> None:
    """Half of the right effect's estimate is owed to the left one."""
    found, left = search(
        {"left": 0.03, "right": 0.01},
        [candidate("left", 0.03), candidate("right", 0.02)],
        {"right": 25.0},
    )
    assert set(found.accepted) == {"left", "right"}
    sizes = {e.label: e.size for e in found.final.effects if isinstance(e, Toy)}
    assert sizes["right"] == pytest.approx(0.01)
    assert left < 0.05


def test_a_bench_that_fails_only_when_confirmed_costs_its_candidate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first seeds may pass where a later one is refused; the search goes on with the others."""
    plain = simulate

    def fails(
        benches: Sequence[Sequence[Effect]], seeds: int, label: str, asked: Sequence[str]
    ) -> list[list[dict[Key, Curve]] | str]:
        return [
            "no light left" if seeds > 3 and any(e.name == "left" for e in bench) else made
            for bench, made in zip(benches, plain(benches, seeds, label, asked), strict=True)
        ]

    monkeypatch.setitem(globals(), "simulate", fails)
    both = {"left": 0.03, "right": 0.01}
    found, _ = search(both, [candidate(label, size) for label, size in both.items()])
    assert found.accepted == ("right",)
    assert found.candidates["left"].reason == "cannot be simulated: no light left"


def test_a_cause_always_has_a_gap_that_it_closes() -> None:
    for seed in range(700, 730):
        found, left = search({"left": 0.0025}, [candidate("left", 0.0025)], None, seed)
        data = REFERENCE.on_scale(curves((), seed, {"left": 0.0025}))
        assert bool(differing(found.nominal, found.final, data)) >= bool(found.accepted)
        assert left <= 1


def test_a_search_ends_within_its_simulations_and_tells_what_it_has_not_decided() -> None:
    truth = {label: 0.4 / 2**n for n, label in enumerate(SINGLE)}
    data = REFERENCE.on_scale(curves((), 500, truth))
    made: set[tuple[frozenset[Effect], int]] = set()

    def noted(
        benches: Sequence[Sequence[Effect]], seeds: int, label: str, asked: Sequence[str]
    ) -> list[list[dict[Key, Curve]] | str]:
        made.update((frozenset(bench), seed) for bench in benches for seed in range(seeds))
        return simulate(benches, seeds, label, asked)

    spent = []
    for most in (60, 150, SIMULATIONS):
        made.clear()
        named = {label: candidate(label, size, 1e3 * size) for label, size in truth.items()}
        found = Search(REFERENCE, data, noted, lambda *_: {}, most).run(named)
        undecided = [c for c in named.values() if c.reason.startswith("not decided")]
        assert found.accepted
        assert len(made) <= most
        assert len(found.accepted) == MAX_CAUSES or undecided
        spent.append(len(found.accepted))
    assert spent == sorted(set(spent))
