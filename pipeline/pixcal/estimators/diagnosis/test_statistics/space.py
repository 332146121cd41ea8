"""Statistics in space: structure of the maps, and how far fringe sets agree on them."""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from pixcal.estimators.diagnosis.test_statistics import Curve, Statistic, statistic
from pixcal.estimators.diagnosis.test_statistics.look import CELLS, Look, by_cell
from pixcal.estimators.maps.structure import (
    PERIODS,
    fit_terms,
    flattened,
    legendre,
    profile,
    redness,
    repeats,
)
from pixcal.model.arrays import F64

SAME = 0.98  # cosine of the angle below which two sets measure along the same axis


@statistic(
    "space",
    "correlation of maps between sets",
    "correlation",
    x="contrast, light of each pair",
    together=True,
)
def alike(looks: Sequence[Look]) -> Curve | None:
    """Correlation of the maps of each pair of sets."""
    values = [
        _correlation(one.flat_maps[name], other.flat_maps[name])
        for one, other in combinations(looks, 2)
        for name in ("contrast", "light")
    ]
    return Curve(np.arange(len(values), dtype=float), np.array(values)) if values else None


def _correlation(one: F64, other: F64) -> float:
    good = np.isfinite(one) & np.isfinite(other)
    return float(np.corrcoef(one[good], other[good])[0, 1])


@statistic(
    "space",
    "difference of offsets between sets",
    "rms difference",
    unit="px",
    x="pair",
    power=True,
    together=True,
)
def apart(looks: Sequence[Look]) -> Curve | None:
    """Mean square of the difference of the offsets along one axis, by two baselines."""
    values = []
    for one, other in combinations(looks, 2):
        a, b = np.array(one.found.k), np.array(other.found.k)
        cosine = float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
        if abs(cosine) > SAME:
            other_map = np.sign(cosine) * other.maps["offset"]
            values.append(float(np.nanmean(flattened(one.maps["offset"] - other_map) ** 2)))
    return Curve(np.arange(len(values), dtype=float), np.array(values)) if values else None


UNITS = {"offset": "px", "contrast": "", "light": ""}
QUANTITIES = {"offset": "offset", "contrast": "relative contrast", "light": "relative level"}
LINES = {0: "rows", 1: "columns"}
VARIATION = {
    "offset": "curvature",
    "contrast": "large-scale variation",
    "light": "large-scale variation",
}
BINS = 6
IRRELEVANT = {"offset": 1e-6}  # px; standard deviation of harmonics, a fiftieth of what stars need
FLOOR = 0.3  # least standard deviation of a term over the one that the map's own scatter gives


def _power(name: str, title: str, x: str) -> Callable[[Callable[[Any], Curve | None]], Statistic]:
    """Mark a function of mean squares of a map."""
    quantity = f"{QUANTITIES[name]}, rms"
    return statistic("space", title, quantity, unit=UNITS[name], x=x, power=True)


def _repeats(name: str, axis: int) -> Statistic:
    def measured(look: Look) -> Curve:
        size = np.abs(repeats(look.maps_beside_fringes[name], axis))
        return Curve(np.array(PERIODS, float), size)

    measured.__name__ = f"{name}_{LINES[axis]}_repeat"
    title = f"{name}: periodic pattern of {LINES[axis]}"
    x = f"period, {LINES[axis]}"
    return statistic("space", title, QUANTITIES[name], unit=UNITS[name], x=x)(measured)


def _profile(name: str, axis: int) -> Statistic:
    def measured(look: Look) -> Curve:
        along = profile(look.maps_beside_fringes[name], axis)
        power = np.abs(np.fft.rfft(along)[1:]) ** 2 * 2 / len(along) ** 2
        return _binned(np.arange(1, len(power) + 1) / len(along), power)

    measured.__name__ = f"{name}_{LINES[axis]}"
    title = f"{name}: profile of {LINES[axis]}"
    return _power(name, title, "cycles a pixel")(measured)


def _fringes(name: str) -> Statistic:
    def measured(look: Look) -> Curve:
        sizes = fit_terms(look.flat_maps[name], look.fringe_terms)
        return Curve(np.array([1.0, 1.25, 2.0, 2.25]), sizes)

    measured.__name__ = f"{name}_fringes"
    title = f"{name}: residual fringes, first and second harmonic"
    return statistic(
        "space",
        title,
        QUANTITIES[name],
        unit=UNITS[name],
        x="harmonic (cosine, sine)",
        floor=IRRELEVANT.get(name, 0.0),
    )(measured)


