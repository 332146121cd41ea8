"""Recordings of a bench: sequences of frames, in order of time."""

from dataclasses import dataclass, field
from zlib import crc32

import numpy as np

from pixcal.kernels.normals import Key
from pixcal.kernels.scene import electrons_per_unit
from pixcal.kernels.synthesis import Stream, generator, pixel_key
from pixcal.model.arrays import F64
from pixcal.model.bench import Bench

KINDS = ("bias", "dark", "flat", "fringes")
SEEDS_APART = 1_000_003  # from the seed of one window's pixels to that of the next


@dataclass(frozen=True)
class Recording:
    """Frames taken one after the other under the same conditions."""

    bench: Bench
    kind: str  # ``bias``, ``dark``, ``flat`` or ``fringes``
    number: int  # among those of its kind
    count: int  # frames
    exptime_s: float
    # start_s, period_s: first frame after the start of the acquisition, and from frame to frame
    start_s: float
    period_s: float
    # electrons for unit light: of a flat its mean, of fringes as in `electrons_per_unit`
    electrons: float = 1.0
    # folder, stem: of its files
    folder: str = ""
    stem: str = ""
    # number of the window, if several windows of a detector are simulated separately: they share
    # changes of whole frames, but not the noise of their pixels
    window: int = 0
    before: "Recording | None" = None  # recording that ended when this one began, if known
    # start of each frame after the first, if frames were lost or late; else one period apart
    stamps_s: tuple[float, ...] = field(default=(), repr=False, hash=False)

    @property
    def times_s(self) -> F64:
        """Start (count,) of each frame after the first."""
        if self.stamps_s:
            return np.array(self.stamps_s)
        return np.arange(self.count, dtype=float) * self.period_s

    @property
    def set_name(self) -> str:
        """Name of its fringe set."""
        return self.bench.frames.fringes[self.number].name

    @property
    def key(self) -> tuple[int, int]:
        """Key of its random numbers."""
        return KINDS.index(self.kind), self.number

    def rng(self, effect: str, *key: int) -> np.random.Generator:
        """Random numbers of an effect, independent of caller and order."""
        return self._rng(self.bench.seed, effect, *key)

    def pixel_rng(self, effect: str, *key: int) -> np.random.Generator:
        """As `rng`, for quantities that differ from pixel to pixel."""
        return self._rng(self._pixel_seed, effect, *key)

    @property
    def noise_key(self) -> Key:
        """Key of the normals of shot and read noise."""
        return pixel_key(self._pixel_seed, Stream.NOISE, *self.key)

    def effect_key(self, effect: str) -> Key:
        """Key of the normals of an effect."""
        return pixel_key(self._pixel_seed, Stream.EFFECT, crc32(effect.encode()), *self.key)

    @property
    def _pixel_seed(self) -> int:
        """Seed of quantities that differ from pixel to pixel, and so from window to window."""
        return self.bench.seed + SEEDS_APART * self.window

    def _rng(self, seed: int, effect: str, *key: int) -> np.random.Generator:
        return generator(seed, Stream.EFFECT, crc32(effect.encode()), *self.key, *key)


def recordings(bench: Bench) -> list[Recording]:
    """Everything that the bench records, in order of time."""
    f = bench.frames
    planned: list[tuple[str, int, str, int, float, float]] = []
    if f.bias:
        planned.append(("bias", 0, "bias", f.bias, f.bias_exptime_s, 0.0))
    for n, step in enumerate(f.darks):
        planned.append(("dark", n, "dark", step.count, step.exptime_s, 0.0))
    for n, step in enumerate(f.flats):
        mean = (f.flat_rate_e_s or 0.0) * step.exptime_s
        planned.append(("flat", n, "flat", step.count, step.exptime_s, mean))
    for n, scan in enumerate(f.fringes):
        electrons = electrons_per_unit(bench, n)
        planned.append(("fringes", n, scan.name, scan.count, f.exptime_s, electrons))
    recorded, clock = [], 0.0
    for kind, number, folder, count, exptime, electrons in planned:
        period = max(f.period_s, exptime)
        stem = f"{folder}-{number}" if kind in ("dark", "flat") else folder
        recorded.append(
            Recording(bench, kind, number, count, exptime, clock, period, electrons, folder, stem)
        )
        clock += count * period
    return recorded
