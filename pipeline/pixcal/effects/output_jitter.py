"""Levels of the outputs of the detector: each varies separately from frame to frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.offset import FEWEST, unlit_stacks
from pixcal.estimators.frame_series.variance_components import walk_modes
from pixcal.kernels.medians import robust_sigma
from pixcal.kernels.processes import HOUR_S, brownian
from pixcal.kernels.scene import Rows
from pixcal.kernels.significance import SIGNIFICANT, root_with_error, sigmas_of_best, sigmas_of_chi2
from pixcal.kernels.synthesis import walk_normals
from pixcal.model.arrays import F32, F64, Indices, Mask
from pixcal.model.bench import SimulatedDetector
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

_WALK = 1000  # first key of the walk's random numbers
MAX_EDGES = 15  # along each axis
NARROWEST = 8  # least rows or columns of an output; even, so that alternate lines cancel
# numbers of lines on either side whose means are compared: small steps need many lines
WIDTHS = (NARROWEST, 3 * NARROWEST, 9 * NARROWEST)
_FAR = 24  # lines on either side that determine the position of an edge
_WILD = 5.0  # standard deviations above which a sample (_CLIP: a frame's step) is clipped
_CLIP = 3.0
_STEPS = 30  # of the likelihood's maximisation
_LEAST = 1e-9  # least noise of a level, e-², as frames may be equal


@dataclass(frozen=True)
class OutputJitter(Effect):
    """Each output reads a rectangle of pixels; its level varies independently of the others."""

    name = "output_jitter"
    title = "output offsets that vary from frame to frame"
    acts_at = Stage.READOUT
    order = 4
    domains = ("noise", "time")
    strengths = ("output_rms", "walk_e_h")
    left_because = "noise that is independent in each frame averages out"
    frames_needed = ("dark",)
    remedy = "in each frame, subtract the level of each output measured on dark or overscan pixels"
    sources = (
        "Rauscher 2015, PASP 127, 1144: each output of an infrared array has noise of its own in "
        "addition to common noise",
    )

    output_rms: float = quantity(2.0, unit="e-", low=0, high=1e5)
    """white noise of an output's level, rms"""
    walk_e_h: float = quantity(0.0, unit="e-/h^0.5", low=0, high=1e6)
    """random walk of an output's level, rms after an hour"""
    row_edges: tuple[int, ...] = quantity((), unit="px", low=0)
    """first row of each output but the first, on the chip"""
    column_edges: tuple[int, ...] = quantity((32,), unit="px", low=0)
    """first column of each output but the first, on the chip"""

    def read_variance(self, detector: SimulatedDetector) -> float:
        numbers = self._numbers(detector, (0, detector.shape[0]))
        shares = np.bincount(numbers.ravel()) / numbers.size
        return float(self.output_rms**2 * (1 - np.square(shares).sum()))

    def readout(self, adu: F32, shot: Shot) -> F32:
        detector = shot.bench.detector
        levels = (self._levels(shot) / detector.gain_e_per_adu).astype(np.float32)
        return adu + levels[self._numbers(detector, shot.rows)]

    def _numbers(self, detector: SimulatedDetector, of: Rows) -> Indices:
        """Number (y, x) of the output that reads each pixel of some rows."""
        rows = np.arange(*of) + detector.origin[0]
        columns = np.arange(detector.shape[1]) + detector.origin[1]
        return output_numbers(self.row_edges, self.column_edges, rows, columns)

    def _levels(self, shot: Shot) -> F64:
        """Levels (n,) of the outputs in a frame, e-."""
        count = (len(self.row_edges) + 1) * (len(self.column_edges) + 1)
        levels = self.output_rms * shot.rng(self.name).standard_normal(count)
        if self.walk_e_h:
            normals = [walk_normals(shot.bench.seed, self.name, _WALK, n) for n in range(count)]
            walks = [brownian(shot.time_s, normal) for normal in normals]
            levels += self.walk_e_h * np.array(walks) / np.sqrt(HOUR_S)
        return np.asarray(levels)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """From edges where means of lines differ anew in each frame, and levels between them."""
        stacks = [s for s in unlit_stacks(evidence, "bias", "dark") if len(s.adu) >= FEWEST]
        gain = np.float32(evidence.gain)
        rests = [(s.adu - s.adu.mean(axis=0)) * gain for s in stacks]
        outputs = find_outputs(rests, [s.time_s for s in stacks], evidence.good)
        if outputs is None:
            return None
        size, error = np.array([outputs.size, outputs.error]) * [1.0, HOUR_S]
        rms, rms_error = root_with_error(size, error)
        rows, columns = (
            tuple(int(edge) + first for edge in edges)
            for edges, first in zip(
                (outputs.row_edges, outputs.column_edges), evidence.origin, strict=True
            )
        )
        return Estimate(
            cls(float(rms[0]), min(float(rms[1]), 1e6), rows, columns),
            dict(zip(cls.strengths, rms_error.tolist(), strict=True)),
            outputs.sigmas,
            "steps between outputs that change in each frame without light",
        )


