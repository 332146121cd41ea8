"""Changes of the light in the frames of an acquisition: level, contrast and offset.

Three causes change a frame's mean intensity B and fringe amplitude A. The power of the light
changes both equally; the contrast changes A alone; an electronic offset, or light without fringes,
changes B alone. The covariance of (B, log A/B) separates them, whatever their sizes, and frames
without light measure the offset alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack, cached_on_evidence
from pixcal.estimators.frame_series.offset import dark_offsets
from pixcal.estimators.frame_series.series import (
    FrameSeries,
    TimedValues,
    assemble,
    light_series,
    mode_variance,
    wiener,
)
from pixcal.estimators.frame_series.spectral_line import Line, without_line
from pixcal.estimators.frame_series.variance_components import Modes, estimate_components
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F64

KNOTS = 32  # most points of a course of fringes
FEWEST_DARK = 12  # fewest frames without light to measure their offset
CALM = 25.0  # largest square of a residual over its noise, so that hits do not count
IMBALANCE = 0.02, 0.15  # least and most difference of the fibres' powers over their sum
LIGHT_PARTS = ("power", "power_walk", "contrast", "contrast_walk", "offset", "offset_walk")
PATTERNS = {
    # Covariance of (B, log A/B) for each kind of change.
    "power": np.array([[1.0, 0.0], [0.0, 0.0]]),
    "contrast": np.array([[0.0, 0.0], [0.0, 1.0]]),
    "offset": np.array([[1.0, -1.0], [-1.0, 1.0]]),
}


@dataclass(frozen=True)
class FrameLight:
    """Light of the frames of all sets."""

    sets: tuple[FrameSeries, ...]  # (B over its mean less one, log A/B), without significant line
    dark: tuple[FrameSeries, ...]  # mean level of frames without light (e-), and zero
    level: dict[str, float]  # mean signal of each set, e-
    line: Line | None = None  # the strongest in B, significant or not

    def modes(self, parts: Sequence[str], ramp: bool = False) -> Modes:
        """Walk modes of all series, with the covariance of kinds of change.

        ``power``, ``contrast`` or ``offset`` (white), with ``_walk`` (a random walk; 1/s) or
        ``_smooth`` (ramps and settlings: the square of a walk's spectrum); offsets in e-², the
        others relative. ``ramp`` adds an offset that rises with time in each series (e-/s) as the
        known shape.
        """
        return assemble(
            [*self.sets, *self.dark],
            lambda s: np.stack([self.part(name, s) for name in parts]),
            self._ramp if ramp else None,
        )

    def _ramp(self, series: FrameSeries) -> F64:
        """Change (t, 2, 1) of the two quantities of a series by an offset of 1 e-/s."""
        level = self.level.get(series.name)
        both = np.array([1.0, 0.0]) if level is None else np.array([1.0, -1.0]) / level
        return np.asarray(series.time_s[:, None, None] * both[:, None])

    def part(self, name: str, series: FrameSeries) -> F64:
        """Covariance (t - 1, 2, 2) of the modes of a series for a unit of a kind of change."""
        kind, _, time = name.partition("_")
        n, level, walk = len(series), self.level.get(series.name), series.walk_modes.walk
        power = {"": np.ones(n - 1), "walk": walk, "smooth": (walk / series.step_s / n) ** 2}[time]
        if level is None:
            pattern = PATTERNS["power"] * (kind == "offset")
        else:
            pattern = PATTERNS[kind] / (level**2 if kind == "offset" else 1.0)
        return np.asarray(power[:, None, None] * pattern)


def light_changes(evidence: Evidence) -> list[tuple[str, F64, F64, F64]]:
    """Of every set: name, times (t,), relative intensity and contrast (t,), Wiener-filtered."""
    of_sets = []
    for f in evidence.fringes.values():
        series = light_series(f)
        if series is None:
            continue
        changes = []
        for channel, values in enumerate(_levels(f)):
            noise, seen = float(series.noise[channel, channel]), float(np.var(values))
            changes.append((values - 1) * np.sqrt(max(1 - noise / max(seen, 1e-300), 0.0)))
        of_sets.append((f.name, f.time_s, changes[0], changes[1]))
    return of_sets


def _levels(fringes: FringeEvidence) -> tuple[F64, F64]:
    """Intensity over its mean and contrast over its median (t,), of independent frames."""
    b, a = fringes.free[:, 0], np.hypot(fringes.free[:, 1], fringes.free[:, 2])
    return b / b.mean(), a / b / np.median(a / b)


def ambient_shares(evidence: Evidence) -> list[tuple[float, float]]:
    """Share of each set's mean light that does not follow the laser, and its error."""
    shares = dict.fromkeys(evidence.fringes, (0.0, 1.0))
    for name, _, level, contrast in light_changes(evidence):
        square = float(level @ level)
        if square > 0:
            slope = float(level @ contrast) / square
            rest = contrast - slope * level
            error = np.sqrt(float(rest @ rest) / max(len(rest) - 1, 1) / square)
            shares[name] = slope / (1 + slope), float(error) / (1 + slope) ** 2
    return list(shares.values())


@cached_on_evidence
def gain_share(evidence: Evidence) -> tuple[float, float]:
    """Part of the frames' changes that is of the gain, not of the light, and its error.

    Both scale the signal; the variance of its shot noise goes with the light, but with the square
    of the gain. The measured variance over that of the light then rises as the gain.
    """
    along = square = rest = 0.0
    for f in evidence.fringes.values():
        change = _levels(f)[0] - 1
        noise, shot = np.empty((2, len(change)))
        for t, (residual, model) in enumerate(zip(f.residual, f.model, strict=True)):
            light = (f.shot_factor * model)[f.good]
            ratio = residual[f.good] ** 2 / (light + f.read_variance[f.good])
            noise[t], shot[t] = np.nanmean(np.minimum(ratio, CALM)), light.mean()
        read = float(f.read_variance[f.good].mean())
        gain = change * shot / (shot + read)
        noise /= noise.mean()
        along, square = along + float(gain @ (noise - 1)), square + float(gain @ gain)
        rest = max(rest, float(np.var(noise)))
    return along / max(square, 1e-300), float(np.sqrt(rest / max(square, 1e-300)))


def separate_powers(evidence: Evidence) -> float:
    """Relative rms change of the contrast where the powers of two fibres change separately.

    With power shares ``(1 ± d) / 2`` the contrast goes with ``sqrt(1 - d²)``; a change x of d
    changes it by ``-d x``. Up to `IMBALANCE` of the intensity it is no separate effect; else zero.
    """
    of_level = of_contrast = chance = 0.0
    for f in evidence.fringes.values():
        series = light_series(f)
        if series is None:
            continue
        of_intensity, seen = (float(np.var(values)) for values in _levels(f))
        of_level += of_intensity
        of_contrast += seen - float(series.noise[1, 1])
        chance += 2 * seen**2 / len(f.free)
    least, most = (d**2 * of_level for d in IMBALANCE)
    if of_contrast <= SIGNIFICANT * np.sqrt(chance) or not least < of_contrast < most:
        return 0.0
    return float(np.sqrt(of_contrast / max(len(evidence.fringes), 1)))


@cached_on_evidence
def light_of(evidence: Evidence) -> FrameLight | None:
    """Light of all sets with enough frames; None without any."""
    by_set = {f.name: light_series(f) for f in evidence.fringes.values()}
    sets = [s.cleaned() for s in by_set.values() if s is not None]
    if not sets:
        return None
    every = evidence.fringes.values()
    level = {f.name: float(np.median(f.theta[0][f.good]) * f.free[:, 0].mean()) for f in every}
    stacks = (*evidence.of_kind("bias"), *evidence.of_kind("dark"))
    dark = [_dark_series(s, n, evidence) for n, s in enumerate(stacks)]
    light = FrameLight(tuple(sets), tuple(d for d in dark if d is not None), level)
    parts = LIGHT_PARTS[:4]

    def variance(series: FrameSeries) -> F64:
        return mode_variance(series, np.stack([light.part(name, series) for name in parts]))

    line, cleared = without_line(sets, variance, channels=(0,))
    return replace(light, sets=cleared, line=line)


def _dark_series(stack: Stack, number: int, evidence: Evidence) -> FrameSeries | None:
    """Mean level of frames without light, as the first of two quantities."""
    offsets = dark_offsets(stack, evidence.good, evidence.gain, evidence.read_noise)
    if offsets is None or len(offsets) < FEWEST_DARK:
        return None
    nothing = np.zeros(len(offsets))
    return FrameSeries(
        name=f"{stack.kind}:{number}",
        k=(0.0, 0.0),
        frame=stack.frame,
        time_s=stack.time_s,
        exptime_s=stack.exptime_s,
        values=np.stack([offsets.values[:, 0], nothing], axis=1),
        apart=np.stack([offsets.values[:, 1], nothing], axis=1),
        shapes=np.zeros((len(offsets), 0)),
        noise=np.diag([offsets.noise[0], 1.0]),
        apart_noise=np.diag([offsets.noise[1], 1.0]),
    )


def fringe_offset_series(light: FrameLight) -> tuple[list[TimedValues], float]:
    """Slow offsets of every set, from changes of B but not A; then the remainder, e- rms."""
    light = replace(light, dark=())
    drifts, every = ("offset_walk", "offset_smooth"), (*LIGHT_PARTS, "offset_smooth")
    offsets, jitter = [], []
    for series in light.sets:
        modes = replace(light, sets=(series,)).modes(every)
        size = np.maximum(estimate_components(modes).size, 0.0)
        n = len(series) - 1
        parts = size[:, None, None, None] * modes.parts[:, :n]
        # In e-, the covariance of (B, log A/B) with the drift.
        drift = light.level[series.name] * sum(parts[every.index(name)] for name in drifts)
        offset = series.walk_modes.series(wiener(parts, drift[:, :, 0], modes.values[:n]))
        some = np.unique(np.linspace(0, n, min(KNOTS, n + 1)).astype(int))
        offsets.append((series.name, series.time_s[some], offset[some]))
        jitter.append(size[every.index("offset")])
    return offsets, float(np.sqrt(np.mean(jitter)))
