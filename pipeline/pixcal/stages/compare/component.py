"""Two sides along one direction: results and figure of one component."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import gammainc, ndtr, ndtri

from pixcal.model.arrays import F64
from pixcal.report.compare_figures import ComponentView
from pixcal.stages.compare.agreement import Grouping, Part, halve, strongest_period
from pixcal.stages.compare.pair import DISAGREE, Pair, PairSums, Pixels

FALSE_ALARM_RATE = 1e-3  # false-alarm rate of differences, over all tests together
# kinds of evidence: scales, columns, rows, means of blocks, scatter in blocks, single pixels
FAMILIES = 6
SHARE = FALSE_ALARM_RATE / FAMILIES
LISTED = 10  # most blocks, and most pixels, that are listed


def describe(
    pair: Pair, sums: PairSums, pixels: Pixels, limit: float, accuracy: float
) -> tuple[dict[str, Any], ComponentView]:
    """Results and figure of one component; ``sums`` exclude pixels beyond ``limit`` sigma.

    ``accuracy``: relative error of SIGMA to tolerate.
    """
    known, (ny, nx) = int(pixels.pulls.sum()), pair.window
    profiles = {name: sums.differences(s) for name, s in sums.profiles.items()}
    blocks, shift, scatter = _blocks(pair, sums, pixels)
    facts = {
        "direction": list(pair.direction),
        "pixels": sums.pixels,
        "pixels_missing": ny * nx - known,
        "pixels_left_out": known - sums.pixels,
        "left_out_beyond_sigma": limit,
        "modes_removed": round(sums.projection.taken(sums.fine[0].products)),
        **sums.total().line()._asdict(),
        "pull_spread": pixels.spread,
        **_amounts(sums.total(), accuracy),
        "scales": [
            {"side_px": side, "correlation": p.correlation, **_amounts(p, accuracy)}
            for side, p in sums.scales()
            if p.freedom >= 1
        ],
        **{
            name: _profile(
                sums.part(Grouping.of(sums.profiles[name]), sums.whole), *profile, accuracy
            )
            for name, profile in profiles.items()
        },
        "blocks": blocks,
        "outliers": {
            "beyond_5_sigma": pixels.beyond,
            "expected": float(2 * ndtr(-DISAGREE) * known),
            "worst": [
                dict(zip(("y", "x", "difference_px", "error_px"), one, strict=True))
                for one in pixels.far[:LISTED]
            ],
        },
    }
    evidence = _evidence(facts)
    facts |= {"verdict": "differ" if evidence else "agree", "evidence": evidence}
    facts |= {"suspicion": _suspicion(facts["scales"])}
    far = [(y, x) for y, x, _, _ in pixels.far]
    picture = pixels.picture, pixels.reach
    view = ComponentView(pair.name, pair.window, facts, *picture, shift, scatter, profiles, far)
    return facts, view


def _evidence(facts: dict[str, Any]) -> list[str]:
    """Significant differences in words; `FALSE_ALARM_RATE` is that of the whole list."""
    evidence, scales = [], facts["scales"]
    limit = -ndtri(SHARE / max(1, len(scales)))
    sides = [str(s["side_px"]) for s in scales if s["significance"] > limit]
    if sides:
        evidence.append(f"scales of {', '.join(sides)} px")
    for name in ("columns", "rows"):
        profile, wave = facts[name], facts[name]["period"]
        if wave is not None:
            size = f"{wave['px']:.4g} px, amplitude {wave['amplitude_px']:.2g} px"
            evidence.append(f"{name}: period {size}")
        elif profile["significance"] > -ndtri(SHARE):
            times = f"{profile['ratio']:.2g} times"
            evidence.append(f"{name}: means differ by {times} the noise")
    blocks, outliers = facts["blocks"], facts["outliers"]
    for kind, number in blocks["beyond"].items():
        if number:
            evidence.append(f"{kind} of {number} of {blocks['number']} blocks")
    # Poisson probability of this number or more.
    if gammainc(outliers["beyond_5_sigma"], outliers["expected"]) < SHARE:
        evidence.append(f"{outliers['beyond_5_sigma']} single pixels")
    return evidence


def _suspicion(scales: list[dict[str, Any]]) -> str | None:
    """Warning on maps that agree better than their errors allow."""
    limit = ndtri(FALSE_ALARM_RATE / max(1, len(scales)))
    close = [str(s["side_px"]) for s in scales if s["significance"] < limit]
    if not close:
        return None
    return (
        f"the maps agree better than their noise allows at scales of {', '.join(close)} px: they "
        "share frames, or SIGMA is too large"
    )


def _amounts(p: Part, accuracy: float) -> dict[str, Any]:
    """Sizes at one scale, or at all; sizes of the scales add in quadrature."""
    return {
        "freedom": p.freedom,
        "rms_px": [(square / p.pixels) ** 0.5 for square in (p.first, p.second)],
        "common": p.common().facts(),
        "difference_px": (p.difference / p.pixels) ** 0.5,
        "expected_px": (p.expected / p.pixels) ** 0.5,
        "ratio": (p.difference / p.expected) ** 0.5 if p.expected > 0 else None,
        "ratio_error": float(np.hypot((2 * p.freedom) ** -0.5, accuracy)),
        "significance": p.significance(accuracy),
        "beyond_noise": p.beyond_noise(accuracy).facts(),
        "own": [estimate.facts() for estimate in p.own(accuracy)],
    }


def _profile(p: Part, mean: F64, error: F64, accuracy: float) -> dict[str, Any]:
    """Means of the columns (or rows): their differences, and the strongest wave."""
    if p.freedom < 1 or p.expected <= 0:
        return {"ratio": None, "significance": 0.0, "worst": None, "period": None}
    worst = int(np.argmax(np.abs(np.nan_to_num(mean / error))))
    at = {"at": worst, "difference_px": float(mean[worst]), "error_px": float(error[worst])}
    wave = strongest_period(mean, error)
    claimed = wave is not None and wave.chance < SHARE
    amounts = _amounts(replace(p, pixels=p.freedom * (p.pixels / len(mean))), accuracy)
    kept = ("ratio", "ratio_error", "significance", "difference_px", "expected_px")
    return {
        **{key: amounts[key] for key in kept},
        "worst": at,
        "period": wave._asdict() if wave is not None and claimed else None,
    }


def _blocks(pair: Pair, sums: PairSums, pixels: Pixels) -> tuple[dict[str, Any], F64, F64]:
    """Blocks with different mean or scatter, and the significance of both in every block."""
    blocks, squares = sums.coarse, pixels.squares
    for _ in range((pair.shown >> pair.coarse).bit_length() - 1):
        blocks, squares = halve(blocks), halve(squares)
    mean, error = sums.differences(blocks)
    count = np.where(squares[1] > 0, squares[1], np.nan)
    chance, square = 2 / (9 * count), squares[0] / count
    scatter = np.asarray((square ** (1 / 3) - (1 - chance)) / np.sqrt(chance))
    shift = mean / error
    number, side = int((squares[1] > 0).sum()), pair.shown
    share = SHARE / max(1, number)
    # Means are tested on both sides, scatter only for an excess.
    limits = {"mean": float(-ndtri(share / 2)), "scatter": float(-ndtri(share))}
    beyond = {"mean": np.abs(shift) > limits["mean"], "scatter": scatter > limits["scatter"]}
    listed: list[dict[str, Any]] = [
        {
            "kind": kind,
            "y": [y * side, (y + 1) * side],
            "x": [x * side, (x + 1) * side],
            "significance": float((shift if kind == "mean" else scatter)[y, x]),
            "difference_px": float(mean[y, x]),
            "error_px": float(error[y, x]),
            "pull_rms": float(square[y, x] ** 0.5),
        }
        for kind, where in beyond.items()
        for y, x in np.argwhere(where).tolist()
    ]
    facts = {
        "side_px": side,
        "number": number,
        "limit_sigma": limits,
        "beyond": {kind: int(where.sum()) for kind, where in beyond.items()},
        "worst": sorted(listed, key=lambda place: -abs(place["significance"]))[:LISTED],
    }
    return facts, shift, scatter
