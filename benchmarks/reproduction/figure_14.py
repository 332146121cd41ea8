"""Figures 14 and 15: the diagonal crest that straight fringes leave when the real ones bend."""

from dataclasses import asdict, dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from comparators import alternating
from pixcal.kernels.optics import phase
from pixcal.kernels.scene import geometry
from pixcal.model.bench import Bench
from pixcal.report.colours import BLUE, GREY, RED
from pixcal.report.drawing import WIDE, finish, new_figure, png, symmetric_scale
from pixcal.report.text import number, with_error
from reproduction.draw import THOUSANDTHS, image
from reproduction.figure_12 import OFFSET, SETS, by_paper, couplings_of, period_of, predicted_teeth
from reproduction.lab import Lab, Scene, facts, read_set
from reproduction.maps import Crest, sloping_harmonics, teeth, without
from reproduction.outcome import Outcome, Row

F64 = NDArray[np.float64]

QUICK_NOISY, QUICK_CLEAN = 100, 50


@dataclass(frozen=True)
class Bent:
    """One set fitted as straight fringes and by evidence."""

    # straight, auto: (y, x) offsets, px
    straight: F64
    auto: F64
    # crest, left: of their errors
    crest: Crest
    left: Crest
    expected: Crest  # of the exact fringes themselves
    # offset, seen, fitted: of the fibres from the window's middle (x, y), mm: true, read off the
    # crest, and as the hyperbolic fit has it
    offset: tuple[float, float]
    seen: tuple[float, float]
    fitted: tuple[float, float]
    fitted_sigma: tuple[float, float]  # mm
    model: str  # that the evidence chose
    error: float  # rms of the errors of ``auto``, less the modes, px


def measure(scene: Scene) -> dict[str, Bent]:
    """Both sets of an acquisition, from one sweep over its frames."""
    names = [s.name for s in scene.bench.frames.fringes]
    run = scene.fit(model="paraxial")
    straight = {name: read_set(run, name, "delta")[0] for name in names}
    scene.fit(model="auto")
    found = {}
    for number_, name in enumerate(names):
        g, truth, told = geometry(scene.bench, number_), scene.truth(name), facts(run, name)
        (auto,) = read_set(run, name, "delta")
        ny, nx = auto.shape
        y, x = np.indices((ny, nx))
        kx, ky = truth.vector
        crest = Crest.of(straight[name] - truth.delta)
        middle = ((nx - 1) / 2 * g.pitch, (ny - 1) / 2 * g.pitch)
        shape = told["geometry"]
        found[name] = Bent(
            straight[name],
            auto,
            crest=crest,
            left=Crest.of(auto - truth.delta),
            expected=Crest.of(phase(x, y, g) / np.hypot(kx, ky)),
            offset=(g.centre_x - middle[0], g.centre_y - middle[1]),
            seen=crest.fibre_offset(g.distance, g.pitch, 0 if abs(kx) > abs(ky) else 1),
            fitted=tuple(
                shape.get(f"centre_{a}_mm", np.nan) - m for a, m in zip("xy", middle, strict=True)
            ),
            fitted_sigma=tuple(shape.get(f"centre_{a}_sigma_mm", np.nan) for a in "xy"),
            model=told["model"],
            error=float(np.nanstd(truth.errors(auto))),
        )
    return found


@dataclass(frozen=True)
class Mixed:
    """A set of figure 14: what the paper's iterations leave in its map, px."""

    # delta, auto: (y, x) by the paper's iterations, and by pixcal
    delta: F64
    auto: F64
    # teeth, expected_teeth: peak to peak, measured and of the kernel
    teeth: float
    expected_teeth: float
    # fringes, auto_fringes: rms of the fringe and its second harmonic in the errors of both
    fringes: float
    auto_fringes: float
    crest: Crest


def mixture(scene: Scene, name: str) -> Mixed:
    """Crosstalk, moving fringes and their curvature in one map."""
    truth, couplings = scene.truth(name), couplings_of(scene)
    delta = by_paper(scene, name, alternating.ITERATIONS)
    (auto,) = read_set(scene.fit(), name, "delta")
    return Mixed(
        delta,
        auto,
        teeth=float(
            np.ptp(teeth(without(delta - truth.delta, _smooth(delta.shape)), period_of(couplings)))
        ),
        expected_teeth=float(np.ptp(predicted_teeth(couplings, truth.vector))),
        fringes=fringes_left(delta - truth.delta, truth.vector),
        auto_fringes=fringes_left(auto - truth.delta, truth.vector),
        crest=Crest.of(delta - truth.delta),
    )


