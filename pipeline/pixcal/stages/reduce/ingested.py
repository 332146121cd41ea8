"""Contents of ``RUN/ingest`` for the reduction."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.model.acquisition import Detector
from pixcal.model.arrays import Mask
from pixcal.model.errors import DamagedError, InputError
from pixcal.stages.reduce import flat_survey
from pixcal.stages.reduce.black_cut_off import Black, CutOff, cut_offs
from pixcal.stages.reduce.exposures import Exposures, group_exposures
from pixcal.stages.reduce.flat_survey import FlatSurvey
from pixcal.storage.cube_place import cubes_of
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.frame_reader import ChosenFrames, FrameReader, Reader
from pixcal.storage.frames import first_few
from pixcal.storage.header_values import DAY_S
from pixcal.storage.manifest import read_json, read_manifest
from pixcal.storage.place import Local, Place
from pixcal.storage.stage import read_acquisition

# reasons to leave flats out, and what to do
_UNLIT = "without light", "list them under frames.dark or frames.bias if they are to be used"
_MISTIMED = (
    "whose light contradicts their EXPTIME (that of all others agrees)",
    "correct their EXPTIME (for TIFF and PNG in headers.csv) if they are to be used",
)
MOST_ADU = 2.0**32  # above any converter's range: larger real numbers are not samples


@dataclass(frozen=True)
class Ingested:
    """Frames and their tables."""

    folder: Local  # ``RUN/ingest``
    black: Black | None = None  # known of the camera from more than these frames

    @cached_property
    def raw(self) -> Place:
        """The store of raw frames."""
        return cubes_of(self.folder) / "raw.zarr"

    @cached_property
    def detector(self) -> Detector:
        """The detector as declared."""
        return read_acquisition(self.folder.parent).detector

    @cached_property
    def _catalogue(self) -> dict[str, dict[str, list[Any]]]:
        file = self.folder / "frames.json"
        catalogue: dict[str, dict[str, list[Any]]] = read_json(file)
        if not isinstance(catalogue, dict):
            raise DamagedError(file, "damaged (not a table of frames)")
        return catalogue

    @cached_property
    def _whole(self) -> dict[str, list[int]]:
        """Numbers of the frames that were not cut off and repeat no other."""
        whole = {}
        for name, table in self._catalogue.items():
            count = len(table["time_s"])
            faults = [table.get(key, [None] * count) for key in ("cut_from_row", "repeat_of")]
            whole[name] = [n for n in range(count) if all(fault[n] is None for fault in faults)]
        return whole

    @cached_property
    def _all_flats(self) -> FlatSurvey | None:
        """Survey of the flats, unlit ones included; None without flats. InputError if they wrap."""
        if "flat" not in self._catalogue:
            return None
        survey = FlatSurvey.of(self._chosen(self._whole))
        if survey.wrapped is not None:
            raise InputError(
                f"{self._catalogue['flat']['file'][self._whole['flat'][survey.wrapped]]}: light "
                "makes its samples negative: unsigned 16-bit samples that were written as signed "
                "ones, so that levels above 32767 ADU wrap; write all frames again as unsigned "
                "(astropy: fits.writeto(NEW, data.astype('uint16'), header), which adds "
                "BZERO = 32768)"
            )
        return survey

    @cached_property
    def _left_out(self) -> dict[tuple[str, str], Mask]:
        """Which flats are not used, by the reason."""
        # Parts of a run, and simulations, keep the flats of the whole.
        if self._all_flats is None or self.black is not None:
            return {}
        times = self._catalogue["flat"]["exptime_s"]
        return {
            _UNLIT: ~self._all_flats.lit,
            _MISTIMED: self._all_flats.mistimed([times[n] for n in self._whole["flat"]]),
        }

    @cached_property
    def _used(self) -> dict[str, list[int]]:
        """Numbers of the frames that are used."""
        if not self._left_out:
            return self._whole
        numbers = np.array(self._whole["flat"])
        return self._whole | {"flat": numbers[~np.any([*self._left_out.values()], axis=0)].tolist()}

    @cached_property
    def _listed(self) -> dict[str, dict[str, list[Any]]]:
        return {
            name: {key: [column[n] for n in self._used[name]] for key, column in table.items()}
            for name, table in self._catalogue.items()
        }

    @cached_property
    def tables(self) -> dict[str, dict[str, list[Any]]]:
        """Properties of the frames of each array, in columns; for flats also the lamp's ``step``.

        Darks of several unknown exposure times are left out.
        """
        listed = {k: v for k, v in self._listed.items() if k != "dark" or not self._mixed_darks}
        flat = listed.get("flat")
        if flat is None or "step" in flat or self.survey is None:
            return listed
        return listed | {"flat": flat | {"step": self.survey.steps(flat["exptime_s"])}}

    @cached_property
    def _mixed_darks(self) -> bool:
        """Whether there are bias frames, and darks of several unknown exposure times."""
        dark = self._listed.get("dark")
        return (
            dark is not None
            and "bias" in self._listed
            and all(t is None for t in dark["exptime_s"])
            and flat_survey.of_several_levels(self.arrays["dark"])
        )

    @cached_property
    def survey(self) -> FlatSurvey | None:
        """Survey of the flats; None without flats."""
        every = self._all_flats
        if every is None or not self._left_out:
            return every
        used = ~np.any([*self._left_out.values()], axis=0)
        return every.of_frames(np.flatnonzero(used).tolist())

    @cached_property
    def exposures(self) -> Exposures:
        """Groups of the calibration frames, and exposure times of the fringe frames."""
        exposures = group_exposures(self.tables)
        if self._mixed_darks:
            exposures.warnings.append(
                "dark frames have no EXPTIME and are of several levels: not used; write exposure "
                "times into the headers (for TIFF and PNG into headers.csv)"
            )
        exposures.warnings += [
            f"flat frames {reason[0]} are left out ({mask.sum()} of {len(mask)}): "
            f"{first_few(self._files('flat', np.array(self._whole['flat'])[mask]))}; {reason[1]}"
            for reason, mask in self._left_out.items()
            if mask.any()
        ]
        return exposures

    def names(self, array: str, numbers: Sequence[int]) -> list[str]:
        """Files, and planes of cubes, of used frames of an array."""
        return self._files(array, np.array(self._used[array])[numbers])

    def _files(self, array: str, numbers: NDArray[Any]) -> list[str]:
        table = self._catalogue[array]
        return [table["file"][n] + f" [{table['plane'][n]}]" * any(table["plane"]) for n in numbers]

    @cached_property
    def arrays(self) -> Mapping[str, Reader]:
        """A reader of the frames of each array that are used; InputError if files are gone."""
        return self._chosen(self._used)

    def _chosen(self, numbers: Mapping[str, Sequence[int]]) -> dict[str, Reader]:
        """A reader of some frames of each array."""
        return {
            name: reader
            if len(numbers[name]) == reader.shape[0]
            else ChosenFrames(reader, numbers[name])
            for name, reader in self._readers.items()
        }

    @cached_property
    def _readers(self) -> Mapping[str, ArrayReader | FrameReader]:
        """A reader of all frames of each array, from its cube or FITS files."""
        manifest = read_manifest(self.folder)
        if manifest is None or manifest.format == 1:
            return {name: ArrayReader(self.raw / name) for name in self._catalogue}
        readers: dict[str, ArrayReader | FrameReader] = {}
        places = read_json(self.folder / "files.json")
        for name, table in self._catalogue.items():
            if places[name] is None:
                readers[name] = ArrayReader(self.raw / name)
                continue
            facts = manifest.summary["arrays"][name]
            checksums = ArrayReader(self.folder / "catalogue.zarr" / name).read()[..., 0]
            folder = self._files_folder(manifest.summary["acquisition"], places[name]["file"][0])
            readers[name] = FrameReader(
                folder, places[name], table, facts["shape"], facts["dtype"], checksums
            )
        return readers

    def _files_folder(self, noted: Mapping[str, str], file: str) -> Path:
        """The folder of the files: at its noted path, or at the same path relative to the run."""
        folder, run = Path(noted["folder"]), self.folder.parent
        assert isinstance(run, Path)
        for place in (folder, run.absolute() / noted["from_run"]):
            if (place / file).exists():
                return place
        raise InputError(
            f"{folder}: the frames of {self.folder} are gone; run 'pixcal ingest ACQ --out {run}' "
            "with their new place as ACQ (--copy keeps a copy in RUN)"
        )

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Size (y, x) of the frames; InputError if arrays have frames of different sizes."""
        shapes = {name: (a.shape[1], a.shape[2]) for name, a in self.arrays.items()}
        first, (ny, nx) = next(iter(shapes.items()))
        for name, shape in shapes.items():
            if shape != (ny, nx):
                raise InputError(
                    f"{self.folder}: the frames of {name} have {shape[1]} × {shape[0]} pixels, "
                    f"those of {first} {nx} × {ny}; use frames of one size"
                )
        return ny, nx

    @cached_property
    def quantum(self) -> float:
        """Step of the calibration frames (ADU); 0 if any hold real numbers."""
        # 12-bit cameras that write 16 bits count in steps of 16.
        names = {group.array for group in (*self.exposures.dark, *self.exposures.flat)}
        if not all(flat_survey.of_whole_numbers(self.arrays[name]) for name in names):
            return 0.0
        return float(flat_survey.code_step([self.arrays[name] for name in sorted(names)]))

    def saturation(self, name: str) -> float:
        """Level (ADU) from which samples of an array are saturated."""
        # The declared level, else that at which flats pile up, else the largest value of the type.
        end = self._ends(name)[1]
        return min(self.detector.saturation_adu or self.saturation_found or end, end)

    @property
    def saturation_found(self) -> float | None:
        """Level (ADU) at which flats pile up; None if they do not."""
        return None if self.survey is None else self.survey.saturation

    @cached_property
    def cut_off(self) -> dict[str, CutOff]:
        """Arrays of frames without light whose noise is cut off at their lowest code."""
        if self.black is not None:
            return dict(self.black.cut_off)
        return cut_offs(self.arrays, self.quantum or 1.0)

    @property
    def lowest_adu(self) -> float | None:
        """Code (ADU) at which noise is cut off; None if it is not."""
        return min((one.code for one in self.cut_off.values()), default=None)

    def lowest(self, name: str) -> float:
        """Least sample (ADU) that an array can hold."""
        return self._ends(name)[0]

    def _ends(self, name: str) -> tuple[float, float]:
        dtype = self.arrays[name].dtype
        if dtype.kind not in "iu":
            return -math.inf, MOST_ADU
        return float(np.iinfo(dtype).min), float(np.iinfo(dtype).max)


def starts_of(tables: Mapping[str, Mapping[str, list[Any]]]) -> dict[str, float]:
    """Time of frame 0 of each array after the first known one, s; nan where it is unknown."""
    begin = {name: begin_mjd(table) for name, table in tables.items()}
    first = min((day for day in begin.values() if np.isfinite(day)), default=np.nan)
    return {name: float(day - first) * DAY_S for name, day in begin.items()}


def begin_mjd(table: Mapping[str, list[Any]]) -> float:
    """Time stamp of an array's frame 0, days; nan when unknown."""
    stamps = np.array(table["mjd"], float) - np.array(table["time_s"], float) / DAY_S
    # Later planes of a cube without exposure time have none.
    known = stamps[np.isfinite(stamps)]
    return float(known[0]) if len(known) else np.nan
