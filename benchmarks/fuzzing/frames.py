"""Frames that a bench should not have recorded: their maps are compared with the truth."""

from typing import Any

import numpy as np
from astropy.io import fits

from fuzzing.laws import Broken, Case, Kind, calibrate
from fuzzing.night import Night

CASES = 150
"""Of each kind: every one is calibrated."""

INTEGERS = ("uint16", "int32", "uint8", "int16")


def _check(case: Case, night: Night, dtype: str = "uint16") -> None:
    """Calibrate an acquisition and compare its maps with the truth."""
    run = case.folder / "run"
    more = ["report"] if case.number % 50 == 49 else []
    calibrate(night.write(case.folder / "acq", dtype), run, ["acq"], *more)
    night.check(run)


def _window(case: Case) -> tuple[int, int]:
    ny, nx = case.rng.integers(16, 40, 2)
    return int(ny), int(nx)


def _holes(case: Case) -> None:
    """NaN and infinities anywhere: a few samples, whole pixels, rows, frames, or everything."""
    night = Night(case.rng, _window(case))
    names = [str(case.pick(*night.frames))] if case.rng.random() < 0.7 else list(night.frames)
    for name in names:
        frames = night.frames[name]
        bad = {
            "samples": lambda f: case.rng.random(f.shape) < 10 ** case.rng.uniform(-4, 0),
            "pixels": lambda f: np.broadcast_to(case.rng.random(f.shape[1:]) < 0.1, f.shape),
            "rows": lambda f: np.broadcast_to(case.rng.random((f.shape[1], 1)) < 0.2, f.shape),
            "frames": lambda f: np.broadcast_to(case.rng.random((len(f), 1, 1)) < 0.3, f.shape),
            "all": lambda f: np.ones(f.shape, bool),
        }[str(case.pick("samples", "samples", "pixels", "rows", "frames", "all"))](frames)
        value = case.pick(np.nan, np.nan, np.inf, -np.inf, 1e38)
        frames[bad] = value
        if name in night.vectors:
            night.spoilt |= bad.all(axis=0)
    _check(case, night, "float32")


def _saturated(case: Case) -> None:
    """Light beyond the converter or a declared level: in some pixels, frames, samples, or all."""
    level = 10 ** case.rng.uniform(4.3, 5.5) if case.rng.random() < 0.3 else 2e4
    night = Night(case.rng, _window(case), level=level, gain=float(case.pick(1.0, 0.5, 4.0)))
    top = 65535.0
    if case.rng.random() < 0.3:
        top = float(10 ** case.rng.uniform(2, 5))
        night.described["detector"]["saturation_adu"] = top
        night.frames = {name: np.minimum(f, top) for name, f in night.frames.items()}
    for name in night.vectors:
        frames = night.frames[name]
        shape = {
            "frames": (len(frames), 1, 1),
            "pixels": (1, *night.shape),
            "samples": frames.shape,
        }[str(case.pick("frames", "pixels", "samples"))]
        some = case.rng.random(shape) < float(case.pick(0.0, 1e-3, 0.05, 0.5, 1.0))
        frames[np.broadcast_to(some, frames.shape)] = max(top, 65535.0)
        night.spoilt |= (frames >= min(top, 65535.0)).all(axis=0)
    _check(case, night)


def _constant(case: Case) -> None:
    """Constant frames, or one frame repeated, in one array or in all."""
    night = Night(case.rng, _window(case))
    value = float(case.pick(0, 1, 300, 1000, 65534, 65535))
    names = list(night.frames) if case.rng.random() < 0.3 else [str(case.pick(*night.frames))]
    copies = case.rng.random() < 0.5
    for name in names:
        frames = night.frames[name]
        frames[...] = frames[:1] if copies else value
    _check(case, night, str(case.pick("uint16", "float32")))
    if set(names) & set(night.vectors):
        raise Broken("a map from frames that are all the same")


def _no_fringes(case: Case) -> None:
    """No contrast, or so little that the noise hides it."""
    contrast = float(case.pick(0.0, 0.0, 1e-4, 1e-3, 3e-3, 1e-2))
    night = Night(case.rng, _window(case), visibility=contrast, count=int(case.pick(12, 40, 100)))
    if case.rng.random() < 0.3:
        night.frames[str(case.pick(*night.vectors))][...] = case.rng.integers(0, 65535, night.shape)
    _check(case, night)


