"""``pixcal budget``: the expected precision of a bench.

docs/reference/products-other.md describes ``budget.json``.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixcal import __version__
from pixcal.estimators.fringe_fit.fringes import MIN_FRINGES_FOR_MAPS
from pixcal.model.arrays import F64
from pixcal.model.bench import Bench, SimulatedFrames, SimulatedSet, load_bench
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError, naming
from pixcal.model.options import Budget as Config
from pixcal.report.budget_figures import budget_figure
from pixcal.report.drawing import png
from pixcal.stages.budget import expected
from pixcal.stages.budget.expected import Shares
from pixcal.storage.manifest import digest, write_json, write_whole

SCHEMA = "pixcal/budget/1"
MARGIN = 4.0  # least margin of the brightest fringe below the end of the range, standard deviations
DOMINANT = 1.5  # factors on frames below this do not limit a set: photons do

# frames of each set -> variances (px²) of the median and of the worst pixel
Reach = Callable[[Shares], tuple[float, float]]
# fringe periods (px) to try with a longer baseline; the paper uses at least 5 px (section 4.2)
FINER_PX = (5.0, 4.0, 3.0)


def run(bench_file: Path, config: Config, out: Path | None = None) -> dict[str, Any]:
    """Compute the budget of a bench; write ``budget.json`` and ``budget.png`` to ``out``."""
    bench = load_bench(bench_file)
    expected.own_effects(bench, str(bench_file))
    if not bench.frames.fringes:
        raise InputError(f"{bench_file}: frames.fringes: lists no fringe set; add one")
    with naming(str(bench_file)):
        bound = expected.joined(bench)
    for scan, s in zip(bench.frames.fringes, bound.sets, strict=True):
        if not np.isfinite(s.loss[0]):
            raise InputError(
                f"{bench_file}: set {scan.name!r}: phase_step_rad: its phases do not determine "
                "offset, level and contrast; at least three different ones are needed"
            )
    precision = config.precision_px
    if precision is None and config.frames is None:
        precision = 5e-5  # target of the paper (section 1)
    result = {
        "schema": SCHEMA,
        "pixcal": __version__,
        "bench": {"file": str(bench_file), "digest": digest(to_plain(bench))},
    } | _budget(bench, bound, precision, config.frames)
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise InputError(f"--out {out}: is a file; choose another directory") from error
        write_whole(out / "budget.png", png(budget_figure(result)))
        write_json(out / "budget.json", result)
    return result


def _budget(
    bench: Bench, bound: expected.JoinedBound, precision: float | None, frames: int | None
) -> dict[str, Any]:
    d, f, split = bench.detector, bench.frames, expected.planned_split(bench)
    counts = [s.count for s in f.fringes]
    given = None if frames is None else np.full(len(counts), frames)

    def facts(reach: Reach, one: Shares, planned: Shares, given: Shares | None) -> dict[str, Any]:
        """Precision of one frame and of given frames, and the cost of the required precision."""
        (median, worst), wanted = reach(one), _cost(bench, reach(one)[0], precision)
        if wanted and precision is not None:
            wanted["frames_worst"] = expected.frames_needed(worst, precision)
        return {
            "frame_px": {"median": median**0.5, "worst": worst**0.5},
            "planned": _reached(reach, planned),
            "given": None if given is None else _reached(reach, given),
            "wanted": wanted,
        }

    sets = {}
    for n, (scan, s) in enumerate(zip(f.fringes, bound.sets, strict=True)):
        shares = s.shares()
        limited_by = _limited_by(shares)
        if precision is not None:
            shares["photons_frames"] = expected.frames_needed(shares["photons"], precision)
        sets[scan.name] = {
            "interfringe_px": s.interfringe,
            "mean_e": float(np.median(s.iota)),
            "visibility": s.visibility,
            **facts(s.reach, [1], [counts[n]], None if frames is None else [frames]),
            "shares": shares,
            "limited_by": limited_by,
            "calibration": _calibration(bench, s),
        }
    components = {
        name: facts(bound.reach(n), split, counts, given) for n, name in enumerate(bound.components)
    }
    return {
        "precision_px": precision,
        "frames": frames,
        "window": list(d.shape),
        "variance_e2": {
            "read_noise": d.read_noise_e**2,
            "quantisation": d.gain_e_per_adu**2 / 12,
            "dark": d.dark_e_s * f.exptime_s,
        },
        "sets": sets,
        "joined": {
            "components": components,
            "wanted": _cost(bench, float(bound.median(split).max()), precision),
            "split": split.tolist(),
            "best_split": bound.best_split().tolist(),
        },
        "levers": [
            asdict(lever) | _time(lever.variance, lever.period_s, precision)
            for lever in levers(bench, bound)
        ],
        "left_out": _left_out(bench),
        "warnings": _warnings(bench, bound),
    }


def _time(variance: float, period_s: float, precision: float | None) -> dict[str, Any]:
    frames = None if precision is None else expected.frames_needed(variance, precision)
    return {"frames": frames, "hours": None if frames is None else frames * period_s / 3600}


def _limited_by(shares: Mapping[str, float]) -> str:
    """The largest of the shares if it dominates, else photons."""
    others = {name: value for name, value in shares.items() if name != "photons"}
    largest = max(others, key=lambda name: others[name])
    return largest if others[largest] > DOMINANT else "photons"


def _cost(bench: Bench, variance: float, precision: float | None) -> dict[str, Any] | None:
    if precision is None:
        return None
    n, (ny, nx) = expected.frames_needed(variance, precision), bench.detector.shape
    hours = n * bench.frames.period_s / 3600
    return {"frames": n, "hours": hours, "bytes": n * ny * nx * 2}  # two bytes a sample


def _reached(reach: Reach, frames: Shares) -> dict[str, Any]:
    median, worst = reach(frames)
    return {"frames": round(sum(frames)), "median_px": median**0.5, "worst_px": worst**0.5}


def _calibration(bench: Bench, s: expected.SetBound) -> dict[str, Any]:
    """Bias and flat frames needed, and the cost of those planned."""
    n, f = s.typical, bench.frames
    errors = expected.WeightErrors.of(float(s.iota[n]), float(s.alpha[n]), s.variance)
    level, flat = float(np.median(s.iota)), expected.flat_error(bench)
    return {
        "bias_frames_needed": expected.bias_frames_needed(errors, s.variance),
        "bias_frames": f.bias,
        "bias_error_e": (expected.sample_variance(bench) / f.bias) ** 0.5 if f.bias else None,
        "flats_needed": expected.flats_needed(errors, level, s.variance),
        "flats": sum(step.count for step in f.flats),
        "flat_error": flat,
        "flat_cost": errors.scale * (flat**2 if flat is not None else bench.detector.prnu_rms**2),
    }


def _left_out(bench: Bench) -> list[str]:
    """Effects that the bound does not include."""
    d, sentences = bench.detector, []
    sentences.append(
        "systematic errors (crosstalk, drifts, ghosts, nonlinearity), which do not average out"
    )
    if bench.effects:
        sentences.append(
            "effects of the bench file, except variations of light and contrast of whole frames: "
            + ", ".join(sorted(bench.effects))
        )
    if d.prnu_rms > 0:
        sentences.append(
            f"PRNU of {100 * d.prnu_rms:.2g} % rms, which changes the errors of single pixels by "
            f"{50 * d.prnu_rms:.2g} % rms"
        )
    if not bench.shot_noise:
        sentences.append(
            "shot_noise: false in the bench file: the budget includes shot noise anyway"
        )
    return sentences


def _warnings(bench: Bench, bound: expected.JoinedBound) -> list[str]:
    sentences, limit = [], expected.brightest_allowed(bench)
    ny, nx = bench.detector.shape
    for number, (scan, s) in enumerate(zip(bench.frames.fringes, bound.sets, strict=True)):
        noise = s.variance + scan.peak_e + (expected.frame_rms(bench, number)[0] * scan.peak_e) ** 2
        top = scan.peak_e + MARGIN * noise**0.5
        if limit is not None and top > limit:
            sentences.append(
                f"{scan.name}: the brightest fringe, {scan.peak_e / 1e3:.4g} ke-, reaches "
                f"{top / 1e3:.4g} ke- at {MARGIN:.0f} sigma; the range ends at "
                f"{limit / 1e3:.4g} ke-, so that some samples are lost"
            )
        if s.interfringe < 2:
            sentences.append(
                f"{scan.name}: fringe period {s.interfringe:.3g} px is below two pixels: the "
                "fringes are aliased"
            )
        across = float(np.hypot(np.median(s.kx) * nx, np.median(s.ky) * ny) / (2 * np.pi))
        if across < MIN_FRINGES_FOR_MAPS:
            sentences.append(
                f"{scan.name}: {across:.2g} fringes across the window; with fewer "
                f"than {MIN_FRINGES_FOR_MAPS:g}, offsets and fringes cannot be separated"
            )
    return sentences


# Changes of a bench that save frames


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
        unweighted = expected.unweighted_variance(s.iota, s.alpha, s.variance, s.frames)
        information = expected.phase_information(s.iota, s.alpha, s.variance, s.frames)
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
