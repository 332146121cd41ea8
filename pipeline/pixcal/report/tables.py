"""Tables of the page: the numbers of every stage. Templates call them by name."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pixcal.model.flags import PixelFlag
from pixcal.report.contents import Contents, SetContents
from pixcal.report.map_summary import FlagSummary, MapSummary
from pixcal.report.text import (
    date_of_mjd,
    duration,
    exact,
    mode_in_words,
    number,
    share,
    unit,
    with_error,
)

_GAIN_WORDS = {
    "chi2_reduced": "reduced chi-square",
    "neighbours": "covariance included at (rows, columns)",
    "used_from": "gain used:",
    "with_rounding": "with rounding",
}
# of the steps of flats: heading and significant digits
_STEPS = {
    "exptime_s": ("exposure (s)", 4),
    "frames": ("frames", 4),
    "level_adu": ("level (ADU)", 5),
    "level_e": ("level (e⁻)", 5),
    "deviation_percent": ("deviation (%)", 2),
}
_REDUCTION_SHOWN = (
    "schema",
    "warnings",
    "flags",
    "figures_of_merit",
    "gain_e_per_adu",
    "read_noise_e",
    "linearity",
    "sets",
    "quantisation",
)


@dataclass(frozen=True)
class Table:
    """A table; the first column names the rows."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


def allan(measured: Sequence[SetContents]) -> Table:
    """Slope, knee and batches of each set."""
    rows = []
    for s in measured:
        a = s.allan or {}
        knee, gaps = a.get("knee_frames"), a.get("gaps")
        knee = "none" if knee is None else f"{number(round(knee))} frames"
        batches = number(a.get("n_batches")), number(a.get("batch_frames")), number(gaps)
        rows.append([s.name, with_error(a.get("slope"), a.get("slope_err")), knee, *batches])
    header = ["set", "slope", "knee", "batches", "frames per batch", "gaps"]
    return Table("Allan deviation in numbers", header, rows)


def flags(masks: Mapping[str, FlagSummary]) -> Table:
    """Number of pixels with each flag, one column per mask."""
    rows = []
    fitted = any(title.startswith("set ") for title in masks)
    for flag in PixelFlag:
        if flag is PixelFlag.BAD_FIT and not fitted:
            continue
        counts = [_count(s.counts[flag.value], s) for s in masks.values()]
        rows.append([flag.words, flag.meaning, *counts])
    rows.append(["any", "masked", *(_count(s.masked, s) for s in masks.values())])
    return Table("Pixels flagged", ["flag", "meaning", *masks], rows)


def _count(pixels: int, summary: FlagSummary) -> str:
    ny, nx = summary.shape
    return f"{number(pixels)} ({share(pixels, ny * nx)})"


def reduction(facts: Mapping[str, Any]) -> Iterator[Table]:
    """Gain and read noise side by side, the steps of the flats, then the input of each set."""
    rows = []
    for key, label in (("gain_e_per_adu", "gain (e⁻/ADU)"), ("read_noise_e", "read noise (e⁻)")):
        entry = facts.get(key)
        if isinstance(entry, Mapping):
            declared, used = (number(entry.get(k), 4) for k in ("declared", "used"))
            measured = with_error(entry.get("measured"), entry.get("error"))
            others = {
                words: " ".join(map(str, map(tuple, v))) if isinstance(v, list) else number(v, 4)
                for k, words in _GAIN_WORDS.items()
                if (v := entry.get(k))
            }
            rows.append([label, declared, measured, used, _listed(others)])
    if rows:
        yield Table("Gain and read noise", ["", "declared", "measured", "used", ""], rows)
    straight = facts.get("linearity") or {}
    if is_table(straight.get("levels")):
        intercept = number(straight.get("intercept_adu"), 2)
        title = f"Exposure-time steps of the flats, intercept {intercept} ADU"
        rows = [
            [number(level.get(key), digits) for key, (_, digits) in _STEPS.items()]
            for level in straight["levels"]
        ]
        yield Table(title, [words for words, _ in _STEPS.values()], rows)
    sets = {
        name: dict(_flat({k: v for k, v in entry.items() if k != "flags"}))
        | {f"quantisation.{k}": v for k, v in facts.get("quantisation", {}).get(name, {}).items()}
        for name, entry in (facts.get("sets") or {}).items()
    }
    if sets:
        yield _columns_table("Fringe sets as reduced", sets)
    rest = {k: v for k, v in facts.items() if k not in _REDUCTION_SHOWN}
    end = rest.pop("saturation_adu", None)
    if end:
        rows = [
            ["declared (ADU)", number(end["declared"], 5)],
            ["found in the flats (ADU)", number(end["found"], 5)],
            ["used (ADU)", number(end["used"], 5)],
            ["flat levels excluded", number(end["levels_left_out"])],
            ["flat frames at full well", number(len(end["full_frames"]))],
        ]
        yield Table("Saturation of the samples", ["", ""], rows)
    if dark := rest.pop("subtracted_dark_e_s", 0.0):
        rest["dark signal subtracted by the camera (e⁻/s)"] = dark
    rows = [[key, _plain(value)] for key, value in _flat(rest) if value is not None]
    if rows:
        yield Table("Other numbers of the reduction", ["quantity", "value"], rows)


