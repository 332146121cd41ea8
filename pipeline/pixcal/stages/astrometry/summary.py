"""The errors of the stars as the numbers of ``astrometry.json``, and as a table.

True offsets t, errors of the maps e and their draw d are independent; e and d have equal variance.
Stars fitted on a perfect grid have errors K(t + e + d), K being the weights of the pixels; those
fitted with mapped positions have errors K d. So the mean square due to true offsets is the first
mean square minus twice the second.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from pixcal.model.arrays import F64
from pixcal.stages.astrometry.stars import GRIDS, KINDS

TARGET_PX = 5e-5  # what a mission to Earth-like planets needs (paper, section 1)
SEEN = 2.0  # least ratio of a significant mean square to its error


class Value(NamedTuple):
    """A number and its 1-sigma error by resampling the stars; NaN if undefined."""

    value: float
    error: float


# root mean square errors of centroids, px: `perfect` and `measured` with pixels assumed on a
# perfect grid and at mapped positions, and `gain`, the ratio of both; `perfect` is NaN if the
# scatter of the offsets is not significant above the maps' errors
GridComparison = dict[str, Value]


def compare(perfect: F64, measured: F64, noise: F64, rng: np.random.Generator) -> GridComparison:
    """Root mean squares of errors (star, position), px, NaN where missing.

    ``noise``: errors due to the maps, whose mean square ``perfect`` contains twice; zero if the
    truth is given.
    """
    columns = (perfect**2, measured**2, noise**2)
    good = np.isfinite(perfect) & np.isfinite(measured)
    sums = np.stack([np.where(good, c, 0.0).sum(axis=1) for c in columns] + [good.sum(axis=1)])
    rms, stars = _roots(sums.sum(axis=1)), sums.shape[1]
    picks = (np.bincount(rng.integers(0, stars, stars), minlength=stars) for _ in range(300))
    again = np.array([_roots(sums @ pick) for pick in picks])
    # Squares, because their errors are meaningful even if they are negative.
    square_error = np.std(again[:, 3])
    if not rms[3] > SEEN * square_error:
        rms[0] = rms[2] = np.nan
    finite = [column[np.isfinite(column)] for column in again.T[:3]]
    errors = [float(np.std(values)) if len(values) > 1 else math.nan for values in finite]
    values = map(Value, rms[:3].tolist(), errors)
    return dict(zip((*GRIDS, "gain"), values, strict=True))


def _roots(sums: F64) -> F64:
    """Perfect, measured, gain, and square of the first, from sums of squares and a count."""
    perfect, measured, noise = sums[:3] / max(sums[3], 1)
    square = perfect - 2 * noise
    root = np.sqrt(square) if square > 0 else np.nan
    other = np.sqrt(measured)
    return np.array([root, other, root / other if other > 0 else np.nan, square])


def running_means(errors: F64, lengths: list[int]) -> list[F64]:
    """Mean (star, 1) of errors (star, position) over each star's first positions, NaN left out."""
    good = np.isfinite(errors)
    sums, counts = np.cumsum(np.where(good, errors, 0.0), axis=1), np.cumsum(good, axis=1)
    means = sums / np.where(counts > 0, counts, np.nan)
    return [means[:, n - 1 : n] for n in lengths]


