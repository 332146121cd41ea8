"""A part of a run as evidence for effects: samples, maps, frames and calibration, in memory."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack
from pixcal.estimators.diagnosis.free_frames import free_frames
from pixcal.estimators.fringe_fit.fringes import FrameParameters, grid
from pixcal.model.acquisition import FringeScan
from pixcal.model.arrays import F64, Indices
from pixcal.model.errors import InputError
from pixcal.stages.fit.sweep import read_frames
from pixcal.stages.reduce.black_cut_off import Black
from pixcal.stages.reduce.ingested import Ingested, begin_mjd, starts_of
from pixcal.stages.reduced_set import ReducedSet
from pixcal.stages.tiles import Part
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.header_values import DAY_S
from pixcal.storage.manifest import read_json
from pixcal.storage.place import Local
from pixcal.storage.stage import read_acquisition, require

Window = tuple[tuple[int, int], tuple[int, int]]  # first row and column in, and shape of, a window

MAX_SAMPLES = 1 << 26  # samples of a set that are read into memory (about ten bytes each)


def load_evidence(run_dir: Path, part: Part | None = None, frames: slice = slice(None)) -> Evidence:
    """Evidence of some frames of a part of the window; without one, of the whole window."""
    require(run_dir, "reduce")
    if read_acquisition(run_dir).frames.fringes:
        require(run_dir, "fit")
    return evidence_of(run_dir, part, frames)


def evidence_of(
    run_dir: Local,
    part: Part | None = None,
    frames: slice = slice(None),
    *,
    black: Black | None = None,
    within: Window | None = None,
) -> Evidence:
    """The same of a whole run; ``black``: known of the camera from more frames."""
    acquisition = read_acquisition(run_dir)
    ingested = Ingested(run_dir / "ingest", black)
    ny, nx = ingested.shape
    y, x = part or ((0, ny), (0, nx))
    (y0, x0), window = within or ((0, 0), (ny, nx))
    origin = (y0 + y[0], x0 + x[0])
    calibration = run_dir / "reduce" / "calibration.zarr"
    maps: dict[str, Any] = {
        name: ArrayReader(calibration / name).read(y, x).astype(float)
        for name in ("bias", "dark_rate", "flat")
    }
    fringes = {}
    for listed in acquisition.frames.fringes:
        fringes[listed.name] = _fringes(run_dir, ingested, listed, (y, x), frames, (origin, window))
    used = read_json(run_dir / "reduce" / "reduce.json")
    gain = used["gain_e_per_adu"]
    without_dark = None if black is None else black.without_dark
    excess = max(1.0 if black is None else black.excess_noise_factor, excess_noise_factor(gain))
    if without_dark is None:
        without_dark = bool(gain.get("without_dark"))
    return Evidence(
        fringes=fringes,
        stacks=_stacks(ingested, (y, x)),
        gain=float(gain["used"]),
        read_noise=float(used["read_noise_e"]["used"]),
        amplifier_noise=float(used["read_noise_e"]["before_rounding"]),
        read_noise_error=float(used["read_noise_e"].get("used_error") or np.nan),
        **maps,
        good=ArrayReader(calibration / "mask").read(y, x) == 0,
        lowest_adu=ingested.lowest_adu,
        saturation_adu=min(map(ingested.saturation, ingested.arrays)),
        pitch_um=acquisition.detector.pitch_um,
        wavelength_nm=acquisition.fibres.wavelength_nm,
        distance_mm=acquisition.fibres.distance_mm,
        origin=origin,
        photon_transfer=_photon_transfer(gain),
        step_adu=max(int(ingested.quantum), 1),
        neighbours=tuple((y, x) for y, x in gain["neighbours"]),
        without_dark=without_dark,
        excess_noise_factor=excess,
        subtracted_dark=float(used.get("subtracted_dark_e_s") or 0.0),
    )


def _photon_transfer(gain: dict[str, Any]) -> tuple[float, float, float]:
    """Gain of the noise, its error and reduced chi-square; nan where there is none."""
    measured = gain.get("of_noise") or [gain.get(key) for key in ("measured", "error")]
    value, error, chi2 = np.array([*measured, gain.get("chi2_reduced")], float).tolist()
    return value, error, chi2


def excess_noise_factor(gain: dict[str, Any]) -> float:
    """F² of electrons that are multiplied, else 1."""
    return float(gain["measured"] / gain["of_noise"][0]) if gain.get("of_noise") else 1.0


def _fringes(
    run_dir: Local, ingested: Ingested, scan: FringeScan, part: Part, frames: slice, within: Window
) -> FringeEvidence:
    name, (origin, window) = scan.name, within
    source = ReducedSet(run_dir / "reduce" / "reduced.zarr" / name)
    swept = run_dir / "sweep" / "sweep.zarr" / name
    fitted = run_dir / "fit" / "fit.zarr" / name
    y, x = part
    first, last, step = frames.indices(source.n_frames)
    if step != 1:
        raise ValueError("consecutive frames are needed")
    if (last - first) * (y[1] - y[0]) * (x[1] - x[0]) > MAX_SAMPLES:
        raise InputError(
            f"fringe set {name!r}: more than {MAX_SAMPLES} samples; use fewer "
            "frames or a smaller window"
        )
    codes = source.signal.read((first, last), y, x).astype(np.uint16, copy=False)
    coding = source.coding
    electrons = coding.electrons(codes)
    np.copyto(electrons, np.float32(np.nan), where=codes == coding.fill)

    fit = read_frames(swept)
    centre = ((y[0] + y[1] - 1) / 2, (x[0] + x[1] - 1) / 2)
    start = FrameParameters(fit.at(*centre)[frames], fit.dk[frames], centre)
    facts = read_json(run_dir / "fit" / "fit.json")["sets"][name]
    theta = fitted_theta(swept, part, fit.reference)
    good = (ArrayReader(swept / "mask").read(y, x) == 0) & np.isfinite(theta).all(axis=0)
    read = ArrayReader(source.folder / "read_variance").read(y, x).astype(float)
    shot = ArrayReader(source.folder / "shot_factor").read(y, x).astype(float)
    (free, covariance), *halves = free_frames(codes, coding, start, theta, read, shot, good)
    table = ingested.tables[f"fringes/{name}"]
    exposure = table["exptime_s"][0]
    made = FringeEvidence(
        name=name,
        baseline_mm=scan.baseline_mm,
        k=(float(facts["kx"]), float(facts["ky"])),
        origin=origin,
        window=window,
        frame=frame_numbers(table)[frames],
        time_s=source.time_s()[frames],
        exptime_s=np.nan if exposure is None else float(exposure),
        electrons=electrons,
        adu=ingested.arrays[f"fringes/{name}"].read((first, last), y, x),
        g=start.g,
        dk=start.dk,
        free=free,
        free_covariance=covariance,
        theta=theta,
        sigma=ArrayReader(swept / "sigma").read(y, x).astype(float),
        delta=ArrayReader(fitted / "delta").read(y, x).astype(float),
        good=good,
        read_variance=read,
        shot_factor=shot,
        start_s=starts_of(ingested.tables)[f"fringes/{name}"],
    )
    vars(made)["halves"] = tuple(halves)  # as the property would keep them
    return made


def fitted_theta(swept: Local, part: Part, reference: tuple[float, float]) -> F64:
    """Maps (iota, alpha sin psi, alpha cos psi) of a part, from those of the sweep."""
    y, x = part
    iota, alpha, phase = (
        ArrayReader(swept / name).read(y, x).astype(float) for name in ("iota", "alpha", "phase")
    )
    rows, columns = grid((y[1] - y[0], x[1] - x[0]))
    rows, columns = rows + (y[0] + y[1] - 1) / 2, columns + (x[0] + x[1] - 1) / 2
    kx, ky = read_json(swept / "scout.json")["k"]
    psi = phase + kx * (columns - reference[1]) + ky * (rows - reference[0])
    return np.stack([iota, alpha * np.sin(psi), alpha * np.cos(psi)])


def _stacks(ingested: Ingested, part: Part) -> tuple[Stack, ...]:
    """Calibration frames of a part, by kind and exposure time."""
    stacks = []
    for kind in ("bias", "dark", "flat"):
        if kind not in ingested.tables:
            continue
        table: dict[str, list[Any]] = ingested.tables[kind]
        exposures = np.array(table["exptime_s"], float)
        frames = ingested.arrays[kind].read((0, len(exposures)), *part)
        times = np.asarray(table["time_s"], float)
        for group in groups(table):
            adu, start = frames[group].astype(np.float32), starts_of(ingested.tables)[kind]
            step = int(table["step"][group[0]]) if table.get("step") else 0
            exposure, numbers = float(exposures[group[0]]), frame_numbers(table)[group]
            last = int(table["last"][group[0]]) if table.get("last") else -1
            stacks.append(Stack(kind, exposure, numbers, times[group], adu, start, step, last))
    return tuple(stacks)


def groups(table: Mapping[str, list[Any]]) -> list[Indices]:
    """Numbers of the frames of each exposure time and lamp, in ascending order; unknown last."""
    exposures = np.nan_to_num(np.array(table["exptime_s"], float), nan=np.inf)
    steps = np.array(table.get("step") or np.zeros(len(exposures)), int)
    pairs = sorted(set(zip(exposures.tolist(), steps.tolist(), strict=True)))
    return [np.flatnonzero((exposures == t) & (steps == step)) for t, step in pairs]


def frame_numbers(table: Mapping[str, list[Any]]) -> Indices:
    """Numbers (t,) of the frames of an array, some of which may be left out."""
    return np.array(table["frame"] if "frame" in table else range(len(table["time_s"])), int)


def frame_days(table: Mapping[str, list[Any]]) -> F64:
    """Time (t,) of the frames of an array, days; a cube may have the stamp of its first plane."""
    return np.asarray(begin_mjd(table) + np.array(table["time_s"], float) / DAY_S)
