"""``pixcal budget``: the expected precision of a bench.

docs/reference/products-other.md describes ``budget.json``.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pixcal import __version__
from pixcal.estimators.fringe_fit.fringes import MIN_FRINGES_FOR_MAPS
from pixcal.model.bench import Bench, load_bench
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError, naming
from pixcal.model.options import Budget as Config
from pixcal.report.budget_figures import budget_figure
from pixcal.report.drawing import png
from pixcal.stages.budget import expected
from pixcal.stages.budget.calibration import frames_to_calibrate
from pixcal.stages.budget.expected import Shares
from pixcal.stages.budget.levers import levers
from pixcal.storage.manifest import digest, write_json, write_whole

SCHEMA = "pixcal/budget/1"
MARGIN = 4.0  # least margin of the brightest fringe below the end of the range, standard deviations
DOMINANT = 1.5  # factors on frames below this do not limit a set: photons do

# frames of each set -> variances (px²) of the median and of the worst pixel
Reach = Callable[[Shares], tuple[float, float]]


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
            "calibration": frames_to_calibrate(bench, s),
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
        "left_out": [*_left_out(bench)],
        "warnings": [*_warnings(bench, bound)],
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


def _left_out(bench: Bench) -> Iterator[str]:
    """Effects that the bound does not include."""
    d = bench.detector
    yield "systematic errors (crosstalk, drifts, ghosts, nonlinearity), which do not average out"
    if bench.effects:
        yield (
            "effects of the bench file, except variations of light and contrast of whole frames: "
            + ", ".join(sorted(bench.effects))
        )
    if d.prnu_rms > 0:
        yield (
            f"PRNU of {100 * d.prnu_rms:.2g} % rms, which changes the errors of single pixels by "
            f"{50 * d.prnu_rms:.2g} % rms"
        )
    if not bench.shot_noise:
        yield "shot_noise: false in the bench file: the budget includes shot noise anyway"


def _warnings(bench: Bench, bound: expected.JoinedBound) -> Iterator[str]:
    limit = expected.brightest_allowed(bench)
    ny, nx = bench.detector.shape
    for number, (scan, s) in enumerate(zip(bench.frames.fringes, bound.sets, strict=True)):
        noise = s.variance + scan.peak_e + (expected.frame_rms(bench, number)[0] * scan.peak_e) ** 2
        top = scan.peak_e + MARGIN * noise**0.5
        if limit is not None and top > limit:
            yield (
                f"{scan.name}: the brightest fringe, {scan.peak_e / 1e3:.4g} ke-, reaches "
                f"{top / 1e3:.4g} ke- at {MARGIN:.0f} sigma; the range ends at "
                f"{limit / 1e3:.4g} ke-, so that some samples are lost"
            )
        if s.interfringe < 2:
            yield (
                f"{scan.name}: fringe period {s.interfringe:.3g} px is below two pixels: the "
                "fringes are aliased"
            )
        across = float(np.hypot(np.median(s.kx) * nx, np.median(s.ky) * ny) / (2 * np.pi))
        if across < MIN_FRINGES_FOR_MAPS:
            yield (
                f"{scan.name}: {across:.2g} fringes across the window; with fewer "
                f"than {MIN_FRINGES_FOR_MAPS:g}, offsets and fringes cannot be separated"
            )
