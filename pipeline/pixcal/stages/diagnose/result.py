"""``diagnosis.json`` and the curves behind it, from what a search found."""

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from scipy.special import log_ndtr, ndtr

from pixcal import __version__
from pixcal.estimators.diagnosis.expectation import Expectation, Reference
from pixcal.estimators.diagnosis.gap import Difference, flagged, likelier, sigmas_among, sigmas_of
from pixcal.estimators.diagnosis.test_statistics import DETECTOR, Curve, Key
from pixcal.estimators.diagnosis.test_statistics.signature import statistic_named
from pixcal.model.arrays import F64
from pixcal.model.config import to_plain
from pixcal.report.curve_places import place
from pixcal.simulation.effect import DOMAINS
from pixcal.stages.diagnose.candidates import Candidate, SearchResult
from pixcal.stages.diagnose.comparison import (
    Shrinkage,
    Trial,
    differing,
    gap_interval,
    shrinkage,
)
from pixcal.stages.diagnose.frames_used import FramesUsed
from pixcal.stages.diagnose.recommended_frames import recommend_frames

SCHEMA = "pixcal/diagnosis/1"
EXPLAINED = 0.15  # share of the gap that may be left where it is called explained,
LEFT = 0.25  # and share of any one statistic's that is off by more than
STILL = 6.0  # standard deviations: less can be the simulation of the effects themselves
# statistics told in units of the bench even where nothing differs
ALWAYS = ("allan_of_batches", "offset_by_place", "residual_noise")
MIN_P_VALUE = 1e-12  # smallest that is told: of tails further out nobody knows the shape
SHOWN = 3  # statistics named that gave a cause away


