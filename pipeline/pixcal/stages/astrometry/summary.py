"""The errors of the stars as the numbers of ``astrometry.json``, and as a table."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.star_centroids.errors import Comparison, Value, compare, running_means
from pixcal.stages.astrometry.simulation import KINDS

F64 = NDArray[np.float64]

TARGET_PX = 5e-5  # what a mission to Earth-like planets needs (paper, section 1)


@dataclass(frozen=True)
class Row:
    """A row of the table, as text."""

    case: str
    axis: str
    perfect: str
    measured: str
    gain: str


def axis_facts(
    errors: F64, bound: float, uas_per_px: float, *, drawn: bool, rng: np.random.Generator
) -> dict[str, Any]:
    """Results along one axis.

    Parameters
    ----------
    errors : (star, position, kind) float64
        As `pixcal.stages.astrometry.simulation.observe` leaves them, px.
    bound : float
        Cramér-Rao bound of one position, px.
    uas_per_px : float
        Plate scale.
    drawn : bool
        Whether the detector is the maps and a draw of their errors.
    """
    kinds = dict(zip(KINDS, np.moveaxis(errors, -1, 0), strict=True))

    def compared(of: Mapping[str, F64], suffix: str) -> Comparison:
        noise = of["measured"] if drawn else np.zeros_like(of["measured"])
        return compare(of["perfect" + suffix], of["measured" + suffix], noise, rng)

    lengths = averaging_lengths(errors.shape[1])
    means = {kind: running_means(values, lengths) for kind, values in kinds.items()}
    averaged = [
        compared({kind: values[n] for kind, values in means.items()}, "_photons")
        for n in range(len(lengths))
    ]
    pairs = {kind: np.diff(_paired(values[-1]), axis=1) for kind, values in means.items()}
    photons = compared(kinds, "_photons")
    return {
        "floor": _facts(compared(kinds, ""), uas_per_px),
        "photon_bound": number(Value(bound, math.nan), uas_per_px),
        "photons": _facts(photons, uas_per_px),
        "averaged": _facts(averaged[-1], uas_per_px),
        "separation": _facts(compared(pairs, "_photons"), uas_per_px),
        "averaging": {
            "positions": lengths,
            **{
                f"{grid}{suffix}_px": [
                    _finite(getattr(getattr(comparison, grid), field)) for comparison in averaged
                ]
                for grid in ("perfect", "measured")
                for suffix, field in (("", "value"), ("_err", "error"))
            },
        },
        "positions_to_target": {
            "target_px": TARGET_PX,
            "perfect": _positions(photons.perfect.value),
            "measured": _positions(photons.measured.value),
        },
        "second_order_px": _finite(_rms(kinds["perfect"] - kinds["linear"])),
    }


def averaging_lengths(positions: int) -> list[int]:
    """Powers of two, and the number of positions."""
    return sorted({2**n for n in range(positions.bit_length())} | {positions})


def _paired(values: F64) -> F64:
    """Pairs of stars, one per row; an unpaired star is left out."""
    return values[: len(values) // 2 * 2].reshape(-1, 2)


def _rms(values: F64) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else math.nan


def _positions(error: float) -> int | None:
    return math.ceil((error / TARGET_PX) ** 2) if math.isfinite(error) else None


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


def _facts(comparison: Comparison, uas_per_px: float) -> dict[str, Any]:
    return {
        "perfect": number(comparison.perfect, uas_per_px),
        "measured": number(comparison.measured, uas_per_px),
        "gain": {"value": _finite(comparison.gain.value), "err": _finite(comparison.gain.error)},
    }


def table(result: Mapping[str, Any]) -> list[Row]:
    """The main rows of ``astrometry.json``."""
    stars = result["stars"]
    cases = {
        "floor": "no photon noise",
        "photons": f"{scientific(stars['electrons'])} e-",
        "averaged": f"mean of {stars['positions']} positions",
        "separation": "between two stars",
    }
    if stars["positions"] == 1:
        del cases["averaged"]
    return [
        Row(
            case,
            name,
            _length(axis[key]["perfect"]),
            _length(axis[key]["measured"]),
            _times(axis[key]["gain"]),
        )
        for key, case in cases.items()
        for name, axis in result["axes"].items()
    ]


def scientific(value: float) -> str:
    """Three digits, large or small numbers with a short exponent: ``1e8``."""
    mantissa, _, exponent = f"{value:.3g}".partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent else mantissa


def with_error(value: float, error: float | None) -> str:
    """The value rounded to its error's first digit (two where that is a one)."""
    if not error or not math.isfinite(error):
        return scientific(value)
    # What rounds up to a power of ten is written as one.
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


def _times(entry: Mapping[str, Any]) -> str:
    return "-" if entry["value"] is None else with_error(entry["value"], entry["err"])
