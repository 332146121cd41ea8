"""Report: one HTML page on the whole run."""

from collections import defaultdict
from collections.abc import Mapping
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
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.folder import INDEX
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import MANIFEST, Manifest, read_json
from pixcal.storage.stage import make, require, working

FIGURE_BYTES = 192 << 20  # Matplotlib, one figure and the page


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Write ``RUN/report/report.html`` and ``RUN/products/report.html``.

    Only ``RUN/reduce`` is required; missing results of later stages are marked as not measured.
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
    arrays, summary = _arrays(run_dir, manifests), advice(run_dir)
    columns = max((a["shape"][1] for a in arrays.values() if "shape" in a), default=0)
    made = _summaries(_jobs(run_dir, fit, "allan" in manifests), columns, runtime)
    return Contents(
        acquisition=read_json(run_dir / "ingest" / "acquisition.json"),
        stages=tuple(map(vars, manifests.values())),
        arrays=arrays,
        detector=DetectorContents(
            facts,
            made["detector"],
            _optional_json(run_dir / "reduce" / "figures_of_merit.json"),
            made["flags"].get("detector"),
        ),
        fit=fit,
        offsets=tuple(made["offsets"].values()),
        corrected=tuple(made["corrected"].values()),
        sets=tuple(made["set"].values()),
        flags=made["flags"].get("products"),
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


Jobs = dict[tuple[str, str], partial[Any]]  # by kind and name


def _jobs(run_dir: Path, fit: Mapping[str, Any] | None, with_allan: bool) -> Jobs:
    """The parts to read of the maps that the page shows."""
    calibration, group = run_dir / "reduce" / "calibration.zarr", run_dir / "fit" / "fit.zarr"
    masks = {"detector": calibration / "mask"}
    jobs: Jobs = {}
    for name in DETECTOR_MAPS:
        if (calibration / name / INDEX).exists():
            jobs["detector", name] = partial(summarise, ArrayReader(calibration / name))
    if fit is not None:
        masks["products"] = group / "mask"
        for name, product in maps_to_use(run_dir).items():
            jobs["offsets", name] = partial(_offsets, group / name, spectral=True)
            if product.stem != name:
                corrected = run_dir / "corrected" / "corrected.zarr" / name
                jobs["corrected", name] = partial(_offsets, corrected, spectral=False)
        allan = read_json(run_dir / "allan" / "allan.json")["sets"] if with_allan else {}
        for name, facts in fit["sets"].items():
            jobs["set", name] = partial(_set, group / name, facts, allan.get(name))
    for name, mask in masks.items():
        if (mask / INDEX).exists():
            jobs["flags", name] = partial(summarise_flags, ArrayReader(mask))
    return jobs


def _summaries(jobs: Jobs, columns: int, runtime: Runtime) -> dict[str, dict[str, Any]]:
    """Results by kind and name."""
    # A band and some copies of it in float64; windows of the spectrum; the sample.
    per_task = 64 * BAND_ROWS * columns + 128 * SEGMENT**2 + 8 * SAMPLE
    runtime = within_memory("the report", per_task, FIGURE_BYTES, runtime)
    results = run_tasks(call, list(jobs.values()), runtime, label="report maps")
    summaries: dict[str, dict[str, Any]] = defaultdict(dict)
    for (kind, name), result in zip(jobs, results, strict=True):
        summaries[kind][name] = result
    return summaries


def _offsets(path: Path, *, spectral: bool) -> MapContents:
    both = ArrayReader(path), ArrayReader(path.with_name(f"{path.name}_sigma"))
    delta, sigma = map(summarise, both)
    # Pixel by pixel is the whole map already where no blocks were averaged.
    part = detail(*both) if delta.block > 1 and min(delta.shape) > DETAIL else None
    return MapContents(path.name, delta, sigma, spectrum(*both) if spectral else None, part)


def _set(folder: Path, facts: dict[str, Any], allan: dict[str, Any] | None) -> SetContents:
    iota, alpha, chi2 = (ArrayReader(folder / name) for name in ("iota", "alpha", "chi2"))
    columns = ("time", "B", "A", "phi", "dkx", "dky")
    return SetContents(
        folder.name,
        facts,
        summarise(iota),
        summarise(RatioSource(alpha, iota)),
        summarise(chi2),
        summarise_flags(ArrayReader(folder / "mask")),
        {n: ArrayReader(folder / n).read().astype(float) for n in columns},
        allan,
    )


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
    return dict(read_json(path)) if path.exists() else {}


def _warnings(manifests: Mapping[str, Manifest], facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Warnings of the stages, and stages made from artefacts that have changed since."""
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
