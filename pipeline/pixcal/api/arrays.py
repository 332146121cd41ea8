"""From arrays in memory to maps, through the same stages as frames in files."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pixcal.api import commands
from pixcal.api.opened import Run
from pixcal.engine.run import Runtime
from pixcal.model.acquisition import SCHEMA, Acquisition
from pixcal.model.config import StrPath, parse
from pixcal.model.errors import InputError
from pixcal.model.yaml_file import to_yaml
from pixcal.storage.products import FrameWriter

Frames = NDArray[Any]
# frames (t, y, x) and their exposure time (s), by the name of the file that they go to
Stacks = dict[str, tuple[Frames, float | None]]

EXACT = 1 << 24  # whole numbers up to here are exact in float32


def calibrate(
    frames: Mapping[str, ArrayLike],
    baselines_mm: Mapping[str, tuple[float, float]],
    *,
    bias: ArrayLike | None = None,
    darks: Mapping[float, ArrayLike] | None = None,
    flats: Mapping[float, ArrayLike] | None = None,
    pitch_um: float,
    gain_e_per_adu: float,
    read_noise_e: float,
    wavelength_nm: float,
    distance_mm: float,
    exptime_s: float | None = None,
    frame_period_s: float | None = None,
    saturation_adu: float | None = None,
    gain: Literal["declared", "measured"] = "declared",
    model: str = "auto",
    out: StrPath | None = None,
    runtime: Runtime | None = None,
) -> Run:
    """Measure the offsets of pixels from frames in memory.

    The frames are written as FITS, ingested, reduced and fitted; the results are the same as
    `run` gives from files.

    Parameters
    ----------
    frames : mapping
        For each fringe set, by name, its frames (t, y, x) in ADU, in the order of time: uint8,
        uint16, other whole numbers below 2**24, or floating point (stored as float32).
    baselines_mm : mapping
        For each set, fibre B minus fibre A along x and y, mm.
    bias : (t, y, x), optional
        Frames without light and of the shortest exposure, ADU.
    darks, flats : mapping, optional
        Frames (t, y, x) without light, and in uniform light, by exposure time in seconds, ADU.
    pitch_um, wavelength_nm, distance_mm : float
        Pixel pitch, laser wavelength, nominal distance from the fibres to the detector.
    gain_e_per_adu, read_noise_e : float
        Declared conversion gain, e-/ADU, and read noise, e- rms.
    exptime_s : float, optional
        Exposure time of the fringe frames; with darks it is needed.
    frame_period_s : float, optional
        Time from frame to frame; without it times are frame numbers.
    saturation_adu : float, optional
        Samples at or above this level are saturated.
    gain : {"declared", "measured"}
        Gain to use: declared, or measured from the flats.
    model : str
        Shape of the fringes: ``paraxial``, ``hyperbolic``, or ``auto``, chosen from the data.
    out : str or path, optional
        A new directory to keep the run in; by default it is a temporary one, which is removed when
        the `Run` is no longer referred to.
    runtime : Runtime, optional

    Returns
    -------
    Run
        Fitted, with its Allan deviation; `write_report` adds the page.

    Raises
    ------
    InputError
        If arrays do not match, a value is out of range, ``out`` is not empty, or the frames
        hold no fringes that can be fitted.
    """
    stacks = _stacks(frames, bias, darks or {}, flats or {}, exptime_s)
    if darks and exptime_s is None:
        raise InputError(
            "exptime_s: missing; give the exposure time in s, which scales the dark signal"
        )
    described = _describe(
        stacks,
        baselines_mm,
        {"pitch_um": pitch_um, "gain_e_per_adu": gain_e_per_adu, "read_noise_e": read_noise_e}
        | {"saturation_adu": saturation_adu},
        {"wavelength_nm": wavelength_nm, "distance_mm": distance_mm}
        | {"frame_period_s": frame_period_s},
    )
    kept = TemporaryDirectory(prefix="pixcal-") if out is None else None
    run = Path(kept.name) / "run" if kept else Path(str(out))
    if run.exists() and any(run.iterdir()):
        raise InputError(f"out: {run} is not empty; choose a new directory")
    run.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".frames-", dir=run) as folder:
        _write(described, stacks, Path(folder))
        commands.ingest(folder, run, copy=True, runtime=runtime)
    commands.reduce(run, gain=gain, runtime=runtime)
    commands.fit(run, model=model, runtime=runtime)
    commands.allan(run, runtime=runtime)
    return Run(run, kept)


def _stacks(
    frames: Mapping[str, ArrayLike],
    bias: ArrayLike | None,
    darks: Mapping[float, ArrayLike],
    flats: Mapping[float, ArrayLike],
    exptime_s: float | None,
) -> Stacks:
    """All frames, checked against each other."""
    given: list[tuple[str, str, ArrayLike, float | None]] = [
        (f"fringes/{name}", f"frames[{name!r}]", stack, exptime_s) for name, stack in frames.items()
    ]
    if not given:
        raise InputError("frames: empty; give the frames of a fringe set by its name")
    if bias is not None:
        given.append(("bias/0", "bias", bias, 0.0))
    for kind, steps in (("dark", darks), ("flat", flats)):
        for number, (exposure, stack) in enumerate(steps.items()):
            if not exposure >= 0:
                raise InputError(f"{kind}s[{exposure!r}]: not an exposure time in seconds")
            given.append((f"{kind}/{number}", f"{kind}s[{exposure!r}]", stack, exposure))
    stacks: Stacks = {}
    window: tuple[int, ...] = ()
    for file, name, stack, seconds in given:
        array = _checked(name, stack)
        window = window or array.shape[1:]
        if array.shape[1:] != window:
            raise InputError(
                f"{name}: frames of {array.shape[1:]} pixels (y, x), where the first array has "
                f"{window}; all frames must have the same size"
            )
        stacks[file] = array, seconds
    return stacks


def _checked(name: str, stack: ArrayLike) -> Frames:
    """Frames in a type that a FITS file of frames can hold."""
    array = np.asarray(stack)
    if array.ndim != 3 or 0 in array.shape:
        raise InputError(f"{name}: shape {array.shape}; frames are (t, y, x), no axis may be zero")
    if array.dtype.kind not in "uif":
        raise InputError(f"{name}: {array.dtype} samples; give whole numbers or floating point")
    if array.dtype in (np.uint8, np.uint16) or array.dtype.kind == "f":
        return array
    low, high = int(array.min()), int(array.max())
    if max(-low, high) > EXACT:
        raise InputError(f"{name}: samples from {low} to {high} are beyond ±{EXACT}; divide them")
    return array


def _describe(
    stacks: Stacks,
    baselines_mm: Mapping[str, tuple[float, float]],
    detector: dict[str, Any],
    optics: dict[str, Any],
) -> Acquisition:
    """Contents of ``acquisition.yaml``."""
    names = [file.removeprefix("fringes/") for file in stacks if file.startswith("fringes/")]
    if unequal := set(names) ^ set(baselines_mm):
        raise InputError(
            f"baselines_mm: {', '.join(sorted(unequal))}: each set of frames needs a baseline of "
            "the same name"
        )
    kinds = {
        kind: [f"{kind}/*.fits"]
        for kind in ("bias", "dark", "flat")
        if any(file.startswith(f"{kind}/") for file in stacks)
    }
    fringes = [
        {"name": name, "files": [f"fringes/{name}.fits"], "baseline_mm": baselines_mm[name]}
        for name in names
    ]
    plain = {
        "schema": SCHEMA,
        "detector": detector,
        "optics": optics,
        "frames": kinds | {"fringes": fringes},
    }
    return parse(Acquisition, plain, "pixcal.calibrate")


def _write(described: Acquisition, stacks: Stacks, folder: Path) -> None:
    for file, (stack, exposure) in stacks.items():
        path = folder / f"{file}.fits"
        path.parent.mkdir(exist_ok=True)
        cards = {} if exposure is None else {"EXPTIME": (exposure, "[s] exposure time")}
        dtype = str(stack.dtype) if stack.dtype in (np.uint8, np.uint16) else "float32"
        writer = FrameWriter.create(path, stack.shape, dtype, cards)
        for number, frame in enumerate(stack):
            writer.write_rows(0, frame.astype(dtype), number)
        writer.finish()
    (folder / "acquisition.yaml").write_text(to_yaml(described), encoding="utf-8")