def describe(
    found: SearchResult,
    data: Mapping[Key, F64],
    measured: Mapping[Key, Curve],
    reference: Reference,
    facts: FramesUsed,
    places: Sequence[Mapping[str, Any]] = (),
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The product, and every curve as measured, nominal and with the effects found.

    ``data`` are the curves of the held-out frames on the reference's scales, ``measured`` in their
    own units; ``places`` says how far windows are off by themselves, `by_domain`.
    """
    where = differing(found.nominal, found.final, data)
    final = shrinkage(data, found.nominal, found.final, where)
    verdict = _verdict(found, final)
    curves = _curves(found, final, data, measured, reference)
    by_key = {(c["statistic"], c["set"]): c for c in curves}
    causes = [_cause(name, found, data, where, final, facts) for name in found.accepted]
    diagnosis = {
        "schema": SCHEMA,
        "pixcal": __version__,
        "verdict": verdict,
        "causes": sorted(causes, key=lambda c: -float(c["gap_closed"])),
        "gap": {
            "total": 1.0 if where else 0.0,
            "after": _rounded(final.gap.total),
            "interval": [_rounded(v) for v in gap_interval(data, final, found.final)],
            "domains": {
                domain: [_rounded(v) for v in final.gap.of_domain(domain)] for domain in DOMAINS
            },
            "where": _where(final, by_key),
            "absolute": _absolute(found, final, by_key, reference),
            "places": list(places),
        },
        "candidates": [_candidate(c, found, data, where) for c in found.candidates.values()],
        "more_would_tell": (
            recommend_frames(facts.missing_frames)
            if verdict in ("unexplained", "partly explained")
            else []
        ),
        "statistics": len(final.before),
        "looked_at": to_plain(facts),
    }
    return diagnosis, curves


def by_domain(
    before: Mapping[Key, Difference], after: Mapping[Key, Difference]
) -> dict[str, list[float]]:
    """Standard deviations of the statistic that is furthest off in each domain, before and after.

    Of chance, all statistics of the domain being looked at; at least zero.
    """
    found = {}
    for domain in DOMAINS:
        keys = [k for k in before if statistic_named(k[0]).domain == domain]
        found[domain] = [
            _rounded(sigmas_among(min(one[k].log_chance for k in keys), len(keys))) if keys else 0.0
            for one in (before, after)
        ]
    return found


def _verdict(found: SearchResult, final: Shrinkage) -> str:
    if not final.where:
        return "no gap"
    if not found.accepted:
        return "unexplained"
    still = [
        key
        for key in flagged(final.after)
        if final.gap.left.get(key, 1.0) > LEFT and sigmas_of(final.after[key].log_chance) > STILL
    ]
    return "explained" if final.gap.total <= EXPLAINED and not still else "partly explained"


def _cause(
    name: str,
    found: SearchResult,
    data: Mapping[Key, F64],
    where: set[Key],
    final: Shrinkage,
    facts: FramesUsed,
) -> dict[str, Any]:
    candidate = found.candidates[name]
    estimate = candidate.estimate
    assert estimate is not None
    effect = next(e for e in found.final.effects if e.name == name)
    by_itself = candidate.alone or found.final
    alone = shrinkage(data, found.nominal, by_itself, where)
    without = shrinkage(data, found.nominal, found.without[name], where)
    gain = found.final.log_likelihood - found.without[name].log_likelihood
    by_law = alone
    if name in found.by_law:
        by_law = shrinkage(data, found.nominal, found.by_law[name], where)
    alike = found.alike.get(name, ())
    kinds = [type(e.effect) for n in (name, *alike) if (e := found.candidates[n].estimate)]
    # Two independent parts of the frames, joined by Fisher's rule. A likelihood ratio of e^gain has
    # a chance of at most e^-gain (Markov's inequality).
    own = estimate.significance * candidate.share
    log_both = max(float(log_ndtr(-own)) - max(gain, 0.0), -600.0)
    chance = np.exp(log_both) * (1 - log_both)
    same_samples = facts.shared and not facts.sets and facts.on_the_same_pixels
    if same_samples or candidate.in_maps_alone:
        # Both parts hold the same samples, or the same offsets: the second says nothing new.
        chance = float(ndtr(-own))
    chance *= len(found.candidates) * candidate.ways
    return {
        "effect": name,
        "title": effect.title,
        "about": (inspect.getdoc(effect) or "").partition("\n")[0].replace("`", ""),
        "parameters": to_plain(effect),
        "uncertainty": {k: float(v) for k, v in estimate.errors.items()},
        "units": {f.name: f.metadata.get("unit", "") for f in fields(effect)},
        "meanings": {f.name: f.metadata.get("doc", "") for f in fields(effect)},
        "strengths": list(effect.strengths),
        "law": estimate.law,
        "gap_closed": _closed(alone.gap.total),
        "gap_closed_interval": [_closed(v) for v in reversed(gap_interval(data, alone, by_itself))],
        "gap_closed_by_law": _closed(by_law.gap.total),
        "gain_over_rest": _rounded(without.gap.total - final.gap.total),
        "p_value": float(np.clip(chance, MIN_P_VALUE, 1.0)),
        "sigmas": _rounded(estimate.significance),
        "why": estimate.why,
        "given_away_by": _telling(found.without[name], found.final, data),
        "not_told_apart_from": list(alike),
        "would_decide": recommend_frames(facts.missing_frames, kinds) if alike else [],
    }


def _telling(before: Trial, after: Trial, data: Mapping[Key, F64]) -> list[dict[str, str]]:
    """Statistics that an effect makes most likely, best first."""
    gains = likelier(data, before.expected, after.expected)
    best = sorted(gains, key=lambda k: -gains[k])[:SHOWN]
    return [{"statistic": k[0], "set": k[1]} for k in best if gains[k] > 1]


def _candidate(
    candidate: Candidate, found: SearchResult, data: Mapping[Key, F64], where: set[Key]
) -> dict[str, Any]:
    closed = 0.0
    if candidate.alone is not None and where:
        closed = _closed(shrinkage(data, found.nominal, candidate.alone, where).gap.total)
    about: dict[str, Any] = {
        "effect": candidate.name,
        "gap_closed": _rounded(closed),
        "rejected_because": candidate.reason,
        "tried_on_unseen_frames": candidate.alone is not None,
    }
    if candidate.estimate is not None:
        about |= {
            "sigmas": _rounded(candidate.estimate.significance),
            "parameters": to_plain(candidate.estimate.effect),
        }
    return about


def _curves(
    found: SearchResult,
    final: Shrinkage,
    data: Mapping[Key, F64],
    measured: Mapping[Key, Curve],
    reference: Reference,
) -> list[dict[str, Any]]:
    """Every statistic: measured, nominal and with effects, with limits of one sigma."""
    curves = []
    for key, before in final.before.items():
        one = statistic_named(key[0])
        usual = reference.usual[key]
        after = final.after[key]
        curve = measured[key]
        nominal = _band(found.nominal.expected, key, usual)
        with_effects = _band(found.final.expected, key, usual)
        curves.append(
            {
                "statistic": key[0],
                "set": key[1],
                "title": one.title,
                "domain": one.domain,
                "quantity": one.quantity,
                "unit": one.unit,
                "x_label": one.x_label,
                "kind": one.kind,
                "x": curve.x.tolist(),
                "measured": _natural(data[key], usual).tolist(),
                "nominal": nominal,
                "with_effects": with_effects,
                "z": before.sigmas.tolist(),
                "z_after": after.sigmas.tolist(),
                "in_gap": key in final.where,
                "weight": final.gap.weights.get(key, 0.0),
                "left": final.gap.left.get(key, 0.0),
                "significance": sigmas_of(before.log_chance),
                "significance_after": sigmas_of(after.log_chance),
            }
        )
    return curves


def _natural(values: F64, usual: F64 | None) -> F64:
    """From the scale of comparison to the statistic's own unit."""
    if usual is None:
        return values
    ratio = np.where(values > 0, np.exp(np.minimum(values, 600)), (1 + values / 3) ** 3)
    return np.asarray(np.sqrt(np.maximum(ratio, 0) * usual))


def _band(expected: Expectation, key: Key, usual: F64 | None) -> dict[str, list[float]]:
    mean, error = expected.mean[key], np.sqrt(expected.variance[key])
    return {
        "value": _natural(mean, usual).tolist(),
        "low": _natural(
            np.maximum(mean - error, -3) if usual is not None else mean - error, usual
        ).tolist(),
        "high": _natural(mean + error, usual).tolist(),
    }


def _where(final: Shrinkage, curves: Mapping[Key, dict[str, Any]]) -> list[dict[str, Any]]:
    """Statistics that differ, most significant first; then those that only differ with effects."""
    keys = sorted(final.where, key=lambda k: final.before[k].log_chance)
    keys += sorted(flagged(final.after) - final.where, key=lambda k: final.after[k].log_chance)
    return [_entry(key, final, curves[key]) for key in keys]


def _entry(key: Key, final: Shrinkage, curve: Mapping[str, Any]) -> dict[str, Any]:
    at = final.before[key].worst if key in final.where else final.after[key].worst
    set_name = "" if key[1] == DETECTOR else f"set {key[1]}, "
    return {
        "domain": curve["domain"],
        "statistic": key[0],
        "set": key[1],
        "title": curve["title"],
        "unit": curve["unit"],
        "measured": curve["measured"][at],
        "simulated": curve["nominal"]["value"][at],
        "after": curve["with_effects"]["value"][at],
        "z": _rounded(float(final.before[key].sigmas[at])),
        "z_after": _rounded(float(final.after[key].sigmas[at])),
        "significance": _rounded(sigmas_among(final.before[key].log_chance, len(final.before))),
        "left": _rounded(final.gap.left.get(key, 0.0)),
        "place": set_name + place(curve, at),
    }


def _absolute(
    found: SearchResult,
    final: Shrinkage,
    curves: Mapping[Key, dict[str, Any]],
    reference: Reference,
) -> list[dict[str, Any]]:
    """What differs in units of the bench, with all causes and with each alone; some in any case.

    Intervals are of one sigma: where a measurement may lie if the simulation is right.
    """
    keys: Sequence[Key] = [k for k in curves if curves[k]["unit"] in ("px", "e-", "rad")]
    only = {n: trial for n in found.accepted if (trial := found.candidates[n].alone) is not None}
    rows = []
    for key in keys:
        curve = curves[key]
        if key not in final.where and key[0] not in ALWAYS:
            continue
        at = final.before[key].worst
        quantity = curve["title"] + ("" if key[1] == DETECTOR else f" ({key[1]})")
        nominal, after = curve["nominal"], curve["with_effects"]
        rows.append(
            {
                "quantity": quantity,
                "unit": curve["unit"],
                "measured": curve["measured"][at],
                "simulated": nominal["value"][at],
                "simulated_interval": [nominal["low"][at], nominal["high"][at]],
                "after": after["value"][at],
                "after_interval": [after["low"][at], after["high"][at]],
                "with_only": {
                    name: _band(trial.expected, key, reference.usual[key])["value"][at]
                    for name, trial in only.items()
                },
            }
        )
    return rows


def _closed(left: float) -> float:
    """Share of the gap that is closed where so much is left; never less than none."""
    return _rounded(max(1 - left, 0.0))


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
