"""Lag that differs from pixel to pixel, in the residuals of the fringe frames."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.diagnosis.distortions import Freedom
from pixcal.estimators.diagnosis.evidence import FringeEvidence
from pixcal.kernels.frame_order import follows
from pixcal.model.arrays import F32, F64

# of the phase that pixels are free to have, so that a bent response is not taken for lag
HARMONICS = 5
CONTROLS = 8  # frames after a frame that are compared with the one before it
CLIP = 7.0  # standard deviations of a share that particles go beyond
MIN_FRAMES = 20


@dataclass(frozen=True)
class Uneven:
    """How much the pixels' shares of the frame before differ: mean square, and its error."""

    square: float
    error: float

    @classmethod
    def of(cls, sets: Iterable[FringeEvidence]) -> "Uneven":
        """Of all sets together; without any it says nothing."""
        found = [(*one, f.good.sum()) for f in sets if (one := uneven_pixels(f)) is not None]
        if not found:
            return cls(0.0, 1.0)
        value, error, pixels = np.array(found).T
        weight = error**-2
        square = float(weight @ value / weight.sum())
        # All sets have the same pixels.
        drawn = (1 - 1 / len(found)) * 2 * square**2 / pixels.min()
        return cls(square, float(np.sqrt(1 / weight.sum() + drawn)))

    @property
    def sigmas(self) -> float:
        """Significance."""
        return self.square / self.error

    def rms(self, keep: float, share: float) -> float:
        """Of shares about the mean ``share``, where a part of what is held stays another frame."""
        return float(np.sqrt(max(self.square, 0.0))) * self._scale(keep, share)

    def spread(self, keep: float, share: float, share_error: float) -> tuple[float, float]:
        """Relative spread of the shares about the mean one, and its error."""
        if share <= 0:
            return 0.0, 1.0
        rms, scale = self.rms(keep, share), self._scale(keep, share)
        spread = rms / share
        error = self.error * scale**2 / (2 * max(rms, np.sqrt(self.error) * scale))
        return spread, float(np.hypot(error, spread * share_error) / share)

    @staticmethod
    def _scale(keep: float, share: float) -> float:
        """Of a pixel's share s less the mean one, over what is seen of it.

        Beside maps and frames that were fitted with the lag, (s - share) / (1 - s) of the light
        before is left. The frame before, as fitted, has 1 - share of it, and light from earlier on.
        """
        return ((1 - share) ** 2 + share**2 * (1 - keep) / (1 + keep)) / (1 - keep)


def seen_share(fringes: FringeEvidence, share: float, rms: float) -> float:
    """Share that the contrast of frames shows where pixels with a larger one count for less."""
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
    # Frames are no more than nearly independent: without what the frame before explains.
    free = Freedom(fringes, HARMONICS, before=True)
    after = _squares_of_shares(fringes, free, range(-1, -CONTROLS - 1, -1))
    value, error = np.array(after).T
    noise = np.hypot(before[1], np.sqrt((error**2).mean() / CONTROLS))
    scatter = value.std(ddof=1) * np.sqrt(1 + 1 / CONTROLS)
    return before[0] - float(value.mean()), float(max(noise, scatter))


def _squares_of_shares(
    fringes: FringeEvidence, freedom: Freedom, steps: Sequence[int]
) -> list[tuple[float, float]]:
    """Mean square, above noise, of pixels' shares of the frames some steps back, with errors."""
    weighted = freedom.weight * freedom.left_over(freedom.of_good(fringes.residual))
    others = np.zeros((len(steps), *fringes.g.T.shape), np.float32)
    for other, step in zip(others, steps, strict=True):
        other[:] = np.roll(fringes.g, step, axis=0).T
        other[:, ~follows(fringes.frame, step)] = 0
    own, weight, theta = freedom.of_time, freedom.weight, fringes.theta[:, freedom.good]
    count = weight.shape[1]
    upper = np.triu_indices(3)

    def summed(products: F32, samples: F32) -> F32:
        """Sums over time (..., n) of products (..., t) with samples (t, n); all in one product."""
        found = products.reshape(-1, products.shape[-1]) @ samples
        return found.reshape(*products.shape[:-1], count)

    mixed = summed(own[:, None] * others[:, None], weight)
    rights = summed(others, weighted)
    found = []
    for own_squares, own_mixed, own_right in zip(
        summed(others[:, upper[0]] * others[:, upper[1]], weight), mixed, rights, strict=True
    ):
        squares = np.empty((3, 3, count))
        squares[upper] = squares[upper[::-1]] = own_squares
        # The other frame is a sum of the pixel's maps, less what the pixel can have of its own; of
        # that nothing is left in the residuals.
        along = np.einsum("kin,in->kn", own_mixed, theta)
        taken = np.einsum("nij,jn->in", freedom.pixel_inverse, along)
        information = np.einsum("in,ijn,jn->n", theta, squares, theta)
        information -= np.einsum("kn,kn->n", along, taken)
        found.append(_mean_square(np.einsum("in,in->n", theta, own_right), information))
    return found


def _mean_square(right: F64, information: F64) -> tuple[float, float]:
    """Mean square of shares less that of their noise, and its error, from normal equations (n,)."""
    told = information > 1e-3 * np.median(information)
    share, variance = right[told] / information[told], 1 / information[told]
    square = share**2 - variance
    trust = 1 / (variance**2 + np.median(variance) ** 2)
    # Particles leave wild values in a few pixels.
    trust *= np.abs(square) < CLIP**2 * np.median(np.abs(square))
    total = trust.sum()
    mean = float(trust @ square / total)
    return mean, float(np.sqrt(trust**2 @ (square - mean) ** 2) / total)
