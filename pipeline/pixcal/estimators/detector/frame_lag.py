"""Lag of all pixels, from fringe contrast or first frames of flats; its scatter over pixels."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from pixcal.estimators.detector.flat_ladder import FLICKER_KNOWN, flicker, level_before, warming
from pixcal.estimators.diagnosis.distortions import Freedom
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack
from pixcal.kernels.charge_release import without_lag
from pixcal.kernels.frame_order import follows
from pixcal.kernels.robust import robust_sigma
from pixcal.kernels.significance import root_with_error
from pixcal.model.arrays import F32, F64, Indices, Mask

# of the phase, free in each pixel so that a nonlinear response is not mistaken for lag
HARMONICS = 5
CONTROLS = 8  # later frames that serve as controls for the previous frame
PIXEL_CLIP = 7.0  # standard deviations beyond which a pixel's share is clipped (particles)
MIN_FRAMES = 20
CLIP = 5.0  # standard deviations of a frame's contrast
LAGS = 6  # longest lag, frames
ROUNDS = 2  # iterations of the fit to flats
CONTRAST_ROUNDS = 8  # most iterations for the contrast, each linearised about the last lag
CONVERGED = 0.1  # step of the share, in its errors, that ends the iteration
MAX_DECAY = 3.0
_SERIES = 8
_MANY_FLATS = 5  # fewest series that constrain lamp flicker as well as lag
_STEADIEST = 1e-4
CLEAR = 4.0
_NOT_EXPONENTIAL = 40.0  # chi-square from which releases are free in each frame


@dataclass(frozen=True)
class LagNonuniformity:
    """Scatter over pixels of the share of the previous frame: mean square and its error."""

    square: float
    error: float

    @classmethod
    def of(cls, sets: Iterable[FringeEvidence]) -> "LagNonuniformity":
        """Weighted mean of all sets; 0 ± 1 without any."""
        measured = [(*one, f.good.sum()) for f in sets if (one := uneven_pixels(f)) is not None]
        if not measured:
            return cls(0.0, 1.0)
        value, error, pixels = np.array(measured).T
        weight = error**-2
        square = float(weight @ value / weight.sum())
        # All sets share the same pixels and their sampling error.
        drawn = (1 - 1 / len(measured)) * 2 * square**2 / pixels.min()
        return cls(square, float(np.sqrt(1 / weight.sum() + drawn)))

    @property
    def sigmas(self) -> float:
        """Significance."""
        return self.square / self.error

    def rms(self, keep: float, share: float) -> float:
        """Of shares about the mean ``share``; ``keep``: part of held charge kept per frame."""
        return float(np.sqrt(max(self.square, 0.0))) * self._scale(keep, share)

    def spread(self, keep: float, share: float, share_error: float) -> tuple[float, float]:
        """Relative spread of the shares about their mean, and its error."""
        if share <= 0:
            return 0.0, 1.0
        rms, error = root_with_error(self.square, self.error)
        relative = self._scale(keep, share) / share
        spread = float(rms * relative)
        return spread, float(np.hypot(error * relative, spread * share_error / share))

    @staticmethod
    def _scale(keep: float, share: float) -> float:
        """Ratio of a pixel's deviation s - share to the deviation as measured."""
        # Maps and frames were fitted to frames with lag, so (s - share) / (1 - s) of the light
        # before remains. The frame before, as fitted, holds 1 - share of it, and earlier light.
        return ((1 - share) ** 2 + share**2 * (1 - keep) / (1 + keep)) / (1 - keep)


def seen_share(fringes: FringeEvidence, share: float, rms: float) -> float:
    """Share measured from frame contrast, where pixels with a larger share have less weight."""
    mean, cosine, sine = fringes.theta[:, fringes.good]
    frames = fringes.free[:, 0].mean()
    contrast = np.hypot(*fringes.free[:, 1:3].T).mean() / frames
    visibility = contrast * np.median(np.hypot(cosine, sine) / mean) / (1 - share)
    shares = (share + rms * np.sqrt(3) * np.array([-1, 0, 1]))[:, None]
    wave = visibility * np.cos(np.linspace(0, 2 * np.pi, 64, endpoint=False))
    model = np.stack([np.ones((3, 64)), (1 - shares) * wave])
    noise = np.median(fringes.read_variance[fringes.good]) / (np.median(mean) * frames)
    weight = np.array([[1], [4], [1]]) / (noise + model.sum(axis=0).clip(0))
    normal = np.einsum("pa,ipa,jpa->ij", weight, model, model)
    right = np.einsum("pa,ipa->i", weight * shares * wave, model)
    of_mean, of_fringes = np.linalg.solve(normal, right)
    seen = float(of_fringes - of_mean)
    return seen / (1 + seen)


