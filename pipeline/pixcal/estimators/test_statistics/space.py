"""Statistics in space: structure of the maps, and agreement of the fringe sets."""

from collections.abc import Sequence
from functools import partial
from itertools import combinations

import numpy as np

from pixcal.estimators.fringe_fit.combine import SAME_AXIS
from pixcal.estimators.maps import structure
from pixcal.estimators.maps.stitching import FieldFit
from pixcal.estimators.test_statistics import Curve, family, statistic
from pixcal.estimators.test_statistics.fringe_set_data import FringeSetData, by_cell
from pixcal.model.arrays import F64, Mask

of_space = partial(statistic, "space")
of_space_power = partial(statistic, "space", power=True)


@of_space("correlation of maps between sets", "correlation", x="contrast, light of each pair")
def alike(sets: Sequence[FringeSetData]) -> Curve:
    """Correlation of the maps of each pair of sets."""
    values = [
        _correlation(one.flat_maps[name], other.flat_maps[name])
        for one, other in combinations(sets, 2)
        for name in ("contrast", "light")
    ]
    return Curve.numbered(values)


def _correlation(one: F64, other: F64) -> float:
    good = np.isfinite(one) & np.isfinite(other)
    return float(np.corrcoef(one[good], other[good])[0, 1])


@of_space_power("difference of offsets between sets", "rms difference", unit="px", x="pair")
def apart(sets: Sequence[FringeSetData]) -> Curve:
    """Mean square of the difference of the offsets along one axis, by two baselines."""
    values = []
    for one, other in combinations(sets, 2):
        a, b = np.array(one.fringes.k), np.array(other.fringes.k)
        cosine = float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
        if abs(cosine) > SAME_AXIS:
            rest = one.maps["offset"] - np.sign(cosine) * other.maps["offset"]
            values.append(float(np.nanmean(structure.flattened(rest) ** 2)))
    return Curve.numbered(values)


# name, what it is, unit, what its low orders are
MAPS = (
    ("offset", "offset", "px", "curvature"),
    ("contrast", "relative contrast", "", "large-scale variation"),
    ("light", "relative level", "", "large-scale variation"),
)
BINS = 6
# px; standard deviation of harmonics that is irrelevant, a fiftieth of what stars need
IRRELEVANT = {"offset": 1e-6, "contrast": 0.0, "light": 0.0}
FLOOR = 0.3  # least standard deviation of a term over the one that the map's own scatter gives


# each with the axis of the lines
AXES = {"rows": 0, "columns": 1}
MAP_LINES = tuple((f"{m[0]}_{lines}", *m, lines) for m in MAPS for lines in AXES)


@family(
    "{0}_repeat", MAP_LINES, "space", "{1}: periodic pattern of {5}", "{2}", unit="{3}",
    x="period, {5}",
)  # fmt: skip
def repeats_of_lines(of: str, data: FringeSetData) -> Curve:
    """Size of patterns that repeat over rows or columns."""
    name, lines = of.split("_")
    size = np.abs(structure.repeats(data.maps_without_fringes[name], AXES[lines]))
    return Curve(np.array(structure.PERIODS, float), size)


@family(
    "{0}", MAP_LINES, "space", "{1}: profile of {5}", "{2}, rms", unit="{3}", x="cycles a pixel",
    power=True,
)  # fmt: skip
def profiles_of_lines(of: str, data: FringeSetData) -> Curve:
    """Power of the means of rows or columns."""
    name, lines = of.split("_")
    along = structure.profile(data.maps_without_fringes[name], AXES[lines])
    power = np.abs(np.fft.rfft(along)[1:]) ** 2 * 2 / len(along) ** 2
    return _binned(np.arange(1, len(power) + 1) / len(along), power)


@family(
    "{0}_fringes", MAPS, "space", "{0}: residual fringes, first and second harmonic", "{1}",
    unit="{2}", x="harmonic (cosine, sine)", floor=IRRELEVANT,
)  # fmt: skip
def residual_fringes(name: str, data: FringeSetData) -> Curve:
    """Amplitudes of the fringes left in a map."""
    sizes = structure.fit_terms(data.flat_maps[name], data.fringe_terms)
    return Curve(np.array([1.0, 1.25, 2.0, 2.25]), sizes)


