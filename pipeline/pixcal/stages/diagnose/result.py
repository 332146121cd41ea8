"""``diagnosis.json`` and its curves, from the result of a search."""

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import log_ndtr, ndtr

from pixcal import __version__
from pixcal.estimators.test_statistics import DETECTOR, Curve, Key
from pixcal.estimators.test_statistics.expectation import Reference, statistic_named
from pixcal.estimators.test_statistics.gap import (
    Difference,
    flagged,
    likelier,
    sigmas_among,
    sigmas_of,
)
from pixcal.model.arrays import F64
from pixcal.model.config import meanings, to_plain
from pixcal.report.diagnosis_words import place
from pixcal.simulation.effect import DOMAINS
from pixcal.stages.diagnose import frames
from pixcal.stages.diagnose.candidates import Candidate, SearchResult
from pixcal.stages.diagnose.comparison import (
    Shrinkage,
    Trial,
    differing,
    gap_interval,
    not_compared,
    rounded,
    shrinkage,
)
from pixcal.stages.diagnose.thresholds import EXPLAINED, MAX_RESIDUAL_SHARE, MAX_RESIDUAL_SIGMA

Json = dict[str, Any]

SCHEMA = "pixcal/diagnosis/1"
# statistics reported in bench units even if they do not differ
ALWAYS = ("allan_of_batches", "offset_by_place", "residual_noise")
MIN_P_VALUE = 1e-12  # smallest reported: the shape of the tails beyond is unknown
SHOWN = 3  # statistics listed that identified a cause
# attributes of a curve that describe its statistic
FACTS = ("title", "domain", "quantity", "unit", "x_label", "kind")


