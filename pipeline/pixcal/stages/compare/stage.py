"""``pixcal compare``: common signal and differences of maps of the same pixels.

docs/reference/products-other.md describes ``compare.json``.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri

from pixcal import __version__
from pixcal.engine.run import Runtime
from pixcal.model.config import result_options
from pixcal.model.errors import InputError
from pixcal.model.options import Compare as Config
from pixcal.report.compare_figures import ComponentView, compare_figure
from pixcal.report.drawing import png
from pixcal.stages.compare.agreement import VarianceEstimate, three_cornered_hat
from pixcal.stages.compare.component import describe
from pixcal.stages.compare.pair import DISAGREE, Pair, read_pixels, read_sums
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
        "warnings": [*_warnings(sides, components)],
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


def _warnings(sides: Sequence[Side], components: dict[str, Vector]) -> Iterator[str]:
    direction = components.get("delta_fringe")
    for side in sides:
        turned = 0.0 if side.both or direction is None else _angle(side.axes[0], direction)
        if turned > NOTED_DEG:
            yield (
                f"{side.label}: fringes rotated by {turned:.1f} degrees: "
                f"{100 * np.sin(np.radians(turned)):.1g} % of the offsets along the fringes count "
                "as a difference"
            )
