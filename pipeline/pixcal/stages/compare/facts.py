"""What ``compare.json`` says of two sides along one direction."""

from typing import Any

import numpy as np
from scipy.special import gammainc, ndtr, ndtri

from pixcal.stages.compare.agreement import (
    Part,
    VarianceEstimate,
    beyond_noise,
    common,
    own,
    significance,
    straight_line,
    strongest_period,
)
from pixcal.stages.compare.pair import Pair, PairSums, Pixels, Places

CLAIM = 1e-3  # chance of a false claim of a difference, of all that is looked at together
# kinds of evidence: scales, columns, rows, means of blocks, scatter in blocks, single pixels
FAMILIES = 6
LISTED = 10  # most blocks, and most pixels, that are named


def describe(
    pair: Pair, sums: PairSums, pixels: Pixels, places: Places, limit: float, accuracy: float
) -> dict[str, Any]:
    """Results of one component.

    Parameters
    ----------
    sums : PairSums
        Without the outlying pixels.
    limit : float
        Sigma beyond which pixels were left out.
    accuracy : float
        Relative error of SIGMA to tolerate.
    """
    total = sums.total()
    scales = [_scale(side, p, accuracy) for side, p in sums.scales() if p.freedom >= 1]
    columns, rows = (_profile(sums, b, accuracy) for b in (sums.columns, sums.rows))
    blocks, outliers = _blocks(places), _outliers(pixels)
    evidence = _evidence(scales, columns, rows, blocks, outliers)
    line = straight_line(total)
    ny, nx = pair.window
    return {
        "direction": list(pair.direction),
        "pixels": sums.pixels,
        "pixels_missing": ny * nx - int(pixels.pulls.sum()),
        "pixels_left_out": int(pixels.pulls.sum()) - sums.pixels,
        "left_out_beyond_sigma": limit,
        "modes_removed": round(sums.projection.taken(sums.fine[0].products)),
        "correlation": line.correlation,
        "correlation_error": line.correlation_error,
        "slope": line.slope,
        "slope_error": line.error,
        "pull_spread": pixels.spread,
        **_amounts(total, accuracy),
        "scales": scales,
        "verdict": "differ" if evidence else "agree",
        "evidence": evidence,
        "suspicion": _suspicion(scales),
        "columns": columns,
        "rows": rows,
        "blocks": blocks,
        "outliers": outliers,
    }


def _evidence(
    scales: list[dict[str, Any]],
    columns: dict[str, Any],
    rows: dict[str, Any],
    blocks: dict[str, Any],
    outliers: dict[str, Any],
) -> list[str]:
    """Significant differences in words; the false-alarm rate of the whole list is `CLAIM`."""
    share = CLAIM / FAMILIES
    evidence = []
    sides = [s["side_px"] for s in scales if s["significance"] > -ndtri(share / len(scales))]
    if sides:
        evidence.append(f"scales of {', '.join(map(str, sides))} px")
    for name, profile in (("columns", columns), ("rows", rows)):
        wave = profile["period"]
        if wave is not None:
            evidence.append(
                f"{name}: a wave of {wave['px']:.4g} px, amplitude {wave['amplitude_px']:.2g} px"
            )
        elif profile["significance"] > -ndtri(share):
            evidence.append(
                f"{name}: their means differ {profile['ratio']:.2g} times more than noise"
            )
    for kind in ("mean", "scatter"):
        number = blocks["beyond"][kind]
        if number:
            evidence.append(f"the {kind} of {number} of {blocks['number']} blocks")
    # The chance of so many or more, by the Poisson law.
    if gammainc(outliers["beyond_5_sigma"], outliers["expected"]) < share:
        evidence.append(f"{outliers['beyond_5_sigma']} single pixels")
    return evidence


def _suspicion(scales: list[dict[str, Any]]) -> str | None:
    """Maps that agree better than they can."""
    close = [s["side_px"] for s in scales if s["significance"] < ndtri(CLAIM / len(scales))]
    if not close:
        return None
    return (
        f"the maps differ less than their noise at {', '.join(map(str, close))} px: they share "
        "frames, or SIGMA is too large"
    )


