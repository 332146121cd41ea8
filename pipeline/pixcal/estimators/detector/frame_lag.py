"""Lag that all pixels have in common: contrast of fringe frames, and the first frames of flats."""

import numpy as np
from scipy.optimize import minimize_scalar

from pixcal.estimators.detector.flat_ladder import FLICKER_KNOWN, flicker
from pixcal.estimators.detector.pixel_lag import CLIP, MIN_FRAMES
from pixcal.estimators.diagnosis.evidence import Evidence, Stack
from pixcal.model.arrays import F64

LAGS = 6  # frames back that are looked at
MAX_DECAY = 3.0
_SERIES = 8
_STEADIEST = 1e-4
CLEAR = 4.0
_NOT_EXPONENTIAL = 40.0  # chi-square from which releases are taken as they come


def contrast_steps(frames: F64) -> tuple[F64, F64] | None:
    """Shares (lag,) that come out 1, 2, ... frames later, and their information (lag, lag).

    From (B, A cos phi, A sin phi) of the frames (t, 3); None where they do not tell.
    """
    b, a_cos, a_sin = frames.T
    count = len(b)
    if count < MIN_FRAMES + LAGS:
        return None
    phase = np.arctan2(a_sin, a_cos)
    contrast = np.hypot(a_cos, a_sin) / b
    contrast = contrast / np.median(contrast)
    terms = np.zeros((LAGS, count))
    for back in range(1, LAGS + 1):
        light = b[:-back] / b[back:]
        terms[back - 1, back:] = light * (np.cos(phase[:-back] - phase[back:]) - 1)
    time = np.linspace(-1, 1, count)
    # What a wrong gauge of the fit and slow changes do to the contrast.
    other = [np.ones(count), time, time**2]
    for n in (1, 2):
        other += [np.cos(n * phase), np.sin(n * phase)]
    basis, size, _ = np.linalg.svd(np.stack(other).T, full_matrices=False)
    basis = basis[:, size > 1e-6 * size[0]]
    used = np.ones(count, bool)
    for _ in range(2):
        inside = np.linalg.qr(basis[used])[0]
        rest = terms[:, used] - (terms[:, used] @ inside) @ inside.T
        y = contrast[used] - inside @ (inside.T @ contrast[used])
        normal = rest @ rest.T
        if np.any(np.diag(normal) < 1e-3 * used.sum()):
            return None
        shares = np.linalg.solve(normal, rest @ y)
        left = y - shares @ rest
        scatter = np.sqrt(left @ left / (used.sum() - LAGS - basis.shape[1]))
        spread = 1.4826 * np.median(np.abs(left))
        used[used] = np.abs(left) <= CLIP * max(spread, 1e-12)
    return shares, normal / scatter**2


def decay_of(steps: list[tuple[F64, F64]]) -> tuple[float, float, float, float, float]:
    """Share, what is kept from frame to frame, their errors, and how significant the share is."""
    information = np.sum([n for _, n in steps], axis=0)
    right = np.sum([n @ w for w, n in steps], axis=0)
    power = np.arange(LAGS)

    def release(keep: float) -> F64:
        return np.asarray((1 - keep) * keep**power)

    def gain(keep: float) -> float:
        """Significance of the share, with its sign."""
        u = release(keep)
        return float(u @ right / np.sqrt(u @ information @ u))

    highest = float(np.exp(-1 / MAX_DECAY))
    best = float(minimize_scalar(lambda k: -gain(k), bounds=(0, highest), method="bounded").x)
    # Without lag the decay has no meaning; it must show.
    if gain(best) ** 2 < gain(0.0) ** 2 + CLEAR**2:
        best = 0.0
    u = release(best)
    share = float(u @ right / (u @ information @ u))
    slope = power * (1 - best) * best ** np.maximum(power - 1, 0) - best**power
    jacobian = np.stack([u, max(share, 1e-9) * slope])
    covariance = np.linalg.inv(jacobian @ information @ jacobian.T)
    errors = np.sqrt(np.diag(covariance))
    if not best:
        errors[0] = 1 / np.sqrt(u @ information @ u)
    return share, best, float(errors[0]), float(errors[1]), gain(best)


def released_freely(
    steps: list[tuple[F64, F64]], keep: float, share: float, error: float
) -> tuple[float, float, tuple[float, ...]]:
    """Share, its error and what comes out in each frame, where an exponential does not describe it.

    Else share and error as given, and nothing.
    """
    information = np.sum([n for _, n in steps], axis=0)
    free = np.linalg.solve(information, np.sum([n @ w for w, n in steps], axis=0))
    away = free - share * (1 - keep) * keep ** np.arange(LAGS)
    if float(away @ information @ away) < _NOT_EXPONENTIAL or share < CLEAR * error:
        return share, error, ()
    covariance = np.linalg.inv(information)
    kept = np.maximum(free, 0)
    total = float(kept.sum())
    return total, float(np.sqrt(covariance.sum())), tuple(map(float, kept / total))


def weighted_mean(values: list[tuple[float, float]]) -> tuple[float, float]:
    """Weighted mean and its error; of an empty list one that says nothing."""
    if not values:
        return 0.0, 1.0
    value, error = np.array(values).T
    weight = error**-2
    return float(weight @ value / weight.sum()), float(weight.sum() ** -0.5)


def share_of_flats(evidence: Evidence) -> tuple[float, float] | None:
    """Share by the first frame of each flat against the rest, over the level, and its error.

    Any offset of first frames is taken from stacks without light.
    """
    found = np.array([f for s in evidence.stacks if (f := _first_frame(s, evidence)) is not None])
    if len(found) < 2 or np.ptp(found[:, 0]) < 10 * found[:, 2].min():
        return None
    level, step, error = found.T
    design = np.stack([-level, np.ones_like(level)]) / error
    covariance = np.linalg.inv(design @ design.T)
    return float((covariance @ (design @ (step / error)))[0]), float(np.sqrt(covariance[0, 0]))


def _first_frame(stack: Stack, evidence: Evidence) -> tuple[float, float, float] | None:
    """Level of a stack, how much its first frame differs from the others, and the error; e-."""
    count = len(stack.adu)
    lamp, known = flicker(evidence)
    if count < (2 if stack.kind == "flat" and known > FLICKER_KNOWN else _SERIES):
        return None
    light = (stack.adu - evidence.bias)[:, evidence.good] * evidence.gain
    means = light.mean(axis=1)
    rest = means[1:]
    level = float(rest.mean())
    # What the lamp did from frame to frame is measured by the frames themselves.
    scatter = level * max(lamp, _STEADIEST) if count < _SERIES else float(rest.std(ddof=2))
    return level, float(means[0] - level), scatter * float(np.sqrt(1 + 1 / len(rest)))