def _listed(facts: Mapping[str, Any]) -> str:
    return "; ".join(f"{key} {_plain(value)}" for key, value in facts.items())


def merit(facts: Mapping[str, Any]) -> Iterator[Table]:
    """Figures of merit, as in a data sheet of the detector."""
    rows = [
        [f["title"], with_error(f["value"], f["error"]), unit(f["unit"]), unit(f["note"])]
        for f in (facts.get("figures_of_merit") or {}).values()
    ]
    if rows:
        gain = "declared" if facts["gain_e_per_adu"]["measured"] is None else "measured"
        title = f"Figures of merit (EMVA 1288), with the {gain} gain"
        yield Table(title, ["figure", "value", "unit", ""], rows)


def saturation(facts: Mapping[str, Any]) -> float | None:
    """Level (ADU) where the detector saturates, if the flats reach it."""
    full = (facts.get("figures_of_merit") or {}).get("saturation")
    return full["value"] if full and full["error"] is not None else None


def patterns(curves: Mapping[str, Any]) -> dict[str, Any]:
    """Measured patterns of DSNU and PRNU."""
    return {key.upper(): curves[key] for key in ("dsnu", "prnu") if key in curves}


def calibration(maps: Sequence[tuple[str, str, MapSummary]]) -> Table:
    """Location and width of the calibration maps."""
    rows = [
        [title, unit, *(number(v, 4) for v in (m.median, m.robust_std, m.mean, m.std))]
        for title, unit, m in maps
    ]
    header = ["map", "unit", "median", "robust σ", "mean", "σ"]
    return Table("Calibration maps in numbers", header, rows)


