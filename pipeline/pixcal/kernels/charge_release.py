"""Incomplete transfer of charge out of the pixels."""

import numpy as np

from pixcal.model.arrays import F32, F64

BANDS = (0.0, 0.125, 0.25, 0.5)  # where bands of the level begin, over the full scale


def in_bands(level: F32, level_e: float, count: int = len(BANDS)) -> list[F32]:
    """Electrons of a signal in each of the first bands; their sum is the signal, if positive.

    ``level_e``: full scale, e-.
    """
    begins = [np.float32(begin * level_e) for begin in BANDS[:count]]
    ends = [*begins[1:], np.float32(np.inf)]
    return [np.clip(level, b, e) - b for b, e in zip(begins, ends, strict=True)]


def left_behind(charge: F32, mean: F32, share: F32, normal: F32) -> F32:
    """Electrons that stay in each pixel: a binomial variate, approximated by a normal one.

    Of a ``charge`` (y, x), e-; ``mean``: (y, x) of those that stay; ``share``: (y, x) mean
    probability for an electron; ``normal``: (y, x) standard normals; zero for the mean.
    """
    scatter = np.sqrt(np.maximum(mean * (1 - share), 0))
    left: F32 = np.clip(mean + scatter * normal, 0, np.maximum(charge, 0))
    return left


def fill_traps(taken: F32, keep: float, most: float) -> tuple[F32, F32]:
    """Net loss and released charge of each frame (t, ...) as traps fill and empty; e-.

    ``taken`` is the charge that empty traps would capture. From frame to frame, traps keep a share
    ``keep`` of their charge; they capture until they hold ``most``.
    """
    lost, released = np.empty_like(taken), np.empty_like(taken)
    held, part = np.zeros_like(taken[0]), np.float32(keep)
    for t in range(len(taken)):
        left = part * held
        after = np.minimum(left + taken[t], np.float32(most))
        lost[t], released[t], held = after - held, held - left, after
    return lost, released


def released_by_frame(taken: F32, releases: F64) -> tuple[F32, F32]:
    """As `fill_traps`, for traps that release shares of their charge 1, 2, ... frames later."""
    released = np.zeros_like(taken)
    for back, release in enumerate(releases, start=1):
        released[back:] += np.float32(release) * taken[:-back]
    return taken - released, released


def without_lag(frames: F32, share: float, keep: float) -> F32:
    """Frames (t, ...) without a lag of one share, of which ``keep`` stays for another frame; e-.

    In the order of time without gaps; the first one after darkness.
    """
    corrected, held = np.empty_like(frames), np.zeros_like(frames[0])
    for n, frame in enumerate(frames):
        corrected[n] = (frame - np.float32(1 - keep) * held) / np.float32(1 - share)
        held = np.float32(keep) * held + np.float32(share) * corrected[n]
    return corrected
