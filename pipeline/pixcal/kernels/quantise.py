"""Store electrons in two bytes per sample: choice of the step, and conversion of raw frames.

``electrons = scale * code + offset``; rounding to a step adds ``scale² / 12`` to a sample's
variance. This is negligible if the step is well below the read noise, the more so with photon
noise, which grows with the level.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels import inner, kernel
from pixcal.model.arrays import F32

FILL = 65535  # code of a sample without weight
_DIGITS = 7


@dataclass(frozen=True)
class Scale:
    """Codes 0 to 65534 cover ``offset`` to ``offset + 65534 step`` electrons."""

    step: float  # step, offset: in electrons; `scale_factor` and `add_offset` of CF
    offset: float

    @property
    def variance(self) -> float:
        """Variance that rounding adds to a sample (e-²)."""
        return self.step**2 / 12


def choose_scale(low: float, high: float, smallest_variance: float, share: float) -> Scale:
    """Coarsest step that covers a range (e-) and adds less than a share of the variance (e-²)."""
    # Steps are powers of two if possible, so that integers stay exact, and offsets are whole steps.
    # If the range needs a coarser step than the noise allows, the range has priority.
    span = max(high - low, 1e-6)
    # Two codes in reserve, because the offset is rounded down and the ends are rounded.
    needed = span / (FILL - 3)
    allowed = math.sqrt(12 * share * smallest_variance)
    step = 2.0 ** math.floor(math.log2(allowed)) if allowed > 0 else 0.0
    if step < needed:
        unit = 2.0 ** (math.floor(math.log2(needed)) - _DIGITS)
        step = math.ceil(needed / unit) * unit
    return Scale(step, math.floor(low / step) * step)


# Separate loops: one loop that also counts takes twice as long.


@inner(fastmath={"contract"})
def _encode_row(
    raw: Any, slope: Any, start: Any, dark: Any, exptime: float, saturation: float, codes: Any
) -> None:
    zero, fill = np.float32(0), np.float32(FILL)
    for i in range(raw.size):
        sample = np.float32(raw[i])
        value = sample * slope[i] + (start[i] - dark[i] * exptime)
        # Both false for NaN; infinite samples are saturated or below the range.
        inside = (value >= zero) & (value < fill) & (sample < saturation)
        codes[i] = np.int32(value if inside else fill)


@inner()
def _sum_row(codes: Any) -> Any:
    total, fills = np.uint32(0), np.uint32(0)
    for i in range(codes.size):
        total += np.uint32(codes[i])
        fills += np.uint32(codes[i] == FILL)
    return np.int64(total), np.int64(fills)


@inner()
def _count_row(raw: Any, saturation: float, codes: Any, saturated: Any, lost: Any) -> None:
    for i in range(raw.size):
        if codes[i] == FILL:
            if np.float32(raw[i]) >= saturation:
                saturated[i] += 1
            else:
                lost[i] += 1


@kernel()
def encode(
    raw: Any,
    slope: Any,
    start: Any,
    dark: Any,
    exptime: Any,
    saturation: float,
    codes: Any,
    saturated: Any,
    lost: Any,
    x0: int = 0,
) -> int:
    """Convert raw frames of a tile to codes: ``raw * slope + start - dark * exptime``, truncated.

    Returns the sum of the codes that have weight. Fastest if the frames fit the cache.

    raw : (t, y, at least x0 + x) samples, ADU; the tile's columns begin at ``x0`` (a copy of them
        would double the time)
    slope, start, dark : (y, x) float32 from `coefficients`
    exptime : (t,) float32 exposure times, s
    saturation : level (ADU, float32) at or above which samples get `FILL`, as do those out of range
    codes : (t, y, x) uint16, written
    saturated, lost : (y, x) uint32, added to: saturated samples; others without weight
    """
    total = 0
    nx = codes.shape[2]
    for y in range(raw.shape[1]):
        for t in range(raw.shape[0]):
            row = raw[t, y, x0 : x0 + nx]
            _encode_row(row, slope[y], start[y], dark[y], exptime[t], saturation, codes[t, y])
            part, fills = _sum_row(codes[t, y])
            total += part - fills * FILL
            if fills:
                _count_row(row, saturation, codes[t, y], saturated[y], lost[y])
    return total


def coefficients(
    scale: Scale, gain: float, bias: F32, dark_rate: F32, flat: F32
) -> tuple[F32, F32, F32]:
    """Coefficients of `encode` for codes ``(gain (raw - bias) - dark t) / flat``, rounded.

    From ``gain`` (e-/ADU), ``bias`` (ADU), ``dark_rate`` (e-/s) and relative ``flat``, all (y, x):
    slope (codes/ADU), start (codes) and dark (codes/s).
    """
    to_codes = 1 / (scale.step * flat.astype(float))
    slope = gain * to_codes
    start = 0.5 - gain * bias * to_codes - scale.offset / scale.step
    dark = dark_rate * to_codes
    return slope.astype(np.float32), start.astype(np.float32), dark.astype(np.float32)


def extremes(raw: NDArray[Any], saturation: float, lowest: F32, highest: F32, x0: int = 0) -> None:
    """Widen the range of each pixel's samples below saturation by those of more frames.

    ``raw``: as in `encode`. ``lowest``, ``highest``: (y, x) float32, initially +inf and -inf.
    """
    for frame in raw[:, :, x0 : x0 + lowest.shape[1]]:
        samples = frame.astype(np.float32)
        good = samples < saturation  # false for NaN
        np.minimum(lowest, np.where(good, samples, np.inf), out=lowest)
        np.maximum(highest, np.where(good, samples, -np.inf), out=highest)
