"""``pixcal compare``: common signal and differences of maps of the same pixels.

docs/reference/products-other.md describes ``compare.json``.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import gammainc, ndtr, ndtri

from pixcal import __version__
from pixcal.engine.run import Runtime
from pixcal.model.arrays import F64
from pixcal.model.config import result_options
from pixcal.model.errors import InputError
from pixcal.model.options import Compare as Config
from pixcal.report.compare_figures import ComponentView, compare_figure
from pixcal.report.drawing import png
from pixcal.stages.compare.agreement import (
    Grouping,
    Part,
    VarianceEstimate,
    halve,
    strongest_period,
    three_cornered_hat,
)
from pixcal.stages.compare.pair import DISAGREE, Pair, PairSums, Pixels, read_pixels, read_sums
from pixcal.stages.compare.sides import Side, Vector, parts_of, whole_run
from pixcal.storage.artefact import artefact_key
from pixcal.storage.formats import STAGES
from pixcal.storage.lock import damage_noted, lock
from pixcal.storage.manifest import (
    MANIFEST,
    Manifest,
    read_manifest,
    write_json,
    write_manifest,
    write_whole,
)

STAGE = STAGES["compare"]
SCHEMA = "pixcal/compare/1"
RESULT = "compare.json"
STRAY = 0.05  # expected number of pixels of a window left out by chance
FEWEST = 50  # fewest common pixels
PARALLEL_DEG = 10.0  # largest angle between axes of single sets that can be compared
NOTED_DEG = 0.5  # angle between axes above which the difference is reported
FALSE_ALARM_RATE = 1e-3  # false-alarm rate of differences, over all tests together
# kinds of evidence: scales, columns, rows, means of blocks, scatter in blocks, single pixels
FAMILIES = 6
SHARE = FALSE_ALARM_RATE / FAMILIES
LISTED = 10  # most blocks, and most pixels, that are listed


def run(runs: Sequence[Path], out: Path, config: Config, runtime: Runtime) -> Manifest:
    """Compare maps of the same pixels, of two or more runs or of two parts of one run."""
    if out.exists():
        if not out.is_dir():
            raise InputError(f"--out {out}: is a file; choose another directory")
        made = read_manifest(out)
        if (made is not None and made.stage != STAGE.name) or (out / "ingest").exists():
            raise InputError(
                f"--out {out}: holds other results of pixcal; choose another directory"
            )
    with damage_noted(*runs):
        sides = _sides(runs, config)
        components = _components(sides)
        inputs = {f"{n} {side.run}": side.key for n, side in enumerate(sides)}
        plain = result_options(config)
        key = artefact_key(STAGE.name, STAGE.format, plain, inputs)
        with lock(out):
            ready = read_manifest(out)
            if ready is not None and ready.key == key and (out / RESULT).exists():
                return ready
            (out / MANIFEST).unlink(missing_ok=True)
            result, views = _compare_all(sides, components, config, runtime)
            for picture in out.glob("compare*.png"):
                picture.unlink()
            for (i, j), pictured in views.items():
                name = "compare.png" if len(views) == 1 else f"compare-{i + 1}-{j + 1}.png"
                labels = sides[i].label, sides[j].label
                write_whole(out / name, png(compare_figure(labels, pictured)))
            write_json(out / RESULT, result)
            manifest = Manifest(STAGE.name, STAGE.format, key, plain, inputs)
            write_manifest(out, manifest)
            return manifest


def _sides(runs: Sequence[Path], config: Config) -> list[Side]:
    if len(runs) == 1:
        return parts_of(runs[0], interleaved=config.split == "odd-even")
    # Runs of the same name in different places are distinguished by their paths.
    alike = len({run.name for run in runs}) < len(runs)
    sides = [whole_run(run, str(run) if alike else None) for run in runs]
    first = sides[0]
    for side in sides[1:]:
        if side.window != first.window:
            (ny, nx), (my, mx) = first.window, side.window
            raise InputError(
                f"{side.run}: a window of {mx} x {my} px, {first.run} has {nx} x {ny}; windows of "
                "the same shape are needed, with the same pixels"
            )
    return sides


def _components(sides: Sequence[Side]) -> dict[str, Vector]:
    """Directions along which all sides measure."""
    single = next((side for side in sides if not side.both), None)
    if single is None:
        return {"delta_x": (1.0, 0.0), "delta_y": (0.0, 1.0)}
    direction = single.axes[0]
    for side in sides:
        if not side.both and _angle(side.axes[0], direction) > PARALLEL_DEG:
            raise InputError(
                f"{side.run}: its fringes are rotated by {_angle(side.axes[0], direction):.0f} "
                f"degrees from those of {single.run}; they measure different components"
            )
    return {"delta_fringe": direction}


def _angle(a: Vector, b: Vector) -> float:
    """Angle between two axes, degrees, regardless of their sense."""
    return float(np.degrees(np.arccos(min(1.0, abs(float(np.dot(a, b)))))))


def _compare_all(
    sides: Sequence[Side], components: dict[str, Vector], config: Config, runtime: Runtime
) -> tuple[dict[str, Any], dict[tuple[int, int], list[ComponentView]]]:
    pairs, views = [], {}
    for i, j in combinations(range(len(sides)), 2):
        results = {
            name: compare_pair(Pair(sides[i], sides[j], name, at), config.sigma_accuracy, runtime)
            for name, at in components.items()
        }
        facts = {name: component for name, (component, _) in results.items()}
        pairs.append({"sides": [i, j], "components": facts})
        views[i, j] = [view for _, view in results.values()]
    result = {
        "schema": SCHEMA,
        "pixcal": __version__,
        "sides": [{"label": side.label} | side.facts for side in sides],
        "window": list(sides[0].window),
        "sigma_accuracy": config.sigma_accuracy,
        "pairs": pairs,
        "summary": _summary(pairs, components) if len(sides) > 2 else None,
        "warnings": _warnings(sides, components),
    }
    return result, views


def compare_pair(
    pair: Pair, accuracy: float, runtime: Runtime
) -> tuple[dict[str, Any], ComponentView]:
    """Compare two sides along one direction: results and figure."""
    runtime = pair.plan(runtime)
    sums = read_sums(pair, runtime)
    if sums.pixels < FEWEST:
        raise InputError(
            f"{pair.first.run} and {pair.second.run}: {sums.pixels} pixels have {pair.name} in "
            f"both; {FEWEST} are needed"
        )
    pixels = read_pixels(pair, sums, runtime)
    # If all pixels scatter more than noise, or are many, few of those far off are outliers.
    limit = max(DISAGREE, float(-ndtri(STRAY / sums.pixels))) * max(1.0, pixels.spread)
    if any(abs(d / e) > limit for _, _, d, e in pixels.far):
        sums = read_sums(pair, runtime, (sums.projection, limit))
    return describe(pair, sums, pixels, limit, accuracy)


def _summary(pairs: list[dict[str, Any]], components: Iterable[str]) -> dict[str, Any]:
    """Individual errors of each side, from all pairs."""
    summary: dict[str, Any] = {}
    for name in components:
        facts = [pair["components"][name] for pair in pairs]
        beyond = (f["beyond_noise"] for f in facts)
        excess = [VarianceEstimate(e["variance_px2"], e["variance_error_px2"]) for e in beyond]
        hat = three_cornered_hat([pair["sides"] for pair in pairs], excess)
        summary[name] = {"ratio": [f["ratio"] for f in facts], "own": [e.facts() for e in hat]}
    return summary


def _warnings(sides: Sequence[Side], components: dict[str, Vector]) -> list[str]:
    sentences = []
    direction = components.get("delta_fringe")
    for side in sides:
        turned = 0.0 if side.both or direction is None else _angle(side.axes[0], direction)
        if turned > NOTED_DEG:
            sentences.append(
                f"{side.label}: fringes rotated by {turned:.1f} degrees: "
                f"{100 * np.sin(np.radians(turned)):.1g} % of the offsets along the fringes count "
                "as a difference"
            )
    return sentences


# Two sides along one direction


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
