"""Report: one HTML page on the whole run."""

from collections.abc import Mapping, Sequence
from functools import partial
from operator import call
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import log_ndtr

from pixcal.effects import effects
from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.test_statistics.gap import FALSE_ALARM_RATE, sigmas_among, sigmas_of
from pixcal.model.arrays import Source
from pixcal.model.config import result_options
from pixcal.model.options import Report as Config
from pixcal.report.contents import (
    DETECTOR_MAPS,
    Contents,
    DetectorContents,
    DiagnosisContents,
    MapContents,
    SetContents,
)
from pixcal.report.map_summary import (
    BAND_ROWS,
    DETAIL,
    SAMPLE,
    SEGMENT,
    RatioSource,
    detail,
    spectrum,
    summarise,
    summarise_flags,
)
from pixcal.report.page import render
from pixcal.stages.advice import advice, maps_to_use
from pixcal.storage.artefact import Build
from pixcal.storage.cube import ArrayReader
from pixcal.storage.folder import INDEX
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import MANIFEST, Manifest, read_json
from pixcal.storage.stage import make, require, working

FIGURE_BYTES = 192 << 20  # Matplotlib, one figure and the page


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Write ``RUN/report/report.html`` and ``RUN/products/report.html``.

    Only ``RUN/reduce`` must be there; what the later stages would add is marked as not measured.
    """
    with working(run_dir, "reduce"):
        manifests = {
            stage: require(run_dir, stage)
            for stage in ("ingest", "reduce", "sweep", "fit", "allan", "diagnose", "corrected")
            if (run_dir / stage / MANIFEST).exists()
        }
        inputs = {stage: manifest.key for stage, manifest in manifests.items()}

        def body(made: Build) -> None:
            page = render(_collect(run_dir, manifests, runtime))
            (made.folder / "report.html").write_text(page, encoding="utf-8")
            made.summary = {"bytes": len(page.encode()), "sections": page.count("<section")}

        return make(run_dir, STAGES["report"], result_options(config), inputs, body)


def _collect(run_dir: Path, manifests: Mapping[str, Manifest], runtime: Runtime) -> Contents:
    facts = _optional_json(run_dir / "reduce" / "reduce.json")
    fit = read_json(run_dir / "fit" / "fit.json") if "fit" in manifests else None
    allan = read_json(run_dir / "allan" / "allan.json") if "allan" in manifests else {}
    used = maps_to_use(run_dir) if fit is not None else {}
    corrected = [name for name, path in used.items() if path.stem != name]
    results = _summaries(_jobs(run_dir, fit, corrected), runtime)
    summary = advice(run_dir)
    return Contents(
        acquisition=read_json(run_dir / "ingest" / "acquisition.json"),
        stages=tuple(map(vars, manifests.values())),
        arrays=_arrays(run_dir, manifests),
        detector=DetectorContents(
            facts,
            {n: results[f"detector/{n}"] for n in DETECTOR_MAPS if f"detector/{n}" in results},
            _optional_json(run_dir / "reduce" / "figures_of_merit.json"),
            results.get("flags/detector"),
        ),
        fit=fit,
        offsets=tuple(_offset(name, results) for name in (fit["outputs"] if fit else ())),
        corrected=tuple(_offset(f"corrected/{name}", results) for name in corrected),
        sets=tuple(
            _set(run_dir / "fit" / "fit.zarr", name, of_set, allan.get("sets", {}), results)
            for name, of_set in (fit["sets"].items() if fit else ())
        ),
        flags=results.get("flags/products"),
        diagnosis=(
            _diagnosis(run_dir / "diagnose", nothing_to_do=summary.nothing_to_do)
            if "diagnose" in manifests
            else None
        ),
        warnings=_warnings(manifests, facts),
        advice=summary.sentences,
        causes=summary.rows,
    )


# Maps


def _jobs(
    run_dir: Path, fit: Mapping[str, Any] | None, corrected: Sequence[str]
) -> dict[str, partial[Any]]:
    """Every summary of a map that the page shows, by name."""
    calibration, group = run_dir / "reduce" / "calibration.zarr", run_dir / "fit" / "fit.zarr"
    corrected_zarr = run_dir / "corrected" / "corrected.zarr"
    there = [name for name in (*DETECTOR_MAPS, "mask") if (calibration / name / INDEX).exists()]
    maps: dict[str, Source] = {f"detector/{n}": ArrayReader(calibration / n) for n in there}
    masks = {"detector": maps.pop("detector/mask")} if "mask" in there else {}
    jobs: dict[str, partial[Any]] = {}
    if fit is not None:
        outputs = {name: group / name for name in fit["outputs"]}
        outputs |= {f"corrected/{name}": corrected_zarr / name for name in corrected}
        for key, path in outputs.items():
            both = ArrayReader(path), ArrayReader(path.with_name(f"{path.name}_sigma"))
            maps |= {f"{key}/delta": both[0], f"{key}/sigma": both[1]}
            jobs[f"{key}/detail"] = partial(detail, *both)
            if path.parent == group:
                jobs[f"{key}/spectrum"] = partial(spectrum, *both)
        masks["products"] = ArrayReader(group / "mask")
        for name in fit["sets"]:
            columns = ("iota", "alpha", "chi2", "mask")
            iota, alpha, chi2, mask = (ArrayReader(group / name / n) for n in columns)
            maps |= {f"set/{name}/iota": iota, f"set/{name}/chi2": chi2}
            maps[f"set/{name}/visibility"] = RatioSource(alpha, iota)
            masks[f"set/{name}"] = mask
    jobs |= {name: partial(summarise, source) for name, source in maps.items()}
    return jobs | {f"flags/{n}": partial(summarise_flags, source) for n, source in masks.items()}


def _summaries(jobs: Mapping[str, partial[Any]], runtime: Runtime) -> dict[str, Any]:
    if not jobs:
        return {}
    columns = max(job.args[0].shape[1] for job in jobs.values())
    # A band and some copies of it in float64; windows of the spectrum; the sample.
    per_task = 64 * BAND_ROWS * columns + 128 * SEGMENT**2 + 8 * SAMPLE
    runtime = within_memory("the report", per_task, FIGURE_BYTES, runtime)
    results = run_tasks(call, list(jobs.values()), runtime, label="report maps")
    return dict(zip(jobs, results, strict=True))


def _offset(key: str, results: Mapping[str, Any]) -> MapContents:
    name, delta = key.rpartition("/")[2], results[f"{key}/delta"]
    # Pixel by pixel is the whole map already where no blocks were averaged.
    part = results[f"{key}/detail"] if delta.block > 1 and min(delta.shape) > DETAIL else None
    return MapContents(name, delta, results[f"{key}/sigma"], results.get(f"{key}/spectrum"), part)


def _set(
    group: Path, name: str, facts: dict[str, Any], allan: Mapping[str, Any], results: dict[str, Any]
) -> SetContents:
    maps = {of: results[f"set/{name}/{of}"] for of in ("iota", "visibility", "chi2")}
    columns = ("time", "B", "A", "phi", "dkx", "dky")
    series = {n: ArrayReader(group / name / n).read().astype(float) for n in columns}
    flags = results[f"flags/set/{name}"]
    return SetContents(name, facts, **maps, flags=flags, series=series, allan=allan.get(name))


# The diagnosis


def _diagnosis(folder: Path, *, nothing_to_do: bool) -> DiagnosisContents:
    facts, curves = read_json(folder / "diagnosis.json"), read_json(folder / "curves.json")
    for curve in curves:
        # In the file the significance is that of the statistic by itself.
        for key in ("significance", "significance_after"):
            curve[key] = sigmas_among(float(log_ndtr(-curve[key])), facts["statistics"])
    titles = {name: kind.title for name, kind in effects().items()}
    limit = sigmas_of(np.log(FALSE_ALARM_RATE))
    return DiagnosisContents(facts, curves, titles, limit, nothing_to_do)


# Words and tables


def _optional_json(path: Path) -> dict[str, Any]:
    contents: dict[str, Any] = read_json(path) if path.exists() else {}
    return contents


def _warnings(manifests: Mapping[str, Manifest], facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Sentences of the stages, and stages that were made from what is no longer there."""
    sentences = []
    for stage, manifest in manifests.items():
        for made_from, key in manifest.inputs.items():
            present = manifests.get(made_from)
            if present is not None and present.key != key:
                command = STAGES[stage].command.replace(" RUN", "")
                sentences.append(
                    f"{stage} was made from an earlier {made_from}: run 'pixcal {command}' again."
                )
    if "ingest" in manifests:
        sentences += [str(text) for text in manifests["ingest"].summary.get("warnings", ())]
    sentences += [str(text) for text in facts.get("warnings", ())]
    return tuple(sentences)


def _arrays(run_dir: Path, manifests: Mapping[str, Manifest]) -> dict[str, dict[str, Any]]:
    tables = _optional_json(run_dir / "ingest" / "frames.json")
    facts = manifests["ingest"].summary.get("arrays", {}) if "ingest" in manifests else {}
    shapes = {name: {"shape": fact["shape"][1:]} for name, fact in facts.items()}
    return {name: table | shapes.get(name, {}) for name, table in tables.items()}