@dataclass(frozen=True)
class OutputEdges:
    """Edges between outputs, and the noise of their levels."""

    row_edges: tuple[int, ...]  # row_edges, column_edges: first line of each output after the first
    column_edges: tuple[int, ...]
    # size, error: white noise of an output's level (e-²), and its random walk (e-²/s)
    size: tuple[float, float]
    error: tuple[float, float]
    sigmas: float  # significance of the clearest edge


def find_outputs(stacks: Sequence[F32], times: Sequence[F64], good: Mask) -> OutputEdges | None:
    """Outputs of stacks (t, y, x), e-, minus the mean of each pixel, at times (t,), s.

    None with too few frames. If no edge is significant, the most significant one is given.
    """
    chosen = [n for n, rest in enumerate(stacks) if len(rest) >= FEWEST]
    rests = [_calm(stacks[n], good) for n in chosen]
    if not rests:
        return None
    by_axis = [_edges(rests, good, axis) for axis in (0, 1)]
    clearest = max(by_axis, key=lambda edges: edges[1])
    if clearest[1] == -np.inf:
        return None
    kept = [[e for e, s in edges[0] if s > SIGNIFICANT] for edges in by_axis]
    if not any(kept):
        kept[by_axis.index(clearest)] = [clearest[0][0][0]]
    rows, columns = (tuple(sorted(edges)) for edges in kept)
    numbers = output_numbers(rows, columns, np.arange(good.shape[0]), np.arange(good.shape[1]))
    size, error = _sizes(rests, [times[n] for n in chosen], good, numbers)
    return OutputEdges(rows, columns, size, error, clearest[1])


def output_numbers(
    row_edges: Sequence[int], column_edges: Sequence[int], rows: Indices, columns: Indices
) -> Indices:
    """Number (y, x) of the output that reads each pixel of given rows and columns."""
    along = np.searchsorted(column_edges, columns, side="right")
    down = np.searchsorted(row_edges, rows, side="right")
    return np.asarray(down[:, None] * (len(column_edges) + 1) + along)


def _calm(rest: F32, good: Mask) -> F32:
    """Residuals without the mean of each frame; samples of bad pixels and outliers are zero."""
    rest = rest - rest[:, good].mean(axis=1)[:, None, None]
    spread = robust_sigma(rest[:, good])
    rest[np.abs(rest) > _WILD * max(spread, 1e-6)] = 0
    return np.asarray(rest * good, np.float32)


def _edges(rests: Sequence[F32], good: Mask, axis: int) -> tuple[list[tuple[int, float]], float]:
    """Significant edges along an axis, best first, with significance; that of the best edge."""
    size = good.shape[axis]
    if size < 6 * NARROWEST - 1:
        return [], -np.inf
    count = np.maximum(good.sum(axis=1 - axis), 1)
    lines = [rest.sum(axis=2 - axis, dtype=float) / count for rest in rests]
    dof = sum(len(line) - 1 for line in lines)
    free = {width: _steps(lines, width, dof) for width in WIDTHS if 4 * width < size}
    looks = 2 * sum(np.count_nonzero(square) for square in free.values())
    edges: list[tuple[int, float]] = []
    while len(edges) < MAX_EDGES and max(square.max() for square in free.values()) > 0:
        best = max(free.values(), key=np.max)
        at = int(best.argmax())
        chance = sigmas_of_chi2(float(best[at]), dof)
        sigmas = sigmas_of_best(*[chance] * looks)
        edge = _placed(lines, at)
        edges.append((edge, sigmas))
        if sigmas < SIGNIFICANT:
            break
        # Clipped steps are equal at several places; the first is not necessarily the edge.
        for width, square in free.items():
            for middle in (at, edge):
                square[max(middle - width, 0) : middle + width + 1] = 0
    return edges, edges[0][1] if edges else -np.inf


