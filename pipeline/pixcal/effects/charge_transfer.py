"""Charge that traps in a CCD hold back during its transfer to the output."""

import math
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.crosstalk.trails import Trail, trailing, trails
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F32, Indices
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

_REST = 1e-3  # part of a trail that is neglected
_MOST = 0.5  # share of its charge that a pixel can lose


@dataclass(frozen=True)
class ChargeTransfer(Effect):
    """Pixels lose charge to those behind them, in proportion to the number of transfers."""

    name = "charge_transfer"
    title = "charge-transfer inefficiency"
    acts_at = Stage.SIGNAL
    order = -1
    domains = ("space", "noise")
    strengths = ("rows", "columns")
    frames_needed = ("dark",)
    remedy = "correct frames with a model of the traps, cool or warm the CCD, or add a background"
    sources = (
        "Massey et al. 2010, MNRAS 401, 371: trails of hot pixels of the ACS on HST; traps take "
        "charge in proportion to a power of about 0.6 of it",
        "Short et al. 2013, MNRAS 430, 3078: charge-transfer inefficiency of CCDs, 1e-6 to 1e-4",
    )

    rows: float = quantity(3e-5, low=0, high=0.01)
    """share of the charge level_e that each transfer from row to row leaves behind"""
    columns: float = quantity(0.0, low=0, high=0.01)
    """the same from column to column"""
    row_release_px: float = quantity(2.0, unit="px", low=0.1, high=100)
    """length over which the trail along a column falls by a factor e"""
    column_release_px: float = quantity(2.0, unit="px", low=0.1, high=100)
    """the same along a row"""
    output_row: int = quantity(0, unit="px")
    """row next to the output, on the chip"""
    output_column: int = quantity(0, unit="px")
    """column next to the output, on the chip"""
    power: float = quantity(0.6, low=0, high=1.5)
    """exponent: the charge left behind is proportional to this power of the charge"""
    level_e: float = quantity(10_000.0, unit="e-", above=0, high=1e7)
    """charge to which `rows` and `columns` apply"""

    @property
    def halo(self) -> int:
        """Length of a trail along a column, rows."""
        return _length(self.row_release_px) if self.rows else 0

    def signal(self, signal: F32, shot: Shot) -> F32:
        detector = shot.bench.detector
        y = np.arange(*shot.rows) + detector.origin[0]
        x = np.arange(detector.shape[1]) + detector.origin[1]
        trailed = self._trailed(signal, self.rows, self.row_release_px, y, self.output_row)
        along = trailed.T
        along = self._trailed(along, self.columns, self.column_release_px, x, self.output_column)
        return np.ascontiguousarray(along.T)

    def _trailed(self, signal: F32, loss: float, release: float, at: Indices, output: int) -> F32:
        """Signal (line, pixel) after transfer from line to line; ``at``: numbers of the lines."""
        if not loss or not len(at):
            return signal
        if at[0] < output:
            # Lines up to the output are read in the other direction.
            cut = int(np.searchsorted(at, output, "right"))
            before, after = signal[:cut][::-1], signal[cut:]
            before = self._trailed(before, loss, release, -at[:cut][::-1], -output)
            after = self._trailed(after, loss, release, at[cut:], output)
            return np.concatenate([before[::-1], after])
        charge = np.maximum(signal, np.float32(1e-6))
        left = np.minimum(loss * (at[:, None] - output + 1), _MOST) * self.level_e
        left = np.minimum(left * (charge / self.level_e) ** self.power, _MOST * charge)
        left = left.astype(np.float32)
        trailed = signal - left
        ratio = math.exp(-1 / release)
        for n in range(1, min(_length(release) + 1, len(signal))):
            trailed[n:] += np.float32((1 - ratio) * ratio ** (n - 1)) * left[:-n]
        return np.asarray(trailed, np.float32)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Trails of hot pixels in darks that grow with the distance from the output."""
        both = trails(evidence)
        if both is None:
            return None
        there = [one.significance > SIGNIFICANT for one in both]
        (rows, columns), best = both, max(both, key=lambda one: one.significance)
        made = cls(
            rows=rows.loss[0] if there[0] else 0.0,
            columns=columns.loss[0] * _scale(columns, best) if there[1] else 0.0,
            row_release_px=_release(rows.ratio),
            column_release_px=_release(columns.ratio),
            output_row=rows.output,
            output_column=columns.output,
            power=best.power[0],
            level_e=best.level_e,
        )
        errors = {"rows": rows.loss[1], "columns": columns.loss[1], "power": best.power[1]}
        of = "columns" if made.columns > made.rows else "rows"
        size = {"value": getattr(made, of), "error": errors[of], "unit": ""}
        return Estimate(
            made,
            errors,
            trailing(evidence),
            "hot pixels have trails in one direction, which grow with the distance from the output",
            size=size | {"of": f"of {best.level_e:.0f} e- per transfer of {of}"},
        )


def _length(release: float) -> int:
    """Pixels of a trail."""
    return math.ceil(-math.log(_REST) * release)


def _release(ratio: float) -> float:
    return float(np.clip(-1 / math.log(ratio), 0.1, 100))


def _scale(one: Trail, best: Trail) -> float:
    """Loss at the level of the best trail over that at its own."""
    return float((best.level_e / one.level_e) ** (best.power[0] - 1))
