"""Read noise pixel by pixel, from the scatter of few frames without light.

The variance of a pixel in n frames has a relative error of sqrt(2 / (n - 1)), often more than
pixels differ by. What is drawn here has both the scatter that pixels truly have and the values
that single pixels are seen to have, as far as they can be known: a draw from the posterior, the
logarithm of the variance being normal with a few outliers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import digamma, polygamma

from pixcal.model.arrays import F32, F64, Mask

FEWEST = 8  # frames that tell pixels apart
OUTLIER = 4.0  # standard deviations of all pixels beyond which a pixel's own variance is believed


@dataclass(frozen=True)
class PixelNoise:
    """Relative read noise of the pixels: what is known of it."""

    # mean, scatter: (y, x) of the logarithm of the variance over its mean in the detector
    mean: F64
    scatter: F64
    rounding: float = 0.0  # share of the variance that the converter's rounding adds

    @classmethod
    def of(cls, stacks: Sequence[F32], good: Mask, rounding: float = 0.0) -> "PixelNoise | None":
        """From frames (t, y, x) without light, ADU; None of fewer than `FEWEST` frames."""
        stacks = [s for s in stacks if len(s) >= 2]
        freedom = sum(len(s) - 1 for s in stacks)
        if freedom + len(stacks) < FEWEST or good.sum() < FEWEST:
            return None
        squares = np.zeros(good.shape)
        for frames in stacks:
            rest = frames - frames.mean(axis=0)
            rest -= np.median(rest[:, good], axis=1)[:, None, None]
            squares += np.einsum("tyx,tyx->yx", rest, rest, dtype=float)
        variance = np.maximum(squares / freedom, 1e-12)
        half = freedom / 2
        # A variance of normal samples, about its true value, in logarithms.
        log = np.log(variance) - (digamma(half) - np.log(half))
        error = float(polygamma(1, half))
        middle = float(np.median(log[good]))
        seen = (1.4826 * float(np.median(np.abs(log[good] - middle)))) ** 2
        true = max(seen - error, 0.0)
        # Most pixels are as the population is; those far from it are as they were seen.
        far = np.abs(log - middle) > OUTLIER * np.sqrt(max(seen, error))
        share = np.where(far, 1.0, true / (true + error))
        mean = share * (log - middle)
        scatter = np.sqrt(np.where(far, error, share * error))
        mean = np.where(good, mean, 0.0)
        ordinary = good & ~far
        if ordinary.any():
            mean = mean - np.log(np.mean(np.exp(mean + scatter**2 / 2)[ordinary]))
        return cls(mean, np.where(good, scatter, 0.0), rounding)

    def drawn(self, rng: np.random.Generator) -> F32:
        """Read noise (y, x) before rounding of every pixel over the detector's."""
        log = self.mean + self.scatter * rng.standard_normal(self.mean.shape)
        before = (np.exp(log) - self.rounding) / (1 - self.rounding)
        return np.sqrt(np.maximum(before, 0)).astype(np.float32)
