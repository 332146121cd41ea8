"""A run as arrays: maps of offsets, fringe sets, the detector, and what the stages measured."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pixcal.api.offset_map import OffsetMap, Picture
from pixcal.model.acquisition import Acquisition
from pixcal.model.arrays import F32, F64, U8
from pixcal.model.config import StrPath
from pixcal.model.errors import InputError
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.lock import damage_noted
from pixcal.storage.manifest import read_json
from pixcal.storage.products import read_map
from pixcal.storage.stage import read_acquisition, require

DETECTOR_MAPS = ("bias", "dark_rate", "flat", "read_noise", "mask")
T = TypeVar("T")
SERIES = ("time", "B", "A", "phi", "dkx", "dky")


class JsonFile(cached_property[dict[str, Any]]):
    """A JSON file of a `Run`: read on first use and kept."""

    def __init__(self, stage: str, doc: str, file: str = "") -> None:
        super().__init__(lambda run: run._read(stage, file or stage))
        self.__doc__ = doc


@dataclass(frozen=True)
class Run:
    """A run directory, opened. Arrays and tables are read on first use and kept.

    It is accepted wherever the path of a run is.

    Attributes
    ----------
    path : Path
        The run directory.
    """

    path: Path
    # the temporary directory of the run; it is removed with the last reference to it
    _kept: TemporaryDirectory[str] | None = field(default=None, repr=False, compare=False)

    def __fspath__(self) -> str:
        return str(self.path)

    def _read(self, stage: str, file: str) -> dict[str, Any]:
        require(self.path, stage)
        return dict(read_json(self.path / stage / f"{file}.json"))

    @cached_property
    def acquisition(self) -> Acquisition:
        """The contents of ``acquisition.yaml`` as understood, defaults included."""
        require(self.path, "ingest")
        return read_acquisition(self.path)

    @cached_property
    def frames(self) -> dict[str, dict[str, list[Any]]]:
        """File, plane, exposure time (s), time (s) and so on of every frame, by array.

        The arrays are ``bias``, ``dark``, ``flat`` and ``fringes/<name of the set>``.
        """
        return self._read("ingest", "frames")

    reduction = JsonFile(
        "reduce",
        "Contents of ``reduce.json``: gain, read noise, linearity, counts of flags, warnings.",
    )
    fit = JsonFile("fit", "Contents of ``fit.json``.")
    allan = JsonFile("allan", "Contents of ``allan.json``.")
    diagnosis = JsonFile(
        "diagnose", "Contents of ``diagnosis.json``: verdict, causes, residual gap.", "diagnosis"
    )
    correction = JsonFile(
        "corrected",
        "Contents of ``correction.json``: how each identified effect was treated.",
        "correction",
    )

    @cached_property
    def detector(self) -> dict[str, NDArray[Any]]:
        """Maps (y, x) of the detector.

        ``bias`` (ADU), ``dark_rate`` (e-/s), ``flat`` (relative, median 1), ``read_noise`` (e-),
        float32, and ``mask`` (uint8, bits of `pixcal.PixelFlag`).
        """
        require(self.path, "reduce")
        folder = self.path / "reduce" / "calibration.zarr"
        with damage_noted(self.path):
            return {name: ArrayReader(folder / name).read() for name in DETECTOR_MAPS}

    @cached_property
    def maps(self) -> dict[str, OffsetMap]:
        """The maps of offsets: ``delta_x`` and ``delta_y``, or ``delta_fringe`` alone."""
        return self._maps(self.fit["outputs"], "")

    @cached_property
    def corrected(self) -> dict[str, OffsetMap]:
        """The maps corrected for the identified effects; none if nothing had to be corrected."""
        return self._maps(self.correction["outputs"], "_corrected")

    def _maps(self, names: Sequence[str], suffix: str) -> dict[str, OffsetMap]:
        folder = self.path / "products"
        with damage_noted(self.path):
            return {n: OffsetMap(n, *read_map(folder / f"{n}{suffix}.fits")) for n in names}

    def _map(self, name: str) -> OffsetMap:
        if name not in self.maps:
            raise InputError(
                f"{self.path}: no {name} there, only {', '.join(self.maps)}; two fringe sets with "
                "different axes give delta_x and delta_y, sets with one axis delta_fringe"
            )
        return self.maps[name]

    @property
    def delta_x(self) -> OffsetMap:
        """Offsets along x."""
        return self._map("delta_x")

    @property
    def delta_y(self) -> OffsetMap:
        """Offsets along y."""
        return self._map("delta_y")

    @property
    def delta_fringe(self) -> OffsetMap:
        """Offsets along the only fringe axis."""
        return self._map("delta_fringe")

    @cached_property
    def sets(self) -> dict[str, "FringeSet"]:
        """The fringe sets as fitted, by name."""
        return {name: FringeSet(name, self) for name in self.fit["sets"]}

    @property
    def report(self) -> Path:
        """The HTML page."""
        require(self.path, "report")
        return self.path / "products" / "report.html"


class Stored(cached_property[T]):
    """An array of a `FringeSet`, by its attribute name: read on first use and kept."""

    def __init__(self) -> None:
        super().__init__(lambda fringes: fringes._array(self.attrname))


@dataclass(frozen=True)
class FringeSet:
    """One fringe set as fitted. Arrays are read on first use and kept.

    Attributes
    ----------
    name : str
    run : Run
    delta, sigma : (y, x) float32
        Offset along the set's fringe axis and its 1-sigma error, px; NaN where masked.
    iota, alpha : (y, x) float32
        Mean level, and amplitude of the fringes, e-.
    chi2 : (y, x) float32
        Reduced chi-square.
    mask : (y, x) uint8
        Bits of `pixcal.PixelFlag`.
    batch_delta, batch_sigma : (batch, y, x) float32
        Offsets from each batch of frames, relative to those of the whole run, and errors, px.
    """

    name: str
    run: Run = field(repr=False)

    @property
    def facts(self) -> dict[str, Any]:
        """Its entry in ``fit.json``: geometry, errors, bound, chi-square, removed modes."""
        return dict(self.run.fit["sets"][self.name])

    @property
    def allan(self) -> dict[str, Any]:
        """Its entry in ``allan.json``: the Allan deviation against averaging length."""
        return dict(self.run.allan["sets"][self.name])

    delta = Stored[F32]()
    sigma = Stored[F32]()
    iota = Stored[F32]()
    alpha = Stored[F32]()
    chi2 = Stored[F32]()
    mask = Stored[U8]()
    batch_delta = Stored[F32]()
    batch_sigma = Stored[F32]()

    @cached_property
    def series(self) -> dict[str, F64]:
        """Parameters (t,) of the frames.

        ``time`` (s), ``B`` and ``A`` (relative intensity and amplitude), ``phi`` (rad), ``dkx`` and
        ``dky`` (change of the fringe vector, rad/px).
        """
        return {name: self._array(name).astype(np.float64) for name in SERIES}

    def _array(self, name: str) -> NDArray[Any]:
        with damage_noted(self.run.path):
            return ArrayReader(self.run.path / "fit" / "fit.zarr" / self.name / name).read()

    def allan_picture(self) -> Picture:
        """The Allan deviation beside the square-root law, as the report shows it."""
        from pixcal.report.drawing import png  # here, as in `OffsetMap.picture`
        from pixcal.report.set_figures import allan_figure

        return Picture(png(allan_figure({self.name: (self.allan, self.facts)})))


def open_run(path: StrPath) -> Run:
    """Open a run directory.

    Parameters
    ----------
    path : str or path
        The directory given to ``--out``.

    Raises
    ------
    InputError
        If it is not a run directory.
    """
    folder = Path(path)
    require(folder, "ingest")
    return Run(folder)