def causes(lab: Lab, bench: Bench, name: str) -> dict[str, float]:
    """Fringes (px rms) that the paper's iterations leave for one thing that moves at a time."""
    (scan,) = (s for s in bench.frames.fringes if s.name == name)
    one_set = replace(bench, frames=replace(bench.frames, fringes=(scan,)))
    kept = {"nothing": (), "laser": ("intensity_noise",), "vector": ("fringe_jitter",)}
    alone = {
        cause: replace(
            one_set, effects={n: bench.effects[n] for n in ("hyperbolic_fringes", *names)}
        )
        for cause, names in kept.items()
    }
    found = {}
    for cause, one in alone.items():
        scene = lab.scene(f"figure-14-{cause}", one)
        truth, delta = scene.truth(name), by_paper(scene, name, alternating.ITERATIONS)
        found[cause] = fringes_left(delta - truth.delta, truth.vector)
    return found


def fringes_left(error: F64, vector: tuple[float, float]) -> float:
    """rms of the fringe and its second harmonic, even or sloping, in a map of errors, px."""
    smooth, waves = _smooth(error.shape), sloping_harmonics(error.shape, vector)
    rest = without(error, smooth)
    return float(np.nanstd(rest - without(rest, waves)))


def _smooth(shape: tuple[int, ...]) -> F64:
    """Polynomials to the third order (10, y, x)."""
    v, u = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    return np.stack([u**i * v**j for i in range(4) for j in range(4 - i)])


def draw(found: dict[str, Bent], mixed: dict[str, Mixed]) -> Figure:
    """Figure 14 above, figure 15 in the middle, below with the shape that the evidence chose."""
    figure = new_figure(WIDE, 8.6)
    grid = figure.subplots(3, 4, width_ratios=[1, 1, 0.8, 0.8])
    rows: list[tuple[str, dict[str, F64]]] = [
        ("figure 14: all effects", {n: m.delta for n, m in mixed.items()}),
        ("figure 15: straight model", {n: b.straight for n, b in found.items()}),
        ("the same, auto", {n: b.auto for n, b in found.items()}),
    ]
    for line, (title, maps) in zip(grid, rows, strict=True):
        for axes, means, name in zip(line[:2], line[2:], SETS, strict=True):
            shown = 1e3 * maps[name]
            # The crest's scale for all three, so that its absence shows.
            scale = symmetric_scale(1e3 * found[name].straight)
            image(figure, axes, shown, scale, THOUSANDTHS)
            axes.set_title(OFFSET[name], fontsize=10)
            _means(means, shown, OFFSET[name])
        line[0].set_ylabel(f"{title}\ny (px)", fontsize=9)
    return figure


def _means(axes: Axes, shown: F64, label: str) -> None:
    axes.plot(np.nanmean(shown, axis=1), color=BLUE, linewidth=0.7, label="rows")
    axes.plot(np.nanmean(shown, axis=0), color=RED, linewidth=0.7, label="columns")
    axes.axhline(0, color=GREY, linewidth=0.7)
    axes.set_title(f"mean {label} ({THOUSANDTHS})", fontsize=9)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.3 * (high - low))
    axes.legend(fontsize=7.5, loc="upper center", ncols=2)
    finish(axes)
    axes.tick_params(labelsize=8)


