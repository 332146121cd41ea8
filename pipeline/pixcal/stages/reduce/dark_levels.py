"""Frames without light whose level is not that of the other frames of their exposure time."""

import math

import numpy as np

from pixcal.kernels.robust import median_and_sigma, robust_sigma
from pixcal.model.arrays import F64
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.flat_survey import middle_rows
from pixcal.stages.reduce.ingested import Ingested
from pixcal.storage.frames import first_few

_FEWEST = 3  # frames of one exposure time, whose median level is that of most of them
_HOT = 5.0  # standard deviations from the median beyond which a pixel is hot
_WILD = 6.0  # standard deviations of the usual scatter of levels


def level_warnings(source: Ingested, gain: float, noise: float) -> list[str]:
    """Sentences on frames whose level departs by more than the noise of the mean of a pixel.

    ``gain``: e-/ADU. ``noise``: of a sample, e-.
    """
    series = [group for group in source.exposures.dark if len(group.frames) >= _FEWEST]
    if not series:
        return []
    rests = [gain * _departures(source, group) for group in series]
    usual = robust_sigma(np.concatenate(rests))
    sentences = []
    for group, rest in zip(series, rests, strict=True):
        wild = np.abs(rest) > max(_WILD * usual, noise / math.sqrt(len(rest)))
        if not wild.any():
            continue
        names = source.names(group.array, np.array(group.frames)[wild].tolist())
        sizes = dict.fromkeys(f"{size:+.3g}" for size in (rest[wild].min(), rest[wild].max()))
        sentences.append(
            f"{group.array} frames of {group.exptime:g} s: the level of {first_few(names)} differs "
            f"from that of the others by {' to '.join(sizes)} e- (a change of temperature,"
            " bias or light); the averages include it: record them again, or remove them"
        )
    return sentences


def _departures(source: Ingested, group: Group) -> F64:
    """Level of each frame in the middle rows, without hot pixels, less their median, ADU."""
    levels = []
    for n in group.frames:
        samples = middle_rows(source.arrays[group.array], n, n + 1).ravel().astype(float)
        middle, sigma = median_and_sigma(samples[np.isfinite(samples)])
        near = np.abs(samples - middle) <= _HOT * max(sigma, source.quantum or 1.0)
        levels.append(samples[near].mean())
    return np.asarray(levels - np.median(levels))
