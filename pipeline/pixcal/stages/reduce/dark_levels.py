"""Frames without light whose level is not that of the others."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels.medians import median_and_sigma, robust_sigma
from pixcal.model.arrays import F64
from pixcal.report.text import number
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.flat_survey import middle_rows
from pixcal.stages.reduce.ingested import Ingested
from pixcal.storage.frames import first_few

_FEWEST = 3  # frames of one exposure time, whose median level is that of most of them
_HOT = 5.0  # standard deviations from the median beyond which a pixel is hot
_WILD = 6.0  # standard deviations of the usual scatter of levels
_NOTABLE = 0.1  # of the dark signal of the shortest darks


def level_warnings(source: Ingested, gain: float, noise: float) -> list[str]:
    """Sentences on frames whose level departs by more than the noise of the mean of a pixel.

    ``gain``: e-/ADU. ``noise``: of a sample, e-.
    """
    series = [group for group in source.exposures.dark if len(group.frames) >= _FEWEST]
    if not series:
        return []
    levels = [gain * _levels(source, group) for group in series]
    rests = [level - np.median(level) for level in levels]
    usual = robust_sigma(np.concatenate(rests))
    sentences = _of_bias(series, levels, usual, noise)
    for group, rest in zip(series, rests, strict=True):
        wild = np.abs(rest) > max(_WILD * usual, noise / math.sqrt(len(rest)))
        if not wild.any():
            continue
        names = source.names(group.array, np.array(group.frames)[wild].tolist())
        sizes = dict.fromkeys(number(float(size)) for size in (rest[wild].min(), rest[wild].max()))
        of = f" of {group.exptime:g} s" if group.array == "dark" else ""
        sentences.append(
            f"{group.array} frames{of}: the level of {first_few(names)} differs "
            f"from that of the others by {' to '.join(sizes)} e- (a change of temperature,"
            " bias or light); the averages include it: record them again, or remove them"
        )
    return sentences


def _of_bias(series: list[Group], levels: list[F64], usual: float, noise: float) -> list[str]:
    """A sentence if darks of two exposure times or more do not extrapolate to the bias frames."""
    middles = {g.array: float(np.median(e)) for g, e in zip(series, levels, strict=True)}
    dark = [n for n, group in enumerate(series) if group.array == "dark"]
    if len(dark) < 2 or "bias" not in middles:
        return []
    times, counts = np.array([[series[n].exptime, len(levels[n])] for n in dark]).T
    of_darks = np.array([np.median(levels[n]) for n in dark]) - middles["bias"]
    at_zero = np.linalg.pinv(np.stack([np.ones(len(times)), times], axis=1))[0]
    off, error = float(at_zero @ of_darks), usual * math.sqrt(float(at_zero**2 @ (1 / counts)))
    least = _NOTABLE * float(of_darks[times.argmin()])
    if abs(off) < max(_WILD * error, noise / math.sqrt(counts.min()), least):
        return []
    return [
        f"the darks extrapolate to a level {number(off)} e- from that of the bias frames: these "
        "have another offset or gain setting, or were taken at another time or temperature; the "
        "bias of flats and fringes may be wrong by as much: record all frames with the same "
        "settings"
    ]


def _levels(source: Ingested, group: Group) -> F64:
    frames = source.arrays[group.array]
    return np.array([frame_level(middle_rows(frames, n, n + 1), source) for n in group.frames])


def frame_level(samples: NDArray[Any], source: Ingested) -> float:
    """Mean of samples without light, without those of hot pixels, ADU."""
    middle, sigma = median_and_sigma(samples)
    near = np.abs(samples - middle) <= _HOT * max(sigma, source.quantum or 1.0)
    return float(samples[near].mean(dtype=float))