def make(lab: Lab) -> Outcome:
    """Simulate both acquisitions, fit as straight and by evidence, and draw."""
    scene = lab.scene("figure-15", lab.sized("figure-15", frames=QUICK_CLEAN))
    real = lab.scene("figure-14", lab.sized("figure-14", frames=QUICK_NOISY))
    found = measure(scene)
    mixed = {name: mixture(real, name) for name in SETS}
    alone = causes(lab, real.bench, "vertical")
    dx, dy = found["vertical"], found["horizontal"]
    counts = [s.bench.frames.fringes[0].count for s in (real, scene)]
    tilt = real.bench.effects["fringe_jitter"]["rms"][0] * real.bench.detector.shape[1]
    sized = "" if lab.full else " (the paper: 500)"
    return Outcome(
        figure="14-15",
        title="The paraxial crest",
        run=f"400 × 400 px, period 9 px, fibre pair offset 18 mm; {number(counts[0])} frames of "
        "each direction with noise, crosstalk and a fringe vector that varies, "
        f"{number(counts[1])} with none of them{sized}.",
        caption="Above: the paper's iterations, all effects. Middle: exact fringes without noise, "
        "fitted as straight ones (`--model paraxial`). Below: the middle frames with "
        "`--model auto`, same colour scale.",
        rows=(
            Row(
                "crest of δx, straight model, peak to peak", f"{number(dx.crest.reach)} px", "crest"
            ),
            Row("crest of δy, straight model, peak to peak", f"{number(dy.crest.reach)} px"),
            Row(
                "direction of the crest of δx, from the x axis",
                f"{dx.crest.ridge_deg:.1f}°, expected {dx.expected.ridge_deg:.1f}°",
                "crest",
            ),
            Row("fibre offset from the crest of δx", _place(dx.seen), "offset_x"),
            Row("fibre offset from the crest of δy", _place(dy.seen), "offset_y"),
            Row("fibre offset from the hyperbolic fit, δx", _fitted(dx)),
            Row(
                "remaining crests with `--model auto`, δx and δy",
                f"{number(dx.left.reach)} and {number(dy.left.reach)} px ({dx.model}, {dy.model})",
            ),
            Row(
                "teeth of δy, figure 14",
                f"{number(mixed['horizontal'].teeth)} px, kernel "
                f"{number(mixed['horizontal'].expected_teeth)} px",
                "same_teeth",
            ),
            Row(
                "fringes in δx, paper's iterations",
                f"{number(mixed['vertical'].fringes)} px rms",
                "residuals",
            ),
            Row(
                "the same with laser noise only, varying fringe vector only, neither",
                f"{number(alone['laser'])}, {number(alone['vector'])}, "
                f"{number(alone['nothing'])} px rms",
            ),
            Row("fringes in δx, pixcal", f"{number(mixed['vertical'].auto_fringes)} px rms"),
        ),
        difference="The crest is the second order of the path difference; its shape gives the "
        "fibre offset directly, where the paper used trial and error. It has the same size in δx "
        "and δy because both offsets are the same. The paper sees little in δy, so its fibres may "
        "be nearer to the axis in that direction. The paper's iterations leave fringes because "
        "they hold A, B and the fringe vector constant. Laser noise of "
        f"{100 * real.bench.effects['intensity_noise']['rms']:g} % alone leaves "
        f"{number(alone['laser'] / alone['vector'])} times as much as a fringe vector that varies "
        f"by {tilt:g} rad across the window.",
        numbers={
            "figure_15": {
                OFFSET[name]: {
                    "crest_px": bent.crest.reach,
                    "expected_crest_px": bent.expected.reach,
                    "ridge_deg": bent.crest.ridge_deg,
                    "expected_ridge_deg": bent.expected.ridge_deg,
                    "crest": asdict(bent.crest),
                    "crest_left_px": bent.left.reach,
                    "offset_mm": bent.offset,
                    "offset_of_crest_mm": bent.seen,
                    "offset_of_fit_mm": bent.fitted,
                    "offset_of_fit_sigma_mm": bent.fitted_sigma,
                    "model": bent.model,
                    "error_px": bent.error,
                }
                for name, bent in found.items()
            },
            "fringes_by_cause_px": alone,
            "figure_14": {
                OFFSET[name]: {
                    "crest_px": one.crest.reach,
                    "teeth_px": one.teeth,
                    "kernel_teeth_px": one.expected_teeth,
                    "fringes_px": one.fringes,
                    "fringes_pixcal_px": one.auto_fringes,
                }
                for name, one in mixed.items()
            },
        },
        picture=png(draw(found, mixed)),
    )


def _place(offset: tuple[float, float]) -> str:
    return f"({offset[0]:.2f} mm, {offset[1]:.2f} mm)".replace("-", "−")


def _fitted(bent: Bent) -> str:
    parts = [with_error(v, s) for v, s in zip(bent.fitted, bent.fitted_sigma, strict=True)]
    return f"({parts[0]} mm, {parts[1]} mm)"