def uneven_pixels(fringes: FringeEvidence) -> tuple[float, float] | None:
    """Mean square deviation of the pixels' shares from the mean, and its error."""
    if len(fringes.g) < MIN_FRAMES + CONTROLS:
        return None
    before = _squares_of_shares(fringes, Freedom(fringes, HARMONICS), (1,))[0]
    # Frames are only nearly independent: the part explained by the previous frame is removed.
    free = Freedom(fringes, HARMONICS, before=True)
    after = _squares_of_shares(fringes, free, range(-1, -CONTROLS - 1, -1))
    value, error = np.array(after).T
    noise = np.hypot(before[1], np.sqrt((error**2).mean() / CONTROLS))
    scatter = value.std(ddof=1) * np.sqrt(1 + 1 / CONTROLS)
    return before[0] - float(value.mean()), float(max(noise, scatter))


def _squares_of_shares(
    fringes: FringeEvidence, freedom: Freedom, steps: Sequence[int]
) -> list[tuple[float, float]]:
    """Mean square, above noise, of pixels' shares of the frames ``steps`` back, with errors."""
    weighted = freedom.weight * freedom.left_over(freedom.of_good(fringes.residual))
    others = np.zeros((len(steps), *fringes.g.T.shape), np.float32)
    for other, step in zip(others, steps, strict=True):
        other[:] = np.roll(fringes.g, step, axis=0).T
        other[:, ~follows(fringes.frame, step)] = 0
    of_time, weight, theta = freedom.of_time, freedom.weight, fringes.theta[:, freedom.good]
    count = weight.shape[1]
    upper = np.triu_indices(3)

    def summed(products: F32, samples: F32) -> F32:
        """Sums over time (..., n) of products (..., t) with samples (t, n): one matrix product."""
        sums = products.reshape(-1, products.shape[-1]) @ samples
        return sums.reshape(*products.shape[:-1], count)

    mixed = summed(of_time[:, None] * others[:, None], weight)
    rights = summed(others, weighted)
    means = []
    for own_squares, own_mixed, own_right in zip(
        summed(others[:, upper[0]] * others[:, upper[1]], weight), mixed, rights, strict=True
    ):
        squares = np.empty((3, 3, count))
        squares[upper] = squares[upper[::-1]] = own_squares
        # The other frame is a sum of the pixel's maps. The part that the pixel's own parameters
        # absorb is subtracted: residuals retain none of it.
        along = np.einsum("kin,in->kn", own_mixed, theta)
        taken = np.einsum("nij,jn->in", freedom.pixel_inverse, along)
        information = np.einsum("in,ijn,jn->n", theta, squares, theta)
        information -= np.einsum("kn,kn->n", along, taken)
        means.append(_mean_square(np.einsum("in,in->n", theta, own_right), information))
    return means


def _mean_square(right: F64, information: F64) -> tuple[float, float]:
    """Mean square of shares less that of their noise, and its error, from normal equations (n,)."""
    constrained = information > 1e-3 * np.median(information)
    share, variance = right[constrained] / information[constrained], 1 / information[constrained]
    square = share**2 - variance
    trust = 1 / (variance**2 + np.median(variance) ** 2)
    # Particles leave outliers in a few pixels.
    trust *= np.abs(square) < PIXEL_CLIP**2 * np.median(np.abs(square))
    total = trust.sum()
    mean = float(trust @ square / total)
    return mean, float(np.sqrt(trust**2 @ (square - mean) ** 2) / total)


def _contrast_steps(frames: F64, numbers: Indices) -> tuple[F64, F64] | None:
    """Shares (lag,) released 1, 2, ... frames later, and their information (lag, lag)."""
    # ``frames``: (t, 3) B, A cos phi, A sin phi; ``numbers``: (t,) of frames. None where these do
    # not constrain the shares.
    b, a_cos, a_sin = frames.T
    count = len(b)
    if count < MIN_FRAMES + LAGS:
        return None
    phase = np.arctan2(a_sin, a_cos)
    contrast = np.hypot(a_cos, a_sin) / b
    contrast = contrast / np.median(contrast)
    terms = np.zeros((LAGS, count))
    for back in range(1, LAGS + 1):
        after = np.flatnonzero(follows(numbers, back))
        light = b[after - back] / b[after]
        terms[back - 1, after] = light * (np.cos(phase[after - back] - phase[after]) - 1)
    time = numbers / numbers[-1]
    # Changes of contrast by the fit's gauge freedom and by drift.
    other = [np.ones(count), time, time**2]
    for n in (1, 2):
        other += [np.cos(n * phase), np.sin(n * phase)]
    basis, size, _ = np.linalg.svd(np.stack(other).T, full_matrices=False)
    basis = basis[:, size > 1e-6 * size[0]]
    used = follows(numbers)
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
        spread = robust_sigma(left)
        used[used] = np.abs(left) <= CLIP * max(spread, 1e-12)
    return shares, normal / scatter**2


