"""Motion of the fringe vectors of an acquisition: jitter, walk, ramp, vibration, wavelength.

All sets are fitted together. A change of wavelength by epsilon subtracts ``epsilon k`` from every
set's own vector k; a motion of the fibres moves all vectors equally. Sets with fringes of different
directions separate the two; with one direction only, motion along k may be either.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, cached_on_evidence
from pixcal.estimators.frame_series.series import MEDIAN, FrameSeries, mode_variance, motion_series
from pixcal.estimators.frame_series.spectral_line import Line, without_line
from pixcal.kernels.medians import robust_sigma
from pixcal.model.arrays import F64

CROSSED = 0.5  # sine of the angle between fringes from which they count as different
HOP_WINDOWS = (2, 4, 8, 16, 32)  # frames before and after a hop whose means are compared
SIGNIFICANT_HOP = 6.5
SIGNIFICANT_STEP = 2.5  # the same for a hop fitted with a slope, which doubles its error
MAX_HOPS = 64
OCTAVE = 1.4  # ratio of frequencies over which the power of a slow change is nearly constant
BESIDE = 3  # modes on either side that hold the power of a line
# excess of the power over white noise, in errors, above which a slow change is significant
SLOW_SIGMAS = 3.0


@dataclass(frozen=True)
class Hop:
    """A jump of the wavelength."""

    frame: int  # first after it, among the usable ones
    size: float  # size, error: relative change of the wavelength
    error: float
    sigmas: float  # over the scatter of such differences in the same series


@dataclass(frozen=True)
class Motion:
    """Changes of the fringe vectors of all sets."""

    series: tuple[FrameSeries, ...]  # without hops and a significant line
    raw: tuple[FrameSeries, ...]  # with them
    hops: dict[str, tuple[Hop, ...]]  # of each set
    line: Line | None  # the strongest, significant or not
    crossed: bool  # whether there are fringes of different directions


@cached_on_evidence
def motion_of(evidence: Evidence) -> Motion | None:
    """Motion of the fringes in all sets with enough frames; None without any."""
    series = [s for s in map(motion_series, evidence.fringes.values()) if s is not None]
    if not series:
        return None
    hops = {s.name: find_hops(s) for s in series}
    # A hop affects all modes, so shapes that follow the phase are fitted after its removal.
    still = [_with_hops(s, hops[s.name], -1.0).cleaned() for s in series]
    line, cleared = without_line(still, _level)
    angles = [np.arctan2(s.k[1], s.k[0]) for s in series]
    return Motion(
        series=cleared,
        raw=tuple(_with_hops(s, hops[s.name], 1.0) for s in still),
        hops=hops,
        line=line,
        crossed=any(abs(np.sin(a - b)) > CROSSED for a in angles for b in angles),
    )


def vector_changes(evidence: Evidence) -> list[tuple[str, F64, F64, F64]]:
    """Of every set: name, times (t,), slow and fast change (t, 2) of the fringe vector, rad/px.

    Walk modes, each reduced by its share of noise (Wiener); the fast part keeps its power.
    """
    of_sets = []
    for fringes in evidence.fringes.values():
        series = motion_series(fringes, every=True)
        if series is None:
            continue
        basis = series.walk_modes
        modes = basis.of(series.values)
        level = np.median(modes[len(modes) // 2 :] ** 2, axis=0) / MEDIAN
        power, count = _around(modes, 1 / OCTAVE, OCTAVE)
        slow = power > level * (1 + SLOW_SIGMAS * np.sqrt(2 / count))
        slow = np.logical_and.accumulate(slow, axis=0)
        near, few = _around(modes, 1.0, 1.0, beside=BESIDE)
        noise = np.diag(series.noise) * np.mean(basis.of(series.apart) ** 2, axis=0)
        noise /= np.diag(series.apart_noise)
        near = np.where(near > level * (1 + SLOW_SIGMAS * np.sqrt(2 / few)), near, level)
        of_slow = np.where(slow, 1 - level / power, 0)
        of_fast = np.where(slow, 0, np.sqrt(np.maximum(1 - noise / near, 0)))
        changes = basis.series(modes * of_slow), basis.series(modes * of_fast)
        of_sets.append((series.name, series.time_s, *changes))
    return of_sets


def _around(modes: F64, low: float, high: float, beside: int = 0) -> tuple[F64, F64]:
    """Mean power (k, 2) of modes between two factors of each frequency, and their number."""
    order = np.arange(1, len(modes) + 1)
    first = np.maximum(np.floor(order * low).astype(int) - beside, 1) - 1
    last = np.minimum(np.ceil(order * high).astype(int) + beside, len(modes))
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(modes**2, axis=0)])
    count = (last - first)[:, None]
    return (sums[last] - sums[first]) / count, count


def ramps(series: FrameSeries, *, colour: bool) -> F64:
    """Shapes (t, 2, q): ramps of the vector along x and y, rad/px/s, and of the wavelength, 1/s."""
    time = series.time_s - series.time_s.mean()
    along = [[1.0, 0.0], [0.0, 1.0], *([[-k for k in series.k]] if colour else [])]
    return np.asarray(time[:, None, None] * np.array(along).T)


def colour_of(series: FrameSeries) -> F64:
    """Relative change (t,) of the wavelength from each frame's own vector."""
    k = np.array(series.k)
    weight = np.linalg.solve(series.noise, k)
    return np.asarray(-(series.values @ weight) / (k @ weight))