@dataclass(frozen=True)
class Description:
    """What a search found, as `diagnosis.json` and its curves say it."""

    search: SearchResult
    data: Mapping[Key, F64]  # held-out curves on the reference's scales
    measured: Mapping[Key, Curve]  # the same in their own units
    reference: Reference
    facts: frames.FramesUsed

    @cached_property
    def where(self) -> set[Key]:
        """Curves that make up the gap."""
        return differing(self.search.nominal, self.search.final, self.data)

    @cached_property
    def final(self) -> Shrinkage:
        """How much of the gap all causes close."""
        return self._with(self.search.final)

    def _with(self, trial: Trial) -> Shrinkage:
        return shrinkage(self.data, self.search.nominal, trial, self.where)

    def diagnosis(self, places: Sequence[Mapping[str, Any]]) -> Json:
        """Contents of ``diagnosis.json``; ``places``: deviations of the windows, `by_domain`."""
        search, final, verdict = self.search, self.final, self._verdict()
        causes = [self._cause(name) for name in search.accepted]
        # Statistics that differ, the largest effect first; then those only with effects.
        before, after, size = final.before, final.after, final.sizes.size
        keys = sorted(self.where, key=lambda k: (-abs(size[k]), k))
        keys += sorted(flagged(after) - self.where, key=lambda k: after[k].log_chance)
        where = [self._entry(key, before[key], after[key]) for key in keys]
        not_tested: Json = {}  # effects that these frames cannot show, by the frames that could
        for candidate in search.candidates.values():
            if candidate.needs and candidate.needs != (frames.FRINGES,):
                not_tested.setdefault(" or ".join(candidate.needs), []).append(candidate.name)
        return {
            "schema": SCHEMA,
            "pixcal": __version__,
            "verdict": verdict,
            "causes": sorted(causes, key=lambda c: -float(c["gap_closed"])),
            "gap": {
                "total": 1.0 if self.where else 0.0,
                "after": rounded(final.gap.total),
                "interval": [rounded(v) for v in gap_interval(self.data, final, search.final)],
                "domains": {d: [rounded(v) for v in final.gap.of_domain(d)] for d in DOMAINS},
                "where": where,
                "absolute": self._absolute(),
                "places": list(places),
            },
            "candidates": [self._candidate(c) for c in search.candidates.values()],
            "not_tested": not_tested,
            "not_compared": not_compared(self.measured, self.data),
            "more_would_tell": self._more_would_tell(where, verdict),
            "statistics": len(final.before),
            "looked_at": to_plain(self.facts),
        }

    def _verdict(self) -> str:
        if not self.where:
            return "no gap"
        if not self.search.accepted:
            return "unexplained"
        closed = self.final.significant.total <= EXPLAINED
        return "explained" if closed and not self.staying else "partly explained"

    @cached_property
    def staying(self) -> set[Key]:
        """Curves that still deviate with all causes, over `MAX_RESIDUAL_SHARE` of it before."""
        left, after = self.final.significant.left, self.final.after
        return {
            key
            for key in flagged(after)
            if left.get(key, 1.0) > MAX_RESIDUAL_SHARE
            and sigmas_of(after[key].log_chance) > MAX_RESIDUAL_SIGMA
        }

    def _cause(self, name: str) -> Json:
        search, candidate = self.search, self.search.candidates[name]
        estimate = candidate.estimate
        assert estimate is not None
        effect = next(e for e in search.final.effects if e.name == name)
        by_itself = candidate.alone or search.final
        alone, without = self._with(by_itself), self._with(search.without[name])
        gain = search.final.log_likelihood - search.without[name].log_likelihood
        by_law = self._with(search.by_law[name]) if name in search.by_law else alone
        known = {effect.name for effect in search.final.effects}
        alike = tuple(
            n
            for n in dict.fromkeys((*search.alike.get(name, ()), *estimate.alike))
            if n in search.candidates and n not in known
        )
        kinds = [type(e.effect) for n in (name, *alike) if (e := search.candidates[n].estimate)]
        # Fisher's method combines two independent parts of the frames. A likelihood ratio of e^gain
        # has a chance of at most e^-gain (Markov's inequality).
        unique = estimate.significance * candidate.share
        log_both = max(float(log_ndtr(-unique)) - max(gain, 0.0), -600.0)
        chance = np.exp(log_both) * (1 - log_both)
        same_samples = self.facts.shared and not self.facts.sets and self.facts.on_the_same_pixels
        if same_samples or candidate.in_maps_alone:
            # Both parts hold the same samples, or the same offsets: the second adds no information.
            chance = float(ndtr(-unique))
        chance *= len(search.candidates) * candidate.variants_tried
        return {
            "effect": name,
            "title": effect.title,
            "about": (inspect.getdoc(effect) or "").partition("\n")[0].replace("`", ""),
            "parameters": to_plain(effect),
            "uncertainty": {k: float(v) for k, v in estimate.errors.items()},
            "units": {f.name: f.metadata.get("unit", "") for f in fields(effect)},
            "meanings": meanings(type(effect)),
            "strengths": list(effect.strengths),
            "size": dict(estimate.size),
            "law": estimate.law,
            "gap_closed": _closed(alone.gap.total),
            "gap_closed_interval": [
                _closed(v) for v in reversed(gap_interval(self.data, alone, by_itself))
            ],
            "gap_closed_by_law": _closed(by_law.gap.total),
            "gain_over_rest": rounded(max(without.gap.total - self.final.gap.total, 0.0)),
            "p_value": float(np.clip(chance, MIN_P_VALUE, 1.0)),
            "sigmas": rounded(estimate.significance),
            "why": estimate.why,
            "remedy": effect.remedy or "find and fix it on the bench",
            "given_away_by": self._strongest_evidence(search.without[name]),
            "not_told_apart_from": list(alike),
            "would_decide": frames.recommend_frames(self.facts.missing_frames, kinds)
            if alike
            else [],
        }

    def _more_would_tell(self, where: Sequence[Json], verdict: str) -> list[str]:
        """Frames to record where a gap remains."""
        if verdict not in ("unexplained", "partly explained"):
            return []
        if not where:
            return frames.recommend_frames(self.facts.missing_frames)
        largest = max(where, key=lambda entry: abs(entry["z_after"]))
        return frames.recommend_closer_look(self.facts.missing_frames, largest["domain"])

    def _strongest_evidence(self, without: Trial) -> list[dict[str, str]]:
        """Statistics whose likelihood an effect raises most, best first."""
        gains = likelier(self.data, without.expected, self.search.final.expected)
        best = sorted(gains, key=lambda k: -gains[k])[:SHOWN]
        return [{"statistic": k[0], "set": k[1]} for k in best if gains[k] > 1]

    def _candidate(self, candidate: Candidate) -> Json:
        alone, estimate = candidate.alone, candidate.estimate
        closed = _closed(self._with(alone).gap.total) if alone is not None and self.where else 0.0
        about: Json = {
            "effect": candidate.name,
            "gap_closed": rounded(closed),
            "rejected_because": candidate.reason,
            "tried_on_unseen_frames": alone is not None,
        }
        if estimate is not None:
            about["sigmas"] = rounded(estimate.significance)
            about["parameters"] = to_plain(estimate.effect)
        return about

    @cached_property
    def curves(self) -> dict[Key, Json]:
        """Every statistic: measured, nominal and with effects, with 1-sigma limits."""
        curves, gap = {}, self.final.gap
        for key, before in self.final.before.items():
            one, after = statistic_named(key[0]), self.final.after[key]
            curves[key] = {
                "statistic": key[0],
                "set": key[1],
                **{name: getattr(one, name) for name in FACTS},
                "x": self.measured[key].x.tolist(),
                "measured": _natural(self.data[key], self.reference.usual[key]).tolist(),
                "nominal": self._band(self.search.nominal, key),
                "with_effects": self._band(self.search.final, key),
                "z": before.sigmas.tolist(),
                "z_after": after.sigmas.tolist(),
                "in_gap": key in self.where,
                "weight": gap.weights.get(key, 0.0),
                "left": gap.left.get(key, 0.0),
                "size": self.final.sizes.size[key],
                "significance": sigmas_of(before.log_chance),
                "significance_after": sigmas_of(after.log_chance),
            }
        return curves

    def _band(self, trial: Trial, key: Key) -> dict[str, list[float]]:
        expected, usual = trial.expected, self.reference.usual[key]
        mean, error = expected.mean[key], np.sqrt(expected.variance[key])
        low = mean - error if usual is None else np.maximum(mean - error, -3)
        ends = (("value", mean), ("low", low), ("high", mean + error))
        return {name: _natural(values, usual).tolist() for name, values in ends}

    def _entry(self, key: Key, before: Difference, after: Difference) -> Json:
        at, curve = before.worst if key in self.where else after.worst, self.curves[key]
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
            "z": rounded(float(before.sigmas[at])),
            "z_after": rounded(float(after.sigmas[at])),
            "size": rounded(self.final.sizes.size[key]),
            "significance": rounded(sigmas_among(before.log_chance, len(self.final.before))),
            "left": rounded(self.final.gap.left.get(key, 0.0)),
            "stays": key in self.staying,
            "place": set_name + place(curve, at),
        }

    def _absolute(self) -> list[Json]:
        """Differences in bench units, with all causes and with each alone; 1-sigma intervals."""
        candidates = self.search.candidates
        only = {n: t for n in self.search.accepted if (t := candidates[n].alone) is not None}
        rows = []
        for key, curve in self.curves.items():
            listed = key in self.where or key[0] in ALWAYS
            if curve["unit"] not in ("px", "e-", "rad") or not listed:
                continue
            at = self.final.before[key].worst
            nominal, after = curve["nominal"], curve["with_effects"]
            alone = {name: self._band(trial, key)["value"][at] for name, trial in only.items()}
            rows.append(
                {
                    "quantity": curve["title"] + ("" if key[1] == DETECTOR else f" ({key[1]})"),
                    "unit": curve["unit"],
                    "measured": curve["measured"][at],
                    "simulated": nominal["value"][at],
                    "simulated_interval": [nominal["low"][at], nominal["high"][at]],
                    "after": after["value"][at],
                    "after_interval": [after["low"][at], after["high"][at]],
                    "with_only": alone,
                }
            )
        return rows


def _natural(values: F64, usual: F64 | None) -> F64:
    """Convert from the scale of comparison to the unit of the statistic."""
    if usual is None:
        return values
    ratio = np.where(values > 0, np.exp(np.minimum(values, 600)), (1 + values / 3) ** 3)
    return np.asarray(np.sqrt(np.maximum(ratio, 0) * usual))


def _closed(left: float) -> float:
    """Closed share of the gap, given the residual share; at least 0."""
    return rounded(max(1 - left, 0.0))