def _amounts(p: Part, accuracy: float) -> dict[str, Any]:
    """Sizes at one scale, or at all of them; those of the scales add up in squares."""
    ratio = (p.difference / p.expected) ** 0.5 if p.expected > 0 else None
    first, second = own(p, accuracy)
    return {
        "freedom": p.freedom,
        "rms_px": [(p.first / p.pixels) ** 0.5, (p.second / p.pixels) ** 0.5],
        "common": estimate_facts(common(p)),
        "difference_px": (p.difference / p.pixels) ** 0.5,
        "expected_px": (p.expected / p.pixels) ** 0.5,
        "ratio": ratio,
        "ratio_error": float(np.hypot((2 * p.freedom) ** -0.5, accuracy)),
        "significance": significance(p, accuracy),
        "beyond_noise": estimate_facts(beyond_noise(p, accuracy)),
        "own": [estimate_facts(first), estimate_facts(second)],
    }


def estimate_facts(e: VarianceEstimate) -> dict[str, float]:
    """A size with its error and upper limit, as rms and as variance."""
    return {
        "px": e.rms,
        "error_px": e.rms_error,
        "upper_px": e.upper,
        "variance_px2": e.variance,
        "variance_error_px2": e.error,
    }


def _scale(side: int, p: Part, accuracy: float) -> dict[str, Any]:
    correlation = p.both / np.sqrt(max(p.first * p.second, 1e-300))
    return {"side_px": side, "correlation": float(correlation), **_amounts(p, accuracy)}


def _profile(sums: PairSums, blocks: Any, accuracy: float) -> dict[str, Any]:
    """Means of the columns (or rows): how far they differ, and the strongest wave."""
    p = sums.of_means(blocks)
    mean, error = (np.ravel(values) for values in sums.differences(blocks))
    facts: dict[str, Any] = {"ratio": None, "significance": 0.0, "worst": None, "period": None}
    if p.freedom < 1 or p.expected <= 0:
        return facts
    number = p.freedom
    facts |= {
        "difference_px": float((p.difference / number / (p.pixels / len(mean))) ** 0.5),
        "expected_px": float((p.expected / number / (p.pixels / len(mean))) ** 0.5),
        "ratio": (p.difference / p.expected) ** 0.5,
        "ratio_error": float(np.hypot((2 * number) ** -0.5, accuracy)),
        "significance": significance(p, accuracy),
    }
    pulls = np.abs(np.nan_to_num(mean / error))
    worst = int(np.argmax(pulls))
    facts["worst"] = {
        "at": worst, "difference_px": float(mean[worst]), "error_px": float(error[worst])
    }  # fmt: skip
    wave = strongest_period(mean, error)
    if wave is not None and wave.chance < CLAIM / FAMILIES:
        facts["period"] = {
            "px": wave.px, "amplitude_px": wave.amplitude, "chance": wave.chance
        }  # fmt: skip
    return facts


def _blocks(places: Places) -> dict[str, Any]:
    """Blocks whose mean or scatter differs significantly."""
    number = int((places.count > 0).sum())
    share = CLAIM / FAMILIES / max(1, number)
    limits = {"mean": float(-ndtri(share / 2)), "scatter": float(-ndtri(share))}
    listed: list[dict[str, Any]] = []
    beyond = dict.fromkeys(limits, 0)
    for kind, z in (("mean", places.shift), ("scatter", places.scatter)):
        size = np.nan_to_num(np.abs(z) if kind == "mean" else z)
        for y, x in np.argwhere(size > limits[kind]):
            beyond[kind] += 1
            listed.append(
                {
                    "kind": kind,
                    "y": [int(y) * places.side, (int(y) + 1) * places.side],
                    "x": [int(x) * places.side, (int(x) + 1) * places.side],
                    "significance": float(z[y, x]),
                    "difference_px": float(places.mean[y, x]),
                    "error_px": float(places.error[y, x]),
                    "pull_rms": float((places.squares[y, x] / places.count[y, x]) ** 0.5),
                }
            )
    listed.sort(key=lambda place: -abs(place["significance"]))
    return {
        "side_px": places.side,
        "number": number,
        "limit_sigma": limits,
        "beyond": beyond,
        "worst": listed[:LISTED],
    }


def _outliers(pixels: Pixels) -> dict[str, Any]:
    total = int(pixels.pulls.sum())
    return {
        "beyond_5_sigma": pixels.beyond,
        "expected": float(2 * ndtr(-5) * total),
        "worst": [
            {"x": x, "y": y, "difference_px": d, "error_px": e}
            for y, x, d, e in pixels.far[:LISTED]
        ],
    }