def axis_facts(
    errors: F64, bound: float, uas_per_px: float, *, drawn: bool, rng: np.random.Generator
) -> dict[str, Any]:
    """Results along one axis, of errors (star, position, kind) of `stars.observe`, px.

    ``bound``: Cramér-Rao bound of one position, px. ``drawn``: the detector is maps plus errors.
    """
    kinds = dict(zip(KINDS, np.moveaxis(errors, -1, 0), strict=True))

    def compared(of: Mapping[str, F64], suffix: str) -> GridComparison:
        noise = of["measured"] if drawn else np.zeros_like(of["measured"])
        return compare(of["perfect" + suffix], of["measured" + suffix], noise, rng)

    # Powers of two, and the number of positions.
    positions = errors.shape[1]
    lengths = sorted({2**n for n in range(positions.bit_length())} | {positions})
    means = {kind: running_means(values, lengths) for kind, values in kinds.items()}
    averaged = [
        compared({kind: values[n] for kind, values in means.items()}, "_photons")
        for n in range(len(lengths))
    ]
    # Pairs of stars; an unpaired star is left out.
    last = {kind: values[-1] for kind, values in means.items()}
    pairs = {kind: v[1::2] - v[: len(v) // 2 * 2 : 2] for kind, v in last.items()}
    photons = compared(kinds, "_photons")
    times = {grid: photons[grid].value / TARGET_PX for grid in GRIDS}
    positions_needed = {g: math.ceil(t**2) if math.isfinite(t) else None for g, t in times.items()}
    second = kinds["perfect"] - kinds["linear"]
    second = second[np.isfinite(second)]
    return {
        "floor": _facts(compared(kinds, ""), uas_per_px),
        "photon_bound": number(Value(bound, math.nan), uas_per_px),
        "photons": _facts(photons, uas_per_px),
        "averaged": _facts(averaged[-1], uas_per_px),
        "separation": _facts(compared(pairs, "_photons"), uas_per_px),
        "averaging": {"positions": lengths}
        | {
            f"{grid}{suffix}_px": [_finite(c[grid][n]) for c in averaged]
            for grid in GRIDS
            for n, suffix in enumerate(("", "_err"))
        },
        "positions_to_target": {"target_px": TARGET_PX, **positions_needed},
        "second_order_px": _finite(float(np.sqrt(np.mean(second**2)))) if len(second) else None,
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def number(value: Value, uas_per_px: float) -> dict[str, float | None]:
    """A length on the detector and on the sky."""
    return {
        "px": _finite(value.value),
        "err_px": _finite(value.error),
        "uas": _finite(value.value * uas_per_px),
        "err_uas": _finite(value.error * uas_per_px),
    }


def _facts(comparison: GridComparison, uas_per_px: float) -> dict[str, Any]:
    value, error = map(_finite, comparison["gain"])
    grids = {grid: number(comparison[grid], uas_per_px) for grid in GRIDS}
    return grids | {"gain": {"value": value, "err": error}}


def table(result: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The main rows of ``astrometry.json``: case, axis, perfect grid, measured maps, gain."""
    stars = result["stars"]
    cases = {
        "floor": "no photon noise",
        "photons": f"{scientific(stars['electrons'])} e-",
        "averaged": f"mean of {stars['positions']} positions",
        "separation": "between two stars",
    }
    if stars["positions"] == 1:
        del cases["averaged"]
    rows = []
    for key, case in cases.items():
        for name, axis in result["axes"].items():
            gain, error = axis[key]["gain"]["value"], axis[key]["gain"]["err"]
            times = "-" if gain is None else with_error(gain, error)
            rows.append((case, name, *(_length(axis[key][grid]) for grid in GRIDS), times))
    return rows


def scientific(value: float) -> str:
    """Three digits, large or small numbers with a short exponent: ``1e8``."""
    mantissa, _, exponent = f"{value:.3g}".partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent else mantissa


def with_error(value: float, error: float | None) -> str:
    """The value rounded to its error's first digit (two where that is a one)."""
    if not error or not math.isfinite(error):
        return scientific(value)
    # A value that rounds up to a power of ten takes its exponent.
    exponent = math.floor(math.log10(abs(value) + error / 2))
    shown = 0 if -2 < exponent < 4 else exponent
    value, error = value / 10.0**shown, error / 10.0**shown
    first = math.floor(math.log10(error))
    decimals = max(0, -first + (error / 10.0**first < 2))
    text = f"{value:.{decimals}f} ± {error:.{decimals}f}"
    return f"({text})e{shown}" if shown else text


def _length(entry: Mapping[str, Any]) -> str:
    if entry["px"] is None:
        return "not significant"
    return f"{with_error(entry['px'], entry['err_px'])} px, {entry['uas']:.3g} µas"
