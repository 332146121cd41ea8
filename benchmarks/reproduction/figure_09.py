"""Figure 9: precision against frames for several fringe periods, and what the estimator changes."""

from dataclasses import asdict, dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from comparators import alternating
from comparators.measure import read_cube
from pixcal.model.bench import Bench
from pixcal.report.colours import BLUE, GREEN, GREY, INK, MARKS, RED
from pixcal.report.drawing import WIDE, finish, new_figure, png
from pixcal.report.text import number, with_error
from reproduction.draw import logarithmic
from reproduction.lab import Lab, Scene, facts, nominal_vector, read_set
from reproduction.outcome import Outcome, Row
from reproduction.paper import TARGET_PX
from truth import PLANE

F64 = NDArray[np.float64]

QUICK_FRAMES = (100, 300, 1000, 3000, 12_000)
FULL_FRAMES = (100, 300, 1000, 3000, 10_000, 20_000)
QUICK_SIDE = 56
LASER_RMS = 0.02
"""Section 4.2."""
FINEST = "px-5"
METHODS = {"constant": "A and B constant (paper)", "free": "A and B free, all modes kept"}
COLOURS = (BLUE, GREEN, MARKS[2], RED)


@dataclass(frozen=True)
class Point:
    """Error of a map of some frames."""

    frames: int
    # error, bound: rms against the truth, and the Cramér-Rao bound, px
    error: float
    bound: float

    @property
    def frames_to_target(self) -> float:
        """Frames for the precision that the mission needs, along the square-root law."""
        return self.frames * (self.error / TARGET_PX) ** 2


@dataclass(frozen=True)
class Line:
    """One fringe period."""

    interfringe: float
    points: tuple[Point, ...]


def precision(scene: Scene, frames: tuple[int, ...]) -> dict[str, Line]:
    """Errors of pixcal's maps from the first frames of each set, by set."""
    truths = {s.name: s.count for s in scene.bench.frames.fringes}
    points: dict[str, list[Point]] = {name: [] for name in truths}
    periods = {}
    for count in frames:
        run = scene.fit(count)
        for name, most in truths.items():
            truth = scene.truth(name)
            (delta,) = read_set(run, name, "delta")
            bound = truth.bound * np.sqrt(most / count)
            points[name].append(Point(count, truth.error(delta), bound))
            periods[name] = facts(run, name)["interfringe_px"]
    return {name: Line(periods[name], tuple(found)) for name, found in points.items()}


def alternatives(scene: Scene, name: str, frames: tuple[int, ...]) -> dict[str, list[Point]]:
    """Errors of the paper's iterations, unweighted, from the first frames of a set.

    Only piston and slopes are taken off: fringes that an estimator leaves in its map count.
    """
    truth, run = scene.truth(name), scene.reduced()
    cube, vector = read_cube(run, name), nominal_vector(run, name)
    found: dict[str, list[Point]] = {method: [] for method in METHODS}
    for count in frames:
        bound = truth.bound * np.sqrt(len(cube) / count)
        for method, points in found.items():
            psi = alternating.fit_phases(cube[:count], vector, constant=method == "constant")
            points.append(Point(count, truth.error(truth.offsets(psi), PLANE), bound))
    return found


def noisy(bench: Bench) -> Bench:
    """The finest fringes with laser noise."""
    (scan,) = (s for s in bench.frames.fringes if s.name == FINEST)
    return replace(
        bench,
        effects=bench.effects | {"intensity_noise": {"rms": LASER_RMS}},
        frames=replace(bench.frames, fringes=(scan,)),
    )


def draw(lines: dict[str, Line], methods: dict[str, dict[str, list[Point]]]) -> Figure:
    """All fringe periods on the left; the estimators at the finest one on the right."""
    figure = new_figure(WIDE, 4.8)
    left, right = figure.subplots(1, 2, sharey=True)
    for line, colour in zip(lines.values(), COLOURS, strict=False):
        label = f"{line.interfringe:.3g} px period"
        _points(left, line.points, colour, "o", label)
        _bound(left, line.points, colour)
    left.plot([], [], color=GREY, ls="--", label="Cramér–Rao bound")
    left.set_ylabel("error of a pixel's offset (px rms)")
    own = lines[FINEST].points
    _bound(right, own, INK)
    _points(right, own, BLUE, "o", "pixcal, steady laser")
    laser = f"{100 * LASER_RMS:g} % laser noise"
    styles = {"constant": (RED, "s"), "free": (GREEN, "^")}
    for laser_name, found in methods.items():
        steady = laser_name == "steady"
        said = "steady laser" if steady else laser
        for method, points in found.items():
            colour, marker = styles.get(method, (BLUE, "o"))
            label = f"{METHODS.get(method, 'pixcal')}, {said}"
            _points(right, points, colour, marker, label, hollow=not steady)
    for axes, title in ((left, "pixcal fit"), (right, f"{lines[FINEST].interfringe:.3g} px")):
        logarithmic(axes)
        axes.axhline(TARGET_PX, color=GREY, linewidth=1)
        axes.set(xlabel="frames", title=title)
        axes.legend(fontsize=8, loc="upper right", framealpha=0.9)
        finish(axes)
    left.annotate(
        "needed",
        (own[0].frames, TARGET_PX),
        xytext=(0, 4),
        textcoords="offset points",
        color=INK,
        fontsize=9,
    )
    top = max(p.error for found in methods.values() for points in found.values() for p in points)
    highest = max(top, max(p.error for line in lines.values() for p in line.points))
    left.set_ylim(0.6 * TARGET_PX, 12 * highest)
    return figure