def find_hops(series: FrameSeries) -> tuple[Hop, ...]:
    """Jumps of the wavelength: along the fringe vector, and sharper than other motion."""
    # Differences of means before and after are compared with their scatter along the run. The
    # narrowest significant difference locates the hop.
    k, along = np.array(series.k), colour_of(series)
    across = series.values @ np.array([-k[1], k[0]]) / (k @ k)
    rest, hops = along, dict[int, float]()
    for width in HOP_WINDOWS:
        if len(along) < 6 * width:
            break
        aside, aside_scatter = _differences(across, width)
        # Across a gap a drift looks like a jump.
        frames = 2 * width - 1
        smooth = series.frame[frames:] - series.frame[:-frames] > frames
        for _ in range(MAX_HOPS):
            change, scatter = _differences(rest, width)
            at = int(np.argmax(np.where(smooth, 0.0, np.abs(change))))
            sharpness = abs(change[at]) / scatter
            if smooth[at] or sharpness < max(SIGNIFICANT_HOP, 2 * abs(aside[at]) / aside_scatter):
                break
            if not _is_step(rest, at, width, float(change[at])):
                smooth[max(0, at - width) : at + width] = True
                continue
            hops[at + width] = max(sharpness, hops.get(at + width, 0.0))
            rest = rest - change[at] * (np.arange(len(rest)) >= at + width)
    return _measured(along, hops)


def _is_step(values: F64, at: int, width: int, size: float) -> bool:
    """Whether a change persists when a slope is fitted too, unlike a slow drift."""
    frame = np.arange(-width, width, dtype=float)
    design = np.stack([np.ones(2 * width), frame, frame >= 0], axis=1)
    steps = np.convolve(values, np.linalg.pinv(design)[2, ::-1], "valid")
    scatter = robust_sigma(steps - np.median(steps))
    same = abs(steps[at] - size) < 3 * scatter
    return bool(same and abs(steps[at]) > SIGNIFICANT_STEP * scatter)


def _measured(along: F64, sharpness: dict[int, float]) -> tuple[Hop, ...]:
    """Sizes of hops from the frames between each and its neighbours."""
    if not sharpness:
        return ()
    width = max(HOP_WINDOWS)
    steps = np.diff(along)
    slope = float(np.median(along[width:] - along[:-width])) / width if len(along) > width else 0.0
    scatter = robust_sigma(steps - np.median(steps)) / np.sqrt(2)
    hops, frames = [], sorted(sharpness)
    for at, before, after in zip(frames, [0, *frames[:-1]], [*frames[1:], len(along)], strict=True):
        first, last = max(before, at - width), min(after, at + width)
        apart = (last - first) / 2
        size = along[at:last].mean() - along[first:at].mean() - slope * apart
        error = scatter * np.sqrt(1 / (at - first) + 1 / (last - at))
        hops.append(Hop(at, float(size), float(error), sharpness[at]))
    return tuple(hops)


def _differences(values: F64, width: int) -> tuple[F64, float]:
    """Mean of the next frames minus that of the last ones, about its median; and its scatter."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    means = (sums[width:] - sums[:-width]) / width
    change = means[width:] - means[:-width]
    change = change - np.median(change)
    return change, robust_sigma(change) or 1e-300


def _with_hops(series: FrameSeries, hops: Sequence[Hop], times: float) -> FrameSeries:
    """The series with its hops added ``times`` times."""
    colour = np.zeros(len(series))
    for hop in hops:
        colour += times * hop.size * (np.arange(len(series)) >= hop.frame)
    return replace(series, values=series.values - colour[:, None] * np.array(series.k))


def motion_part(name: str, series: FrameSeries) -> F64:
    """Covariance (t - 1, 2, 2) of the modes of a series for a unit of a kind of motion."""
    kind, _, axis = name.partition("_")
    power = np.ones(len(series) - 1) if kind == "jitter" else series.walk_modes.walk
    x, y = np.diag([1.0, 0.0]), np.diag([0.0, 1.0])
    direction = {"x": x, "y": y, "k": np.outer(series.k, series.k), "": x + y}
    return np.asarray(power[:, None, None] * direction[axis])


def _level(series: FrameSeries) -> F64:
    """Variance (t - 1, 2) of the modes, of noise, jitter and walk."""
    names = ("jitter_x", "jitter_y", "walk_x", "walk_y")
    return mode_variance(series, np.stack([motion_part(name, series) for name in names]))