def _noise_only(case: Case) -> None:
    """Frames of noise of any strength and kind, which no fringe made."""
    night = Night(case.rng, _window(case), count=int(case.rng.integers(6, 80)))
    for name in night.vectors:
        shape = night.frames[name].shape
        night.frames[name] = {
            "white": lambda s: case.rng.normal(2e4, 10 ** case.rng.uniform(0, 4), s),
            "uniform": lambda s: case.rng.uniform(0, 65535, s),
            "levels": lambda s: np.broadcast_to(case.rng.uniform(0, 6e4, (s[0], 1, 1)), s),
            "spikes": lambda s: np.where(case.rng.random(s) < 1e-3, 6e4, 300.0),
            "drift": lambda s: np.cumsum(case.rng.normal(0, 30, s), axis=0) + 2e4,
        }[str(case.pick("white", "uniform", "levels", "spikes", "drift"))](shape)
    calibrate(night.write(case.folder / "acq"), case.folder / "run", ["acq"])
    maps = (case.folder / "run" / "products").glob("delta_*.fits")
    if not all((fits.getdata(file, "MASK") != 0).all() for file in maps):
        raise Broken("a map from frames that hold no fringes")


def _any_period(case: Case) -> None:
    """Fringes from half a pixel to ten windows wide, along any axis."""
    shape = _window(case)
    vectors = {}
    for name in ("one", "two")[: int(case.pick(1, 2))]:
        wide = case.rng.random() < 0.5
        period = case.rng.uniform(1.0, 10) * max(shape) if wide else case.rng.uniform(0.5, 3)
        k, angle = 2 * np.pi / period, case.rng.uniform(0, 2 * np.pi)
        vectors[name] = (k * np.cos(angle), k * np.sin(angle))
    _check(case, Night(case.rng, shape, vectors=vectors))


def _few_frames(case: Case) -> None:
    """One frame to a dozen, of a set and of the bias."""
    count, bias = int(case.rng.integers(1, 13)), int(case.rng.integers(1, 11))
    _check(case, Night(case.rng, _window(case), count=count, n_bias=bias))


def _small_window(case: Case) -> None:
    """A window of 1 x 1 to 12 x 12 pixels (7 x 5 often), with fringes to suit it or not."""
    shape = tuple(int(n) for n in case.rng.integers(1, 13, 2))
    if case.rng.random() < 0.3:
        shape = (7, 5)
    period = case.rng.uniform(2.05, max(2.1, *shape))
    k = 2 * np.pi / period
    vectors = {"one": (k, 0.0), "two": (0.0, k)}
    count = int(case.pick(6, 20, 80, 300))
    _check(case, Night(case.rng, (shape[0], shape[1]), count=count, vectors=vectors))


def _masked(case: Case) -> None:
    """Calibration frames that mask many pixels or all: hot, dead, noisy, without data."""
    night = Night(case.rng, _window(case))
    share = float(case.pick(0.1, 0.5, 0.9, 1.0))
    bad = case.rng.random(night.shape) < share
    what = case.pick("noisy", "missing", "dead", "flat missing")
    if what == "noisy":
        night.frames["bias"][:, bad] += case.rng.normal(0, 500, (night.n_bias, bad.sum()))
    elif what == "missing":
        night.frames["bias"][:, bad] = np.nan
        night.spoilt |= bad
    else:
        shape = (10, *night.shape)
        flat = case.rng.poisson(2e4, shape) + night.bias
        flat[:, bad] = night.bias if what == "dead" else np.nan
        night.frames["flat"] = flat
        night.described["frames"]["flat"] = ["flat.fits"]
        if what == "flat missing":
            night.spoilt |= bad
    _check(case, night, "float32")


def _mixed_shapes(case: Case) -> None:
    """One array has frames of another size."""
    night = Night(case.rng, _window(case))
    name = str(case.pick(*night.frames))
    dy, dx = (int(n) for n in case.rng.integers(0, 3, 2))
    ny, nx = night.shape
    night.frames[name] = night.frames[name][:, : ny - dy, : nx - dx]
    _check(case, night)
    if dy or dx:
        raise Broken("frames of different sizes were taken")


