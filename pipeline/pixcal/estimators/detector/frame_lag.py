"""Lag of all pixels, from the contrast of the fringe frames; its scatter over pixels."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.diagnosis.distortions import Freedom
from pixcal.estimators.diagnosis.evidence import FringeEvidence
from pixcal.kernels.charge_release import without_lag
from pixcal.kernels.frame_order import follows
from pixcal.kernels.medians import robust_sigma
from pixcal.kernels.separable import fit_terms
from pixcal.kernels.significance import SIGNIFICANT, root_with_error
from pixcal.model.arrays import F64, Indices

# of the phase, free in each pixel so that a nonlinear response is not mistaken for lag
HARMONICS = 5
CONTROLS = 8  # later frames that serve as controls for the previous frame
PIXEL_CLIP = 7.0  # standard deviations beyond which a pixel's share is clipped (particles)
MIN_FRAMES = 20
CLIP = 5.0  # standard deviations of a frame's contrast
LAGS = 6  # longest lag, frames
CONTRAST_ROUNDS = 8  # most iterations for the contrast, each linearised about the last lag
CONVERGED = 0.1  # step of the share, in its errors, that ends the iteration
MAX_DECAY = 3.0
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
    ((before, noise),) = _squares_of_shares(fringes, Freedom(fringes, HARMONICS), (1,))
    # Frames are only nearly independent: the part explained by the previous frame is removed.
    free = Freedom(fringes, HARMONICS, before=(1.0,))
    value, error = np.array(_squares_of_shares(fringes, free, range(-1, -CONTROLS - 1, -1))).T
    noise = np.hypot(noise, np.sqrt((error**2).mean() / CONTROLS))
    scatter = value.std(ddof=1) * np.sqrt(1 + 1 / CONTROLS)
    return before - float(value.mean()), float(max(noise, scatter))


def _squares_of_shares(
    fringes: FringeEvidence, freedom: Freedom, steps: Sequence[int]
) -> list[tuple[float, float]]:
    """Mean square, above noise, of pixels' shares of the frames ``steps`` back, with errors."""
    weight, of_time = freedom.weight, freedom.of_time
    residual = weight * freedom.left_over(freedom.of_good(fringes.residual))
    maps, squares = fringes.theta[:, freedom.good].astype(np.float32), []
    for step in steps:
        frames = np.roll(fringes.g, step, axis=0) * follows(fringes.frame, step)[:, None]
        other = frames.astype(np.float32) @ maps
        weighed = weight * other
        # The part that the pixel's own parameters absorb: residuals retain none of it.
        along = of_time @ weighed
        absorbed = np.einsum("in,nij,jn->n", along, freedom.pixel_inverse, along, optimize=True)
        information = np.einsum("tn,tn->n", weighed, other) - absorbed
        squares.append(_mean_square(np.einsum("tn,tn->n", residual, other), information))
    return squares


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


def slow_contrast(frames: F64, numbers: Indices) -> F64:
    """Orthonormal changes (t, k) of the contrast by the fit's gauge freedom and by drift.

    ``frames``: (t, 3) B, A cos phi, A sin phi; ``numbers``: (t,) of frames.
    """
    time, phase = numbers / numbers[-1], np.arctan2(frames[:, 2], frames[:, 1])
    slow = [np.ones(len(time)), time, time**2]
    for n in (1, 2):
        slow += [np.cos(n * phase), np.sin(n * phase)]
    basis, size, _ = np.linalg.svd(np.stack(slow).T, full_matrices=False)
    return np.asarray(basis[:, size > 1e-6 * size[0]])


def _contrast_steps(frames: F64, numbers: Indices) -> tuple[F64, F64] | None:
    """Shares (lag,) released 1, 2, ... frames later, and their information (lag, lag)."""
    # None where the frames do not constrain the shares.
    if len(frames) < MIN_FRAMES + LAGS:
        return None
    b, a_cos, a_sin = frames.T
    phase, contrast = np.arctan2(a_sin, a_cos), np.hypot(a_cos, a_sin) / b
    terms = [contrast / np.median(contrast)]
    for back in range(1, LAGS + 1):
        before = [np.roll(one, back) for one in (b, phase)]
        terms.append(follows(numbers, back) * before[0] / b * (np.cos(before[1] - phase) - 1))
    basis, used = slow_contrast(frames, numbers), follows(numbers)
    for _ in range(2):
        slow, rest = np.linalg.qr(basis[used])[0], np.array(terms)[:, used]
        y, *rest = rest - (rest @ slow) @ slow.T
        design = np.array(rest)
        normal = design @ design.T
        if np.any(np.diag(normal) < 1e-3 * len(y)):
            return None
        shares = np.linalg.solve(normal, design @ y)
        left = y - shares @ design
        variance = left @ left / (len(y) - LAGS - slow.shape[1])
        used[used] = np.abs(left) <= CLIP * max(robust_sigma(left), 1e-12)
    return shares, normal / variance