# Light is excluded: its surface was removed, so only the influence of outliers remains.
@family(
    "{0}_bending", MAPS, "space", "{0}: {3}", "coefficient", unit="σ", x="Legendre term",
    floor=FLOOR,
)  # fmt: skip
def low_orders(name: str, data: FringeSetData) -> Curve:
    """Legendre terms, over their size by chance in an equally red map."""
    values = data.maps[name]
    terms = structure.legendre(values.shape, 4 if name == "contrast" else 3)
    field = data.stitched if name == "offset" else np.zeros(values.shape, np.intp)
    fit = FieldFit.of(values, terms[1:], field)
    error = np.sqrt(fit.variance * structure.redness(fit.rest) * np.diag(fit.covariance))
    # Two Gaussian beams cause curvature of the contrast in any direction, but no higher terms.
    first = 3 if name != "contrast" else 6
    pulls = fit.values / np.maximum(error, 1e-300)
    return Curve(np.arange(first, len(terms), dtype=float), pulls[first - 1 :])


def _power_beside_lines(values: F64) -> tuple[F64, F64, F64, Mask]:
    """Power (y, x) of a map's Fourier transform, its frequencies, and which are used."""
    # Rows, columns and their means have statistics of their own.
    power: F64 = np.abs(np.fft.rfft2(np.nan_to_num(values))) ** 2
    fy = np.fft.fftfreq(values.shape[0]).astype(float)[:, None]
    fx = np.fft.rfftfreq(values.shape[1]).astype(float)[None, :]
    apart: Mask = (np.abs(fy) > 1.5 / values.shape[0]) & (np.abs(fx) > 1.5 / values.shape[1])
    return power, fy, fx, apart


@family(
    "{0}_scales", MAPS, "space", "{0}: power by spatial frequency", "{1}, rms", unit="{2}",
    x="cycles a pixel", power=True,
)  # fmt: skip
def scales(name: str, data: FringeSetData) -> Curve:
    """Power in bins of spatial frequency."""
    values = data.maps_without_fringes[name]
    power, fy, fx, apart = _power_beside_lines(values)
    power = power / values.size**2
    return _binned(np.hypot(fy, fx)[apart], power[apart] * values.size)


@family(
    "{0}_peak", MAPS, "space", "{0}: strongest isolated spatial frequency", "{1}, rms", unit="{2}",
    x="cycles a pixel", power=True,
)  # fmt: skip
def peak(name: str, data: FringeSetData) -> Curve:
    """Highest power of a single frequency."""
    values = data.maps_without_fringes[name]
    power, fy, fx, apart = _power_beside_lines(values)
    at = np.unravel_index(int(np.argmax(np.where(apart, power, 0))), power.shape)
    highest = float(power[at]) / values.size**2 * 4
    return Curve(np.array([float(np.hypot(fy[at[0], 0], fx[0, at[1]]))]), np.array([highest]))


@family(
    "{0}_by_place", MAPS, "space", "{0}: power by position", "{1}, rms", unit="{2}",
    x="cell of 4 × 4", power=True,
)  # fmt: skip
def by_place(name: str, data: FringeSetData) -> Curve:
    """Mean square in cells of the window."""
    squares = data.maps_without_fringes[name] ** 2
    return Curve.numbered(by_cell(squares, np.isfinite(squares)))


def _binned(frequency: F64, power: F64) -> Curve:
    """Mean power in `BINS` bins of frequency, each twice as wide as the one before."""
    edges = 0.5 * 2.0 ** np.arange(-BINS + 1, 1)
    number = np.searchsorted(edges, frequency)
    middle, value = [], []
    for n in range(BINS):
        inside = number == n
        if inside.sum() >= 3:
            middle.append(float(frequency[inside].mean()))
            value.append(float(power[inside].mean()))
    return Curve(np.array(middle), np.array(value))
