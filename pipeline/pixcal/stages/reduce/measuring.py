"""What a task measures of the calibration frames, its outputs and its memory."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pixcal.estimators.detector.calibration import DarkLine, ExposureLevel
from pixcal.estimators.detector.pair_noise import LineNoise
from pixcal.kernels.photon_transfer import COLUMNS, N_BINS
from pixcal.model.arrays import F64, Mask
from pixcal.model.options import Reduce
from pixcal.stages import tiles
from pixcal.stages.reduce.black_cut_off import CutOff
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.tiles import STRIP, Index
from pixcal.storage.cube import CHUNK, ArrayWriter, create_array, create_group
from pixcal.storage.frame_reader import Reader
from pixcal.storage.place import Place

# maps of the scratch store
STATISTICS = (
    "bias",  # ADU
    "dark_rate",  # ADU/s
    "dark_rate_error",  # ADU/s
    "response",  # relative to the tile
    "response_error",
    "read_variance",  # ADU², of the read-noise series
    "dark_variance",  # ADU², of all frames without light, less the shot noise of dark signal
    "dark_dof",
    "kurtosis",
    "outliers",
    "shot",  # shot variance of flats over their light, 1/gain (ADU/e-); NaN where unknown
    "flags",
)


@dataclass(frozen=True)
class Measuring:
    """Input of the first task of a column."""

    frames: Mapping[str, Reader]  # a reader of each array
    shape: tuple[int, int]  # of the detector's window (y, x)
    dark: Sequence[Group]  # dark, flat: frames without light, and flats
    flat: Sequence[Group]
    read_series: Group | None  # the one of ``dark`` whose noise is the read noise
    flats_timed: bool  # whether the exposure times of the flats are known
    # number of a bright flat, and the level (ADU above bias) below which its pixels see no light
    bright: tuple[int, float] | None
    # saturation, full: level (ADU) from which samples are saturated: in flats, and in any frames
    saturation: float
    full: float
    bands: bool  # whether rows of flats may share more than those of frames without light
    quantum: float  # step of the samples (ADU), 0 for real numbers
    cut_off: Mapping[str, CutOff]  # arrays whose noise is cut off at their lowest code
    # whether the gain leaves out the noise of frames without light; None: to be found
    without_dark: bool | None
    subtracted: tuple[float, float]  # dark signal that the camera subtracts, and error, ADU/s
    gain: float  # gain, read_noise: rough values (e-/ADU, ADU)
    read_noise: float
    options: Reduce  # limits of outliers and flags
    writers: Mapping[str, ArrayWriter]  # arrays for the results


def statistics_writers(folder: Place, shape: tuple[int, int], flats: int) -> dict[str, ArrayWriter]:
    """Make the arrays that `measure` writes: one chunk of each for `STRIP` columns."""
    whole, n, steps = tiles.grid(shape), len(STATISTICS), max(flats, 1)
    wide = min(STRIP, whole[1])
    create_group(folder)
    made = {}
    for name, extents, chunks, dtype in (
        ("maps", (n, *shape), (n, *tiles.map_chunk(shape)), np.float32),
        ("pairs", (*whole, 3, N_BINS, COLUMNS), (1, wide, 3, N_BINS, COLUMNS), np.float64),
        ("levels", (*whole, steps, 4), (1, wide, steps, 4), np.float64),
    ):
        dims = [f"axis{axis}" for axis in range(len(extents))]
        made[name] = create_array(folder / name, extents, dtype, chunks=chunks, dims=dims)
    return made


def measure_bytes(dark: Sequence[Group], flat: Sequence[Group], width: int) -> int:
    """Peak of `measure`: copies of a column's batch; one chunk and the maps of each column."""
    chunk, tile = 4 * CHUNK[0] * CHUNK[1] * CHUNK[2], 8 * CHUNK[1] * CHUNK[2]
    maps = max(width, STRIP) * tile * (60 + 8 * len(dark) + 24 * len(flat))
    return (6 + width) * chunk + maps


@dataclass
class Column:
    """Statistics of a column of chunks."""

    index: Index
    maps: dict[str, F64]
    pairs: F64
    levels: F64
    noise: F64  # typical variance of a sample in this column (ADU²)
    # pixels that photon transfer and read noise leave out: noisy without light, or unlit in flats
    loud: Mask
    full: Mask  # pixels with saturated samples in flats
    line_noise: LineNoise = field(default_factory=LineNoise)
    line: DarkLine | None = None
    steps: list[ExposureLevel] = field(default_factory=list)
    variances: list[F64] = field(default_factory=list)  # of a sample of each pixel in each step

    @classmethod
    def begin(cls, job: Measuring, index: Index) -> "Column":
        """Arrays of zeros for a column of chunks."""
        (y0, y1), (x0, x1) = tiles.extent(job.shape, index)
        shape = y1 - y0, x1 - x0
        maps = {name: np.zeros(shape) for name in STATISTICS}
        levels = np.zeros(job.writers["levels"].shape[2:])
        pairs = np.zeros((3, N_BINS, COLUMNS))
        loud, full = np.zeros((2, *shape), np.bool_)
        return cls(index, maps, pairs, levels, np.zeros(shape), loud, full)
