"""Lag from the first flat of each level, which lacks what stays behind."""

import numpy as np

from pixcal.estimators.detector import flat_ladder
from pixcal.estimators.diagnosis.evidence import Evidence, Stack

_SERIES = 8  # fewest frames of a series that measures its own flicker
_MANY_FLATS = 5  # fewest series that constrain lamp flicker as well as lag
_STEADIEST = 1e-4


def lag_of_flats(evidence: Evidence) -> tuple[float, float, float] | None:
    """Share by which the first frame of each series of flats is fainter than the rest, its error.

    It lacks a share of its own level, and gains one of the previous frame unless the detector was
    cleared; the levels show which. The third number is 1 if that charge was added, 0 if the
    detector was cleared. None if the flats do not constrain it.
    """
    firsts = [(s, f) for s in evidence.stacks if (f := _first_frame(s, evidence)) is not None]
    if len(firsts) <= 2:
        return None
    level, step, error = np.array([f for _, f in firsts]).T
    if np.ptp(level) < 10 * error.min():
        return None
    before = np.array([flat_ladder.level_before(evidence, s) for s, _ in firsts])
    flat = np.array([s.kind == "flat" for s, _ in firsts])
    rise, of_rise = flat_ladder.warming(evidence)
    # Change of the steps per unit rise of the light: from the first frame to the middle of the
    # others.
    later = np.array([len(s.adu) / 2 * (s.kind == "flat") for s, _ in firsts]) * level
    step = step + rise * later

    def fit(carried: float) -> tuple[float, float, float, float]:
        """Chi-square of the steps, the share, its error, and the part that is carried over."""
        # Flicker is measured from the fit's residuals: before the fit it includes lag.
        design = np.stack([carried * before - level, np.ones_like(step)])
        scale = np.ones_like(step)
        for _ in range(2):
            # The error of the rise is common to all levels.
            variance = np.diag((error * scale) ** 2) + of_rise**2 * np.outer(later, later)
            weighted = np.linalg.solve(variance, design.T).T
            covariance = np.linalg.inv(weighted @ design.T)
            fitted = covariance @ (weighted @ step)
            squares = ((step - fitted @ design) / error) ** 2
            if flat.sum() >= _MANY_FLATS:
                scale = np.where(flat, np.sqrt(squares[flat].sum() / (flat.sum() - 1)), 1.0)
        return float(squares.sum()), float(fitted[0]), float(covariance[0, 0] ** 0.5), carried

    return min(map(fit, (0.0, 1.0) if before.any() else (0.0,)))[1:]


def _first_frame(stack: Stack, evidence: Evidence) -> tuple[float, float, float] | None:
    """Level of a stack, how much its first frame differs from the others, and the error; e-."""
    count = len(stack.adu)
    lamp, known = flat_ladder.flicker(evidence)
    if count < (2 if stack.kind == "flat" and known > flat_ladder.FLICKER_KNOWN else _SERIES):
        return None
    light = flat_ladder.light_of(evidence, stack)
    level, rest = float(light[1:].mean()), light[1:]
    # Long series measure the lamp's flicker themselves.
    scatter = level * max(lamp, _STEADIEST) if count < _SERIES else float(rest.std(ddof=2))
    return level, float(light[0] - level), scatter * float(np.sqrt(1 + 1 / len(rest)))