def _bias_above(case: Case) -> None:
    """Bias frames brighter than the fringes, in all pixels or some; or below zero."""
    night = Night(case.rng, _window(case), level=10 ** case.rng.uniform(1, 4.3))
    bad = case.rng.random(night.shape) < float(case.pick(0.05, 0.5, 1.0))
    night.frames["bias"][:, bad] += case.pick(3e3, 2e4, 6e4, -500.0)
    # With other light than the samples have, visibility and weights are wrong, offsets are not.
    _check(case, night, str(case.pick("uint16", "int32", "float32")))


def _wrong_numbers(case: Case) -> None:
    """Numbers of the detector and the bench that are far from the truth, zero, huge or none."""
    night = Night(case.rng, _window(case))
    wrong: dict[str, Any] = {
        "gain_e_per_adu": (0, -1.0, 1e-300, 1e-6, 0.01, 0.5, 3.0, 100.0, 1e6, 1e7, 1e300, np.nan),
        "read_noise_e": (0, -1, 1e-300, 1.0, 100.0, 1e4, 1e6, np.inf, np.nan, 1e300),
        "pitch_um": (0, -4.4, 1e-300, 0.1, 2.0, 9.0, 1000, np.nan),
        "saturation_adu": (0, -1, 1e-300, 1.0, 100.0, 1e4, 1e300, np.inf),
        "full_well_e": (0, 1e-300, 1.0, 1e300, np.nan),
        "wavelength_nm": (0, 1e-300, 1.0, 400.0, 1200.0, 1e6, -632.8),
        "distance_mm": (0, 1e-300, 1.0, 100.0, 800.0, 1e7, np.inf),
        "frame_period_s": (0, 1e-300, 1e300, -0.14, np.nan),
        "baseline_mm": (0, 1e-300, 0.3, 3.0, 1e4, -1e4, 1e300, np.nan),
    }
    key = str(case.pick(*wrong))
    value = case.pick(*wrong[key])
    if key == "baseline_mm":
        chosen = case.rng.integers(len(night.vectors))
        night.described["frames"]["fringes"][chosen][key][int(case.rng.integers(2))] = value
    else:
        section = "detector" if key in night.described["detector"] else "optics"
        night.described[section][key] = value
    _check(case, night)


def _unscanned(case: Case) -> None:
    """Phases that are constant, alternate, creep, or repeat."""
    count = int(case.pick(10, 40, 90))
    t = np.arange(count)
    phases = {
        "still": np.full(count, 1.0),
        "two": np.pi * (t % 2),
        "three": 2 * np.pi / 3 * (t % 3),
        "creep": t * 10 ** case.rng.uniform(-6, -1),
        "jump": np.where(t < count // 2, 0.0, 1.5),
        "one frame": np.where(t == 3, 2.0, 0.0),
        "turns": 2 * np.pi * t + case.rng.normal(0, 1e-3, count),
    }
    chosen = phases[str(case.pick(*phases))]
    _check(case, Night(case.rng, _window(case), count=count, phases=chosen))


def _any_type(case: Case) -> None:
    """Good frames in types that clip them or round them coarsely."""
    gain = float(case.pick(1.0, 10.0, 200.0, 2000.0))
    night = Night(case.rng, _window(case), gain=gain, bias=float(case.pick(0.0, 20.0, 300.0)))
    _check(case, night, str(case.pick(*INTEGERS, "float32")))


KINDS = [
    Kind("holes", "NaN, infinite and huge pixels", _holes, CASES),
    Kind("saturated", "saturated pixels and frames", _saturated, CASES),
    Kind("constant", "constant and repeated frames", _constant, CASES),
    Kind("no-fringes", "frames without fringes, or with hidden ones", _no_fringes, CASES),
    Kind("noise", "frames of noise alone", _noise_only, CASES),
    Kind("period", "fringe periods under two pixels or longer than the window", _any_period, CASES),
    Kind("few-frames", "1 to 12 frames", _few_frames, CASES),
    Kind("window", "windows of 1 × 1 to 12 × 12 pixels", _small_window, CASES),
    Kind("masked", "calibration that masks many pixels, or all", _masked, CASES),
    Kind("shapes", "sets of different shapes", _mixed_shapes, CASES),
    Kind("bias", "bias above the signal, or below zero", _bias_above, CASES),
    Kind("numbers", "gain, noise, optics: zero, negative, huge, NaN, wrong", _wrong_numbers, CASES),
    Kind("phases", "phases not scanned", _unscanned, CASES),
    Kind("types", "data types that clip or round", _any_type, CASES),
]