def _low_orders(name: str) -> Statistic:
    def measured(look: Look) -> Curve:
        """Over what a map as red as this one has by chance."""
        values = look.maps[name]
        terms = legendre(values.shape, 4 if name == "contrast" else 3)
        size = fit_terms(values, terms)
        rest = values - np.tensordot(size, terms, 1)
        good = np.isfinite(rest)
        variance = float(np.nanvar(rest)) * redness(rest)
        error = np.sqrt(variance / (terms[:, good] ** 2).sum(axis=1))
        # Two Gaussian beams make a contrast that bends in any direction, but no more than that.
        first = 3 if name != "contrast" else 6
        return Curve(np.arange(first, len(terms), dtype=float), (size / error)[first:])

    measured.__name__ = f"{name}_bending"
    title = f"{name}: {VARIATION[name]}"
    # Of light, whose surface is taken off, nothing is left but what outliers do to it.
    return statistic("space", title, "coefficient", unit="σ", x="Legendre term", floor=FLOOR)(
        measured
    )


def _scales(name: str) -> Statistic:
    def measured(look: Look) -> Curve:
        values = np.nan_to_num(look.maps_beside_fringes[name])
        power = np.abs(np.fft.rfft2(values)) ** 2 / values.size**2
        fy = np.fft.fftfreq(values.shape[0])[:, None]
        fx = np.fft.rfftfreq(values.shape[1])[None, :]
        radius = np.hypot(fy, fx)
        # Rows, columns and their means have statistics of their own.
        apart = (np.abs(fy) > 1.5 / values.shape[0]) & (np.abs(fx) > 1.5 / values.shape[1])
        return _binned(radius[apart], power[apart] * values.size, 0.5)

    measured.__name__ = f"{name}_scales"
    title = f"{name}: power by spatial frequency"
    return _power(name, title, "cycles a pixel")(measured)


def _peak(name: str) -> Statistic:
    def measured(look: Look) -> Curve:
        values = np.nan_to_num(look.maps_beside_fringes[name])
        power = np.abs(np.fft.rfft2(values)) ** 2
        fy = np.fft.fftfreq(values.shape[0])[:, None]
        fx = np.fft.rfftfreq(values.shape[1])[None, :]
        apart = (np.abs(fy) > 1.5 / values.shape[0]) & (np.abs(fx) > 1.5 / values.shape[1])
        at = np.unravel_index(int(np.argmax(np.where(apart, power, 0))), power.shape)
        highest = float(power[at]) / values.size**2 * 4
        return Curve(np.array([float(np.hypot(fy[at[0], 0], fx[0, at[1]]))]), np.array([highest]))

    measured.__name__ = f"{name}_peak"
    title = f"{name}: strongest isolated spatial frequency"
    return _power(name, title, "cycles a pixel")(measured)


def _by_place(name: str) -> Statistic:
    def measured(look: Look) -> Curve | None:
        squares = look.maps_beside_fringes[name] ** 2
        cells = by_cell(squares, np.isfinite(squares))
        return None if cells is None else Curve(np.arange(float(CELLS**2)), cells)

    measured.__name__ = f"{name}_by_place"
    title = f"{name}: power by position"
    return _power(name, title, "cell of 4 × 4")(measured)


def _binned(frequency: F64, power: F64, highest: float = 0.5) -> Curve:
    """Mean power in `BINS` bins of frequency, each twice as wide as the one before."""
    edges = highest * 2.0 ** np.arange(-BINS + 1, 1)
    number = np.searchsorted(edges, frequency)
    middle, value = [], []
    for n in range(BINS):
        inside = number == n
        if inside.sum() >= 3:
            middle.append(float(frequency[inside].mean()))
            value.append(float(power[inside].mean()))
    return Curve(np.array(middle), np.array(value))


_OF_AXIS: tuple[Callable[[str, int], Statistic], ...] = (_repeats, _profile)
_OF_MAP: tuple[Callable[[str], Statistic], ...] = (
    _fringes,
    _low_orders,
    _scales,
    _peak,
    _by_place,
)

STATISTICS = tuple(
    [make(name, axis) for make in _OF_AXIS for name in UNITS for axis in LINES]
    + [make(name) for make in _OF_MAP for name in UNITS]
)
