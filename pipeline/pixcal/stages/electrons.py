"""Other frames of the same detector, of the sky for example, in electrons."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.nddata import CCDData, StdDevUncertainty
from numpy.typing import NDArray

from pixcal import __version__
from pixcal.model.arrays import F32
from pixcal.model.errors import InputError
from pixcal.model.options import Electrons
from pixcal.simulation.effect import Effect
from pixcal.stages.treatment import fitted_shapes, treatments_of
from pixcal.storage.cube_place import cubes_of
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.folder import written_aside
from pixcal.storage.manifest import MANIFEST, read_json
from pixcal.storage.single_frames import FramesOfFile
from pixcal.storage.stage import require

_MAPS = ("bias", "dark_rate", "flat", "read_noise", "mask")
_BAND = 256  # rows at a time


@dataclass(frozen=True)
class Converted:
    """What was written, and which effects of the diagnosis were removed."""

    files: tuple[Path, ...]
    removed: tuple[str, ...]
    left: tuple[str, ...]  # effects that no single frame can be corrected for


@dataclass(frozen=True)
class Calibration:
    """A detector as `reduce` and `diagnose` measured it."""

    # readers of (y, x): bias (ADU), dark_rate (e-/s), flat, read_noise (e-), mask
    maps: Mapping[str, ArrayReader]
    gain: float  # e-/ADU
    saturation: float  # ADU
    effects: tuple[Effect, ...]  # to undo, the last to act first
    left: tuple[str, ...]  # names of the effects that stay

    @property
    def shape(self) -> tuple[int, int]:
        """(y, x) size of the frames."""
        rows, columns = self.maps["bias"].shape
        return rows, columns

    def image(
        self, samples: NDArray[Any], seconds: float, header: Mapping[str, Any] | None = None
    ) -> CCDData:
        """Signal (e-) of a frame (ADU), without bias and dark signal, its error and its mask."""
        rows, columns = samples.shape
        data, error = np.empty((2, rows, columns), np.float32)
        mask = np.empty((rows, columns), np.bool_)
        halo = sum(effect.undo_halo for effect in self.effects)
        for first in range(0, rows, _BAND):
            band = slice(first, min(first + _BAND, rows))
            around = slice(max(first - halo, 0), min(band.stop + halo, rows))
            inside = slice(first - around.start, band.stop - around.start)
            found = self._band(samples[around], (around.start, around.stop), seconds)
            for target, values in zip((data, error, mask), found, strict=True):
                target[band] = values[inside]
        return CCDData(data, StdDevUncertainty(error), mask, unit="electron", meta=header)

    def _band(
        self, samples: NDArray[Any], rows: tuple[int, int], seconds: float
    ) -> tuple[F32, F32, NDArray[np.bool_]]:
        columns = (0, self.shape[1])
        maps = {name: reader.read(rows, columns) for name, reader in self.maps.items()}
        charge = np.float32(self.gain) * (samples.astype(np.float32) - maps["bias"])
        bad = (maps["mask"] != 0) | ~(samples < self.saturation) | ~np.isfinite(charge)
        # To its neighbours, a missing sample has the mean signal.
        charge[bad] = charge[~bad].mean() if not bad.all() else 0
        for effect in self.effects:
            undone = effect.undo_samples(charge[None])
            assert undone is not None
            charge = undone[0]
        with np.errstate(all="ignore"):
            signal = (charge - maps["dark_rate"] * np.float32(seconds)) / maps["flat"]
            error = np.sqrt(np.maximum(charge, 0) + maps["read_noise"] ** 2) / maps["flat"]
        bad |= ~np.isfinite(signal) | ~np.isfinite(error)
        signal[bad] = error[bad] = np.nan
        return signal, error, bad


def calibration_of(run_dir: Path, own: Sequence[Path]) -> Calibration:
    """The detector of a run, with the effects of its diagnosis if there is one."""
    require(run_dir, "reduce")
    facts = read_json(run_dir / "reduce" / "reduce.json")
    folder = cubes_of(run_dir / "reduce") / "calibration.zarr"
    effects: tuple[Effect, ...] = ()
    left: tuple[str, ...] = ()
    if (run_dir / "diagnose" / MANIFEST).exists():
        plan = treatments_of(run_dir, *fitted_shapes(run_dir), own)
        effects = plan.on_samples
        left = tuple(t.effect.name for t in plan.every if t.effect not in effects)
    gain, saturation = (facts[key]["used"] for key in ("gain_e_per_adu", "saturation_adu"))
    maps = {name: ArrayReader(folder / name) for name in _MAPS}
    return Calibration(maps, gain, saturation or np.inf, effects, left)


def run(run_dir: Path, files: Sequence[Path], config: Electrons) -> Converted:
    """Write a FITS file for each frame of some files; none if one of them cannot be used."""
    calibration = calibration_of(run_dir, config.own)
    (rows, columns), taken = calibration.shape, set[Path]()
    dark = bool(calibration.maps["dark_rate"].read((0, rows), (0, columns)).any())
    planned: list[tuple[FramesOfFile, list[Path], float]] = []
    for path in files:
        of_file = FramesOfFile.open(path)
        count, height, width = of_file.file.shape
        if (height, width) != (rows, columns):
            raise InputError(
                f"{path}: {width} x {height} px where the detector of {run_dir} has {columns} x "
                f"{rows}; give frames of the same window"
            )
        outs = _names(config.out, path, count)
        for out in outs:
            if out in taken:
                raise InputError(f"{path}: {out} is that of another file, too; rename one of them")
            if out.exists() and any(out.samefile(file) for file in files if file.exists()):
                raise InputError(f"{out}: is a raw frame; choose another --out")
            if out.exists() and not config.overwrite:
                raise InputError(f"{out}: exists; choose another --out, or add --overwrite")
        taken.update(outs)
        seconds = of_file.file.exptime_s if config.exptime_s is None else config.exptime_s
        if seconds is None and dark:
            raise InputError(f"{path}: no exposure time; add EXPTIME (s) to it, or give --exptime")
        planned.append((of_file, outs, seconds or 0.0))
    try:
        config.out.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"--out {config.out}: is a file; choose another directory") from error
    removed = tuple(effect.name for effect in calibration.effects)
    for of_file, outs, seconds in planned:
        header = of_file.header()
        header["CREATOR"] = (f"pixcal {__version__}", "program that wrote this file")
        header["EFFECTS"] = (" ".join(removed) or "none", "removed from the samples")
        for out, samples in zip(outs, of_file.frames(), strict=True):
            image = calibration.image(samples, seconds, header)
            with written_aside(out) as aside:
                image.write(aside, format="fits", overwrite=True)
    return Converted(tuple(taken), removed, calibration.left)


def _names(folder: Path, path: Path, count: int) -> list[Path]:
    stem = path.name.split(".")[0]
    numbered = [f"{stem}-{number:05d}" for number in range(count)] if count > 1 else [stem]
    return [folder / f"{name}.fits" for name in numbered]