def _points(
    axes: Axes,
    points: "tuple[Point, ...] | list[Point]",
    colour: str,
    marker: str,
    label: str,
    *,
    hollow: bool = False,
) -> None:
    axes.plot(
        [p.frames for p in points],
        [p.error for p in points],
        marker,
        color=colour,
        label=label,
        markersize=9 if hollow else 6,
        markerfacecolor="white" if hollow else colour,
        ls=":" if hollow else "",
        linewidth=1,
        zorder=2 if hollow else 3,
    )


def _bound(axes: Axes, points: tuple[Point, ...], colour: str) -> None:
    first, last = points[0], points[-1]
    axes.plot(
        [first.frames, last.frames], [first.bound, last.bound], color=colour, ls="--", linewidth=1
    )


def make(lab: Lab) -> Outcome:
    """Simulate, fit, compare and draw."""
    frames = FULL_FRAMES if lab.full else QUICK_FRAMES
    bench = lab.sized("figure-09", side=QUICK_SIDE, frames=frames[-1])
    scene = lab.scene("figure-09", bench)
    lines = precision(scene, frames)
    unsteady = lab.scene("figure-09-laser", noisy(bench))
    methods = {
        "steady": alternatives(scene, FINEST, frames),
        "laser": alternatives(unsteady, FINEST, frames)
        | {"pixcal": list(precision(unsteady, frames)[FINEST].points)},
    }
    ratios = [p.error / p.bound for line in lines.values() for p in line.points]
    last = lines[FINEST].points[-1]
    own, paper = last.frames_to_target, methods["steady"]["constant"][-1].frames_to_target
    needed = {
        laser: {m: p[-1].frames_to_target for m, p in found.items()}
        for laser, found in methods.items()
    }
    side = bench.detector.shape[0]
    # What four patterns hold of a map without correlations.
    floor = bench.detector.delta_rms_px * 2 / side
    # Of the square of an rms over so many pixels.
    chance = float(np.sqrt(2)) / side
    return Outcome(
        figure="9",
        title="Precision against frames",
        run=f"{len(lines)} fringe periods, {number(frames[-1])} frames of {side} × {side} px each, "
        "and the finest fringes again with laser noise. Other points use the first frames. The "
        "paper does not state its window, and simulates sums of frames above 10 000.",
        caption="Left: errors relative to the truth, degenerate modes removed; dashed: Cramér–Rao "
        "bounds. Right: pixcal and the paper's iterations (five, without weights) on the same "
        "frames; hollow: with laser noise. From the paper's maps only piston and slopes are "
        "removed.",
        rows=(
            Row(
                "frames for 5 × 10⁻⁵ px with a period of 5 px, pixcal",
                with_error(own, own * chance),
                "target",
            ),
            Row(
                "the same, A and B constant, no weights",
                with_error(paper, paper * chance),
                "constant",
            ),
            Row(
                "error over the Cramér–Rao bound, all points",
                f"{min(ratios):.3f} to {max(ratios):.3f}",
                "finer",
            ),
            Row(
                "error with A and B free and all modes kept, all frames",
                f"{number(methods['steady']['free'][-1].error)} px",
                "free",
            ),
            Row(
                f"A and B constant, {100 * LASER_RMS:g} % laser noise: frames for 5 × 10⁻⁵ px",
                number(needed["laser"]["constant"]),
                "laser",
            ),
            Row(
                f"pixcal, {100 * LASER_RMS:g} % laser noise: frames for 5 × 10⁻⁵ px",
                number(needed["laser"]["pixcal"]),
            ),
        ),
        difference=f"The paper's estimator needs {number(paper)} frames, as the paper says. It "
        f"weights all samples alike. With weights from the model, {number(own)} frames suffice, "
        f"{number(paper / own)} times fewer, which is the bound. Free intensities are degenerate "
        f"with four fringe patterns of the map. These patterns hold {number(floor)} px of the true "
        "offsets here, an error that more frames do not reduce. With constant intensities, laser "
        f"noise of {100 * LASER_RMS:g} % appears as fringes in the map.",
        numbers={
            "pixcal": {name: asdict(line) for name, line in lines.items()},
            "methods_at_5_px": {
                laser: {m: [asdict(p) for p in points] for m, points in found.items()}
                for laser, found in methods.items()
            },
            "four_patterns_of_the_map_px": floor,
            "frames_to_target": needed | {"pixcal_steady": own},
        },
        picture=png(draw(lines, methods)),
    )