def removed_modes(sets: Sequence[SetContents]) -> Iterator[Table]:
    """The removed modes; sets that have the same ones share a table."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for fringes in sets:
        groups.setdefault(tuple(fringes.facts.get("removed_modes", ())), []).append(fringes.name)
    for modes, names in groups.items():
        rows = [[mode, mode_in_words(mode)] for mode in modes]
        title = f"Set{'s' if len(names) > 1 else ''} {', '.join(names)}"
        yield Table(title, ["mode", "description"], rows)


def provenance(contents: Contents) -> Iterator[Table]:
    """All of fit.json, the frames, the stages, and the acquisition as understood."""
    if contents.fit is not None:
        yield from _fit(contents.fit)
    if contents.arrays:
        yield _frames(contents.arrays)
    yield from _stages(contents.stages)
    # Detector frames alone have no optics.
    listed = {key: value for key, value in contents.acquisition.items() if value is not None}
    rows = [row for row in _flat_rows(listed) if row[0] != "frames.fringes"]
    yield Table("Acquisition as understood", ["key", "value"], rows)


def _columns_table(title: str, columns: Mapping[str, Mapping[str, Any]]) -> Table:
    """The same quantities of several sets, one column each."""
    keys = dict.fromkeys(key for facts in columns.values() for key in facts)
    rows = [[key, *(_plain(facts.get(key)) for facts in columns.values())] for key in keys]
    return Table(title, ["quantity", *columns], rows)


def is_table(value: Any) -> bool:
    """Whether a value is a list of mappings."""
    return isinstance(value, list) and bool(value) and all(isinstance(v, Mapping) for v in value)


def _stages(stages: Sequence[Mapping[str, Any]]) -> Iterator[Table]:
    """Inputs of each stage, by key; and the digests of the files."""
    present = {stage["stage"]: stage["key"] for stage in stages}
    rows, files = [], []
    for stage in stages:
        # The acquisition has a table of its own.
        options = {k: v for k, v in stage["config"].items() if k != "acquisition"}
        made_from = [
            name if present.get(name, key) == key else f"another {name}, {key}"
            for name, key in stage["inputs"].items()
        ]
        facts = [stage["stage"], stage["pixcal"], str(stage["format"]), stage["key"]]
        rows.append([*facts, ", ".join(made_from) or "–", _listed(options) or "–"])
        files += [[name, key] for name, key in stage["inputs"].items() if name not in present]
    yield Table("Stages", ["stage", "pixcal", "format", "key", "made from", "options"], rows)
    if files:
        yield Table("Digests of the files", ["array", "digest"], files)


def _fit(fit: Mapping[str, Any]) -> Iterator[Table]:
    """All numbers of fit.json; the removed modes have a section of their own."""
    sets = {
        name: dict(_flat({k: v for k, v in facts.items() if k != "removed_modes"}))
        for name, facts in fit["sets"].items()
    }
    yield _columns_table("fit.json, each set", sets)
    rest = {key: value for key, value in fit.items() if key != "sets"}
    yield Table("fit.json, all sets together", ["quantity", "value"], _flat_rows(rest))


def _frames(arrays: Mapping[str, Mapping[str, Any]]) -> Table:
    rows = []
    for name, a in arrays.items():
        times, source = _known(a, "time_s"), (a.get("time_source") or ["–"])[0]
        exposures = sorted(set(_known(a, "exptime_s")))
        listed = ", ".join(exact(v) for v in exposures[:8]) + ", …" * (len(exposures) > 8)
        row = {
            "array": name,
            "files": number(len(set(a["file"]))),
            "frames": number(len(a["file"])),
            "x × y": f"{a['shape'][1]}\u00a0×\u00a0{a['shape'][0]}" if a.get("shape") else "–",
            "first frame (UTC)": date_of_mjd(min(_known(a, "mjd"))) if _known(a, "mjd") else "–",
            "duration": duration(max(times) - min(times)) if times and source != "number" else "–",
            "exposures (s)": listed or "–",
            "temperature (°C)": _span(_known(a, "temperature_c")),
            "times from": {"number": "frame numbers"}.get(source, source),
        }
        rows.append(row)
    return Table("Frames", [*rows[0]], [[*row.values()] for row in rows])


def _known(array: Mapping[str, Any], column: str) -> list[float]:
    return [value for value in array.get(column, ()) if value is not None]


def _span(values: Sequence[float]) -> str:
    if not values:
        return "–"
    low, high = (f"{v:.1f}" for v in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def _flat(data: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of nested data; lists of words or numbers stay whole."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            yield from _flat(value, f"{key}.{name}" if key else str(name))
    elif isinstance(data, list) and any(isinstance(v, (Mapping, list)) for v in data):
        for n, value in enumerate(data):
            yield from _flat(value, f"{key}[{n}]")
    else:
        yield key, data


def _flat_rows(data: Any) -> list[list[str]]:
    return [[key, _plain(value)] for key, value in _flat(data)]


def _plain(value: Any) -> str:
    if isinstance(value, list):
        shown = ", ".join(_plain(v) for v in value[:12])
        return shown + (f", … ({len(value)} in all)" if len(value) > 12 else "") or "–"
    if isinstance(value, Mapping):  # such as an effect and its parameters: the first value names it
        return _plain(next(iter(value.values()), ""))
    if value == "":
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return exact(value)