@dataclass(frozen=True)
class CommonLag:
    """Lag common to all pixels, from the contrast of the frames."""

    share: float  # that stays behind
    share_error: float
    keep: float  # part of held charge that is kept for another frame
    keep_error: float
    sigmas: float  # significance of the share
    later: tuple[float, ...] = ()  # parts released in later frames, if not exponential

    @property
    def release(self) -> F64:
        """Parts (lag,) of the charge left behind that are released 1, 2, ... frames later."""
        return np.asarray((1 - self.keep) * self.keep ** np.arange(LAGS))

    @property
    def decay_frames(self) -> float:
        """Frames in which the released charge falls by a factor e."""
        return float(-1 / np.log(self.keep)) if self.keep else 0.0

    @property
    def decay_error(self) -> float:
        """Of `decay_frames`."""
        if not self.keep:
            return float(-1 / np.log(min(self.keep_error, 0.9)))
        return self.keep_error * self.decay_frames**2 / self.keep


def common_lag(frames: Sequence[F64], numbers: Sequence[Indices]) -> CommonLag | None:
    """Lag from the contrast of frames (t, 3) against the phase step; None: no evidence.

    ``numbers``: (t,) of the frames in their set.
    """
    lag = CommonLag(0.0, 0.0, 0.0, 0.0, 0.0)
    for _ in range(CONTRAST_ROUNDS):
        steps = []
        for of_set, which in zip(frames, numbers, strict=True):
            # Linearised about the current lag, which is removed from the frames first.
            share = float(np.clip(lag.share, 0, 0.5))
            rest = without_lag(of_set.astype(np.float32), share, lag.keep)
            fitted = _contrast_steps(rest.astype(float), which)
            if fitted is not None:
                steps.append((share * lag.release + fitted[0], fitted[1]))
        if not steps:
            return None
        information = np.sum([n for _, n in steps], axis=0)
        right = np.sum([n @ w for w, n in steps], axis=0)
        before, lag = lag, _exponential(information, right)
        if abs(lag.share - before.share) < CONVERGED * lag.share_error:
            break
    return _freely(lag, information, right)


def _exponential(information: F64, right: F64) -> CommonLag:
    """Shares that fall by the same factor from frame to frame."""
    power = np.arange(LAGS)

    def release(keep: float) -> F64:
        return np.asarray((1 - keep) * keep**power)

    def gain(keep: float) -> float:
        """Significance of the share, with its sign."""
        u = release(keep)
        return float(u @ right / np.sqrt(u @ information @ u))

    highest = float(np.exp(-1 / MAX_DECAY))
    best = float(minimize_scalar(lambda k: -gain(k), bounds=(0, highest), method="bounded").x)
    # Without lag the decay has no meaning: it must be significant.
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
    return CommonLag(share, float(errors[0]), best, float(errors[1]), gain(best))


def _freely(lag: CommonLag, information: F64, right: F64) -> CommonLag:
    """The lag with a free release in each frame, where an exponential does not describe it."""
    free = np.linalg.solve(information, right)
    away = free - lag.share * lag.release
    unlike = float(away @ information @ away) >= _NOT_EXPONENTIAL
    if not unlike or lag.share < CLEAR * lag.share_error:
        return lag
    kept = np.maximum(free, 0)
    total = float(kept.sum())
    error = float(np.sqrt(np.linalg.inv(information).sum()))
    return replace(lag, share=total, share_error=error, later=tuple(map(float, kept / total)))


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
    before = np.array([level_before(evidence, s) for s, _ in firsts])
    flat = np.array([s.kind == "flat" for s, _ in firsts])
    known = 1.0 if before.any() else 0.0
    lamp = warming(evidence)
    # from the first frame to the middle of the others
    later = np.array([len(s.adu) / 2 * (s.kind == "flat") for s, _ in firsts]) * level
    fits = [_fit_steps(level - c * before, step, error, flat, (later, *lamp)) for c in (0.0, known)]
    carried, (share, of_share, _) = min(
        zip((0.0, known), fits, strict=True), key=lambda one: one[1][2]
    )
    return share, of_share, carried


def _fit_steps(
    lacking: F64, step: F64, error: F64, flat: Mask, lamp: tuple[F64, float, float]
) -> tuple[float, float, float]:
    """Share missing from first frames, its error, and the chi-square of the steps."""
    # ``lamp``: change of the steps per unit rise of the light, the rise, and its error.
    later, rise, of_rise = lamp
    step = step + rise * later
    # Flicker is measured from the fit's residuals: before the fit it includes lag.
    design = np.stack([-lacking, np.ones_like(step)])
    scale = np.ones_like(step)
    for _ in range(ROUNDS):
        # The error of the rise is common to all levels.
        variance = np.diag((error * scale) ** 2) + of_rise**2 * np.outer(later, later)
        weighted = np.linalg.solve(variance, design.T).T
        covariance = np.linalg.inv(weighted @ design.T)
        fitted = covariance @ (weighted @ step)
        squares = ((step - fitted @ design) / error) ** 2
        if flat.sum() >= _MANY_FLATS:
            scale = np.where(flat, np.sqrt(squares[flat].sum() / (flat.sum() - 1)), 1.0)
    return float(fitted[0]), float(np.sqrt(covariance[0, 0])), float(squares.sum())


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
    # Long series measure the lamp's flicker themselves.
    scatter = level * max(lamp, _STEADIEST) if count < _SERIES else float(rest.std(ddof=2))
    return level, float(means[0] - level), scatter * float(np.sqrt(1 + 1 / len(rest)))