@dataclass(frozen=True)
class CommonLag:
    """Lag common to all pixels, from the contrast of the frames."""

    share: float = 0.0  # that stays behind
    share_error: float = 0.0
    keep: float = 0.0  # part of held charge that is kept for another frame
    keep_error: float = 0.0
    sigmas: float = 0.0  # significance of the share
    later: tuple[float, ...] = ()  # parts released in later frames, if not exponential

    @property
    def decay(self) -> tuple[float, float]:
        """Frames in which the released charge falls by a factor e, and its error."""
        if not self.keep:
            return 0.0, float(-1 / np.log(min(self.keep_error, 0.9)))
        decay = float(-1 / np.log(self.keep))
        return decay, self.keep_error * decay**2 / self.keep


def common_lag(frames: Sequence[F64], numbers: Sequence[Indices]) -> CommonLag | None:
    """Lag from the contrast of frames (t, 3) against the phase step; None: no evidence.

    ``numbers``: (t,) of the frames in their set.
    """
    lag = CommonLag()
    for _ in range(CONTRAST_ROUNDS):
        right: F64 = np.zeros(LAGS)
        information: F64 = np.zeros((LAGS, LAGS))
        # Linearised about the current lag, which is removed from the frames first.
        share = float(np.clip(lag.share, 0, 0.5))
        for of_set, which in zip(frames, numbers, strict=True):
            rest = without_lag(of_set.astype(np.float32), share, lag.keep)
            if (fitted := _contrast_steps(rest.astype(float), which)) is not None:
                information += fitted[1]
                right += fitted[1] @ (share * _release(lag.keep) + fitted[0])
        if not information.any():
            return None
        free, before = np.asarray(np.linalg.solve(information, right), float), lag
        lag = _exponential(free, information)
        if abs(lag.share - before.share) < CONVERGED * lag.share_error:
            break
    return _freely(lag, free, information)


def _release(keep: float) -> F64:
    """Parts (lag,) of the charge left behind that are released 1, 2, ... frames later."""
    return np.asarray((1 - keep) * keep ** np.arange(LAGS))


def _exponential(free: F64, information: F64) -> CommonLag:
    """Shares that fall by the same factor from frame to frame."""
    root = np.linalg.cholesky(information).T
    keeps = np.linspace(0, np.exp(-1 / MAX_DECAY), 6)
    at_once, fit = (
        fit_terms(lambda k: root @ _release(k), root @ free, k) for k in (keeps[:1], keeps)
    )
    share_error, keep_error = (float(one[0]) for one in fit.errors())
    # Without lag the decay has no meaning: it must be significant.
    if at_once.left - fit.left < SIGNIFICANT**2:
        fit, share_error = at_once, 1 / float(np.linalg.norm(root @ _release(0.0)))
        keep_error = float(at_once.errors()[1][0])
    explained = max(float(free @ information @ free) - fit.left, 0.0)
    share, keep = float(fit.sizes[0]), float(fit.shapes[0])
    return CommonLag(share, share_error, keep, keep_error, float(np.sign(share) * explained**0.5))


def _freely(lag: CommonLag, free: F64, information: F64) -> CommonLag:
    """The lag with a free release in each frame, where an exponential does not describe it."""
    away = free - lag.share * _release(lag.keep)
    unlike = float(away @ information @ away) >= _NOT_EXPONENTIAL
    if not unlike or lag.share < SIGNIFICANT * lag.share_error:
        return lag
    kept = np.maximum(free, 0)
    total = float(kept.sum())
    error = float(np.sqrt(np.linalg.inv(information).sum()))
    return replace(lag, share=total, share_error=error, later=tuple(map(float, kept / total)))
