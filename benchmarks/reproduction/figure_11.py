"""Figure 11: Allan deviations of the offset maps over two long runs of diagonal fringes."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pixcal.report.colours import BLUE, GREEN, GREY, INK, RED
from pixcal.report.drawing import WIDE, finish, new_figure, png
from pixcal.report.text import number, with_error
from reproduction.draw import logarithmic, plain_ticks
from reproduction.lab import Lab, Scene, facts, read_set
from reproduction.outcome import Outcome, Row
from reproduction.paper import MEASURED_FRAMES, MEASURED_PX, STABLE_S

BATCH_FRAMES = 500
"""Section 4.3."""
QUICK_FRAMES = 20_000
FINER_PX = 5.0
"""Interfringe of the simulation that section 4.3 refers to."""


@dataclass(frozen=True)
class Stability:
    """One set."""

    name: str
    allan: dict[str, Any]  # its part of ``allan.json``
    frames: int
    # error, bound: of the map of all frames, against the truth, px
    error: float
    bound: float
    interfringe: float  # px

    def at(self, frames: int) -> float:
        """Deviation of so many frames, px, by the square-root law through the first point."""
        first, deviation = self.allan["frames"][0], self.allan["adev_px"][0]
        return float(deviation * np.sqrt(first / frames))


def measure(scene: Scene, batch_frames: int = BATCH_FRAMES) -> list[Stability]:
    """Allan deviations of all sets, and the errors of their whole maps."""
    curves = scene.allan(batch_frames)
    run = scene.fit(batch_frames=batch_frames)
    found = []
    for scan in scene.bench.frames.fringes:
        truth = scene.truth(scan.name)
        (delta,) = read_set(run, scan.name, "delta")
        period = facts(run, scan.name)["interfringe_px"]
        error = truth.error(delta)
        found.append(
            Stability(scan.name, curves[scan.name], scan.count, error, truth.bound, period)
        )
    return found


def draw(found: list[Stability], period_s: float) -> Figure:
    """A panel for each set."""
    figure = new_figure(WIDE, 4.4)
    for axes, one in zip(figure.subplots(1, 2, sharey=True), found, strict=True):
        _panel(axes, one, period_s)
    figure.axes[0].set_ylabel("Allan deviation of δ (px)")
    return figure


def _panel(axes: Axes, one: Stability, period_s: float) -> None:
    curve = one.allan
    frames, deviation = np.array(curve["frames"]), np.array(curve["adev_px"])
    axes.errorbar(
        frames,
        deviation,
        yerr=curve["adev_err_px"],
        fmt="o",
        color=INK,
        markersize=5,
        label="Allan deviation, median pixel",
    )
    ends = np.array([frames[0], max(one.frames, MEASURED_FRAMES)])
    middle = float(np.exp(np.mean(np.log(frames))))
    level = float(np.exp(np.mean(np.log(deviation))))
    slope = with_error(curve["slope"], curve["slope_err"])
    fitted = level * (ends / middle) ** curve["slope"]
    axes.plot(ends, fitted, color=RED, linewidth=1.2, label=f"power law, slope {slope}")
    axes.plot(
        ends,
        one.bound * np.sqrt(one.frames / ends),
        color=GREEN,
        ls="--",
        linewidth=1.2,
        label="Cramér–Rao bound, square-root law",
    )
    axes.plot(one.frames, one.error, "s", color=BLUE, label="error of all frames against the truth")
    axes.plot(MEASURED_FRAMES, MEASURED_PX, "*", color=GREY, markersize=12, label="paper's bench")
    logarithmic(axes)
    axes.set(xlabel="frames", title=f"{one.name}, {one.interfringe:.3g} px")
    top = axes.secondary_xaxis(
        "top",
        functions=(
            lambda n: np.asarray(n) * period_s / 60,
            lambda t: np.asarray(t) * 60 / period_s,
        ),
    )
    plain_ticks(top.xaxis)
    top.set_xlabel("minutes", fontsize=8.5)
    axes.legend(fontsize=8, framealpha=0.9, loc="lower left")
    finish(axes)
    axes.spines["top"].set_visible(True)


def make(lab: Lab) -> Outcome:
    """Simulate, fit, take the deviations and draw."""
    bench = lab.sized("figure-11", frames=QUICK_FRAMES)
    scene = lab.scene("figure-11", bench)
    found = measure(scene)
    frames, period = bench.frames.fringes[0].count, bench.frames.period_s
    at = float(np.mean([one.at(MEASURED_FRAMES) for one in found]))
    excess, period_px = MEASURED_PX / at, found[0].interfringe
    rows = [
        Row(f"slope, {one.name}", with_error(one.allan["slope"], one.allan["slope_err"]), "slope")
        for one in found
    ]
    knees = [one.allan["knee_frames"] for one in found]
    rise = "none" if not any(knees) else ", ".join(f"{number(k)} frames" for k in knees if k)
    rows += [
        Row("knee, where the deviation leaves the power law", rise, "rise"),
        Row(f"deviation of {number(MEASURED_FRAMES)} frames", f"{number(at)} px", "allan"),
        Row("deviation of the paper's bench over this simulation", number(excess), "gap"),
        Row(
            "error of all frames over the Cramér–Rao bound",
            ", ".join(f"{one.error / one.bound:.3f}" for one in found),
        ),
    ]
    lasts = frames * period
    return Outcome(
        figure="11",
        title="Allan deviations",
        run=f"Two sets of {number(frames)} frames of {bench.detector.shape[0]} × "
        f"{bench.detector.shape[1]} px, batches of {BATCH_FRAMES}: {number(lasts / 60)} minutes "
        "of the bench" + ("." if lab.full else ", where the paper has two hours."),
        caption="Allan deviation of the maps of batches (black), power law (red), bound (green). "
        "The star is the deviation of the paper's bench.",
        rows=tuple(rows),
        difference="The power law is the same. The paper's bench lies "
        f"{number(excess, 2)} times above a simulation with photon and read noise only, or "
        f"{number(excess * period_px / FINER_PX, 2)} times if its 10 000 frames refer to a period "
        f"of {FINER_PX:g} px. The paper's estimator explains far less than that (figure 9). Most "
        "of it is therefore in the bench, or in intensities that vary but are held constant. The "
        f"rise after {STABLE_S / 60:.0f} minutes is not simulated.",
        numbers={
            one.name: {
                "slope": one.allan["slope"],
                "slope_err": one.allan["slope_err"],
                "frames": one.allan["frames"],
                "adev_px": one.allan["adev_px"],
                "adev_err_px": one.allan["adev_err_px"],
                "white_expected_px": one.allan["white_expected_px"],
                "knee_frames": one.allan["knee_frames"],
                "error_px": one.error,
                "bound_px": one.bound,
                "at_10000_frames_px": one.at(MEASURED_FRAMES),
            }
            for one in found
        },
        picture=png(draw(found, period)),
    )
