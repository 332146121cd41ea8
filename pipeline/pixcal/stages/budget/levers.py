"""Changes of a bench that save frames."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixcal.model.arrays import F64
from pixcal.model.bench import Bench, SimulatedFrames, SimulatedSet
from pixcal.stages.budget import expected
from pixcal.stages.budget.information import phase_information, unweighted_variance

# fringe periods (px) to try with a longer baseline; the paper uses at least 5 px (section 4.2)
FINER_PX = (5.0, 4.0, 3.0)


@dataclass(frozen=True)
class Lever:
    """A change of the bench, and the variance of one frame of all combined sets with it."""

    name: str
    # of the worse component at the median pixel, px², for one frame shared by the sets
    variance: float
    period_s: float  # from frame to frame
    note: str = ""  # its assumption, or ""


def levers(bench: Bench, now: expected.JoinedBound) -> list[Lever]:
    """Possible changes of the bench, the most helpful first, and the loss of equal weights."""
    split, period = expected.planned_split(bench), bench.frames.period_s
    best = now.best_split()
    candidates = [Lever("as planned", _worse(now, split), period)]
    for name, changed, contrast, note in _changes(bench, now):
        variance = _worse(expected.joined(changed, contrast), split)
        candidates.append(Lever(name, variance, changed.frames.period_s, note))
    if len(now.components) == 2 and np.abs(best - split).max() > 0.02:
        shares = " : ".join(f"{100 * s:.0f}" for s in best)
        candidates.append(Lever(f"frames shared {shares} %", _worse(now, best), period))
    plain = []
    for s in now.sets:
        unweighted = unweighted_variance(s.iota, s.alpha, s.variance, s.frames)
        information = phase_information(s.iota, s.alpha, s.variance, s.frames)
        ratio = float(np.median(unweighted * information))
        plain.append(replace(s, loss=(s.loss[0] * ratio, s.loss[1] * ratio)))
    equal = _worse(expected.JoinedBound(tuple(plain)), split)
    candidates.append(Lever("equal weights", equal, period, "needs more frames: not recommended"))
    return sorted(candidates, key=lambda lever: lever.variance * lever.period_s)


def _worse(bound: expected.JoinedBound, split: F64) -> float:
    return float(bound.median(split).max())


Change = tuple[str, Bench, list[float] | None, str]


def _changes(bench: Bench, now: expected.JoinedBound) -> list[Change]:
    """(name, bench, contrast of each set, note) of every applicable change."""
    d, f = bench.detector, bench.frames
    changes = _finer_fringes(bench, now)

    def add(name: str, note: str = "", **parts: Any) -> None:
        changes.append((name, replace(bench, **parts), None, note))

    def with_sets(**of_set: Callable[[SimulatedSet], Any]) -> SimulatedFrames:
        new = [replace(s, **{key: value(s) for key, value in of_set.items()}) for s in f.fringes]
        return replace(f, fringes=tuple(new))

    limit = expected.brightest_allowed(bench)
    if limit is not None and min(s.peak_e for s in f.fringes) < 0.95 * limit:
        fuller = with_sets(peak_e=lambda s: max(s.peak_e, limit))
        add(f"brightest fringe at {limit / 1e3:.3g} ke-", "no margin", frames=fuller)
    doubled = with_sets(peak_e=lambda s: 2 * s.peak_e)
    add("twice the light in each frame", "needs twice the full well", frames=doubled)
    if d.read_noise_e > 0:
        quiet = replace(d, read_noise_e=d.read_noise_e / 2)
        add(f"read noise {quiet.read_noise_e:.3g} e-", detector=quiet)
    each = [bench.optics_of(n) for n in range(len(f.fringes))]
    if min(one.visibility for one in each) < 0.995:
        add("visibility 1", frames=with_sets(visibility=lambda _: 1.0))
    if max(abs(np.log(one.power_ratio)) for one in each) > 0.02:
        add("fibres of equal power", frames=with_sets(power_ratio=lambda _: 1.0))
    if any(s.loss[0] > 1.01 for s in now.sets):
        add("phases over the whole period", frames=with_sets(phase_law=lambda _: "random"))
    if f.period_s > 1.05 * f.exptime_s:
        faster = replace(f, period_s=f.exptime_s)
        add(f"a frame every {f.exptime_s:.3g} s", "no dead time", frames=faster)
    return changes


def _finer_fringes(bench: Bench, now: expected.JoinedBound) -> list[Change]:
    """Longer baselines, down to the next fringe period of `FINER_PX`."""
    widest = max(s.interfringe for s in now.sets)
    wanted = next((w for w in FINER_PX if w < 0.9 * widest), None)
    if wanted is None:
        return []
    longer, contrast = [], []
    for scan, s in zip(bench.frames.fringes, now.sets, strict=True):
        stretch = max(1.0, s.interfringe / wanted)
        bx, by = scan.baseline_mm
        longer.append(replace(scan, baseline_mm=(bx * stretch, by * stretch)))
        kx, ky = np.array(s.axis) * float(s.k[s.typical])
        contrast.append(
            expected.pixel_contrast(kx * stretch, ky * stretch) / expected.pixel_contrast(kx, ky)
        )
    length = max(float(np.hypot(*scan.baseline_mm)) for scan in longer)
    changed = replace(bench, frames=replace(bench.frames, fringes=tuple(longer)))
    loss = 100 * (1 - min(contrast))
    note = f"contrast {loss:.2g} % lower: a pixel averages over its area"
    return [(f"fringe period {wanted:g} px (baseline {length:.3g} mm)", changed, contrast, note)]
