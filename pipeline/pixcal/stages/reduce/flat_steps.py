"""The steps of a ladder of flats: their levels, their light, and where wells are full."""

import numpy as np

from pixcal.estimators.detector.emva import Measure
from pixcal.estimators.detector.straightness import Level
from pixcal.model.arrays import F64, Mask
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.reduce.measuring import Measuring
from pixcal.stages.tiles import grid

_SATURATED_STEP = 1e-2


def exposure_steps(tables: F64, job: Measuring) -> tuple[F64, Mask, Mask]:
    """Level of each step (ADU) over columns with a level at every step; which steps to use."""
    # Also the steps at which some pixels are full, or nearly so.
    if not job.flat:
        return np.zeros(0), np.zeros(0, np.bool_), np.zeros(0, np.bool_)
    level, pixels, lost, nearly = (tables.reshape(-1, len(job.flat), 4)[..., n] for n in range(4))
    frames = np.array([len(group.frames) for group in job.flat])
    usable = np.less_equal(lost.sum(axis=0), _SATURATED_STEP * frames * pixels.sum(axis=0))
    common = np.isfinite(level[:, usable]).all(axis=1, keepdims=True)
    weight = np.where(common & np.isfinite(level), pixels, 0.0)
    total = (weight * np.nan_to_num(level)).sum(axis=0)
    seen = weight.sum(axis=0)
    ended = nearly.sum(axis=0) > _SATURATED_STEP * pixels.sum(axis=0)
    return np.divide(total, seen, out=np.zeros_like(total), where=seen > 0), usable, ended


def wells(
    well: Measure | None, levels: F64, charged: F64, usable: Mask, nearly: Mask
) -> tuple[Measure | None, Mask]:
    """Saturation of the wells (ADU), if it was reached, and the steps with full pixels."""
    # ``charged``: levels with their dark signal, ADU.
    below, ended = usable & ~nearly, usable & nearly
    if well is None and below.any() and ended.any():
        # Photon transfer leaves out levels that the converter's end may clip.
        ends = float(levels[below].max()), float(levels[ended].max())
        well = sum(ends) / 2, (ends[1] - ends[0]) / 2
    if well is None:
        return None, np.zeros_like(usable)
    full = usable & (nearly | (charged > well[0]))
    beyond = full & (levels > sum(well))
    if beyond.any():
        # Wells differ: some pixels may be full far below the next level of the flats.
        half = (float(levels[beyond].min()) - well[0] + well[1]) / 2
        well = well[0] - well[1] + half, half
    return well, full


def light_of_tiles(tables: F64, levels: F64, usable: Mask, job: Measuring) -> F64:
    """Light of each tile over the mean, from usable steps or those losing fewest samples."""
    if not job.flat:
        return np.ones(grid(job.shape))
    lost = tables[..., 2].sum(axis=(0, 1))
    taken = usable if usable.any() else lost == lost.min()
    frames = np.array([len(group.frames) for group in job.flat])
    means = tables[..., 0]
    weight = np.where(np.isfinite(means) & taken, frames, 0.0)
    whole = (weight * levels).sum(axis=-1)
    charge = (weight * np.nan_to_num(means)).sum(axis=-1)
    share: F64 = np.divide(charge, whole, out=np.full_like(whole, np.nan), where=whole != 0)
    return share


def levels_with_light(source: Ingested, levels: F64, usable: Mask, rate: float) -> list[Level]:
    """Levels (ADU) of timed flats with the light of each frame; ``rate``: of dark signal, ADU/s."""
    if source.survey is None or not source.exposures.known:
        return []
    table = source.tables["flat"]
    stamped = np.not_equal(table["time_source"], "number")
    seconds = np.where(stamped, np.array(table["time_s"], float), np.nan)
    steps = zip(source.exposures.flat, levels, usable, strict=True)
    return [
        Level(
            group.exptime,
            float(level),
            bool(used),
            source.survey.levels[list(group.frames)] - rate * group.exptime,
            seconds[list(group.frames)],
        )
        for group, level, used in steps
    ]