def _steps(lines: Sequence[F64], width: int, dof: int) -> F64:
    """Sum over frames of the squared step at each place, between means of lines: chi-square."""
    size = lines[0].shape[1]
    places = np.arange(width, size - width + 1)
    square = np.zeros(len(places))
    for line in lines:
        # Noise may depend on position.
        # Variance (n,) of line means (t, n), from differences of neighbours, insensitive to steps.
        change = np.square(np.diff(line, axis=1)).mean(axis=0) / 2
        near = np.pad(change, (NARROWEST, NARROWEST + 1), mode="reflect")
        noise = np.asarray(np.median(sliding_window_view(near, 2 * NARROWEST + 1), axis=1))[None]
        expected = _means(noise, places, width)[0] + _means(noise, places - width, width)[0]
        steps = _means(line, places, width) - _means(line, places - width, width)
        steps /= np.sqrt(np.maximum(expected, 1e-12))
        usual = robust_sigma(steps) or 1.0
        square += np.square(np.clip(steps / usual, -_CLIP, _CLIP)).sum(axis=0)
    chi2 = np.zeros(size + 1)
    chi2[places] = square * dof / max(float(np.median(square)), 1e-9)
    return chi2


def _means(lines: F64, first: Indices, count: int) -> F64:
    """Means (t, n) of ``count`` lines beginning at ``first``."""
    total = np.concatenate([np.zeros((len(lines), 1)), np.cumsum(lines, axis=1)], axis=1)
    return np.asarray((total[:, first + count] - total[:, first]) / count)


def _placed(lines: Sequence[F64], about: int) -> int:
    """Position near ``about`` that separates the lines best."""
    size = lines[0].shape[1]
    first, last = max(about - _FAR, 0), min(about + _FAR, size)
    places = range(max(about - NARROWEST, first + 1), min(about + NARROWEST, last - 1) + 1)
    gains = []
    for place in places:
        before, after = place - first, last - place
        step = [own[:, place:last].mean(axis=1) - own[:, first:place].mean(axis=1) for own in lines]
        gains.append(before * after / (before + after) * sum(float(s @ s) for s in step))
    return places[int(np.argmax(gains))]


def _sizes(
    rests: Sequence[F32], times: Sequence[F64], good: Mask, numbers: Indices
) -> tuple[tuple[float, float], tuple[float, float]]:
    """White noise and walk of outputs' levels beyond pixel, row and column noise; errors."""
    masks = [good & (numbers == n) for n in range(int(numbers.max()) + 1)]
    masks = [mask for mask in masks if np.count_nonzero(mask) >= NARROWEST**2]
    if len(masks) < 2:
        return (0.0, 0.0), (1.0, 1.0)
    parts = []
    for rest, time in zip(rests, times, strict=True):
        levels = np.stack([rest[:, mask].mean(axis=1, dtype=float) for mask in masks], axis=1)
        levels -= levels.mean(axis=1, keepdims=True)
        basis = walk_modes(time)
        square = (basis.of(levels) ** 2).sum(axis=1) / (len(masks) - 1)
        noise = np.full(len(square), np.mean([_noise(rest, mask) for mask in masks]) + _LEAST)
        parts.append((square, noise, np.ones(len(square)), basis.walk))
    square, noise, *shapes = (np.concatenate(own) for own in zip(*parts, strict=True))
    shape, size = np.stack(shapes), np.zeros(2)
    for _ in range(_STEPS):
        weight = (len(masks) - 1) / (2 * (np.maximum(size, 0) @ shape + noise) ** 2)
        normal = (weight * shape) @ shape.T
        size = np.linalg.solve(normal, (weight * shape) @ (square - noise))
        if size.min() < 0:
            # Only the other component.
            other = int(size.argmax())
            size = np.zeros(2)
            size[other] = (weight * shape[other]) @ (square - noise) / normal[other, other]
    error = np.sqrt(np.diag(np.linalg.inv(normal)))
    return (float(size[0]), float(size[1])), (float(error[0]), float(error[1]))


def _noise(rest: F32, mask: Mask) -> float:
    """Variance of the mean of a rectangle of pixels without its bad ones."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    cut = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    noise, used = rest[:, *cut] * mask[cut], np.maximum(np.count_nonzero(mask), 1)
    ny, nx = mask[cut].shape
    noise = noise - noise.sum(axis=(1, 2), keepdims=True) / used
    pixels = float(np.square(noise, dtype=float).sum()) / len(noise) / used
    lines = [noise.sum(axis=a) / np.maximum(mask[cut].sum(axis=a - 1), 1) for a in (2, 1)]
    # Neighbours: noise shared by distant rows is shared by neighbouring ones too.
    of_rows, of_columns = (float(np.square(line, dtype=float).mean()) for line in lines)
    return float(max(of_rows / ny + of_columns / nx - pixels / used, 0.0))
