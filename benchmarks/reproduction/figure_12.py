"""Figures 12 and 13: the saw teeth that crosstalk leaves in the maps, with noise and without."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from comparators import alternating
from comparators.measure import read_cube
from pixcal.effects import parse_effects
from pixcal.effects.ipc import Ipc
from pixcal.kernels.crosstalk import Coupling
from pixcal.report.colours import BLUE, GREY, INK, RED
from pixcal.report.drawing import WIDE, finish, new_figure, png, symmetric_scale
from pixcal.report.text import number
from reproduction.draw import THOUSANDTHS, image
from reproduction.lab import Lab, Scene, facts, nominal_vector, read_set
from reproduction.maps import teeth, without
from reproduction.outcome import Outcome, Row
from truth import PLANE

F64 = NDArray[np.float64]

QUICK_NOISY, QUICK_CLEAN = 4000, 500
CONVERGED = 20
"""Iterations after which teeth stand still, also where they resemble a harmonic of the fringes."""
SETS = ("horizontal", "vertical")
"""Horizontal fringes measure δy, vertical ones δx."""
OFFSET = {"horizontal": "δy", "vertical": "δx"}


def predicted_teeth(couplings: Sequence[Coupling], vector: tuple[float, float]) -> F64:
    """Apparent offset (row,) due to couplings in each row of their period, px, less its mean.

    The phase of a receiver moves by ``arg(sum_n k_n exp(i K n))``, n from the receiver to where
    its signal comes from (physics note, section 5). ``couplings`` do not depend on the column;
    ``vector``: fringe vector (kx, ky), rad/px.
    """
    if any(c.every_columns > 1 for c in couplings):
        raise ValueError("couplings depend on the column: teeth of rows are not all of it")
    period = period_of(couplings)
    shift = np.empty(period)
    for row in range(period):
        z = 1 + 0j
        for c in couplings:
            if (row - c.row) % c.every_rows == 0:
                z -= c.share
            if (row - c.dy - c.row) % c.every_rows == 0:
                z += c.share * np.exp(-1j * (vector[0] * c.dx + vector[1] * c.dy))
        shift[row] = np.angle(z) / np.hypot(*vector)
    return np.asarray(shift - shift.mean())


def period_of(couplings: Sequence[Coupling]) -> int:
    """Rows after which couplings repeat."""
    return int(np.lcm.reduce([c.every_rows for c in couplings]))


@dataclass(frozen=True)
class Teeth:
    """One set of one acquisition."""

    delta: F64  # (y, x) as fitted, px
    kernel: F64  # (row,) what the kernel feigns in the rows of a period, px
    # found, expected: (row,) mean error of these rows, and of the kernel's, each less the modes
    # that a fit leaves open
    found: F64
    expected: F64
    sigma: float  # error of the means, px
    rest: float  # rms of the errors that are neither teeth nor modes, px

    @property
    def height(self) -> float:
        """Peak to peak, px."""
        return float(np.ptp(self.found))

    @property
    def expected_height(self) -> float:
        """The same of the kernel."""
        return float(np.ptp(self.expected))


def couplings_of(scene: Scene) -> tuple[Coupling, ...]:
    """The couplings of a scene's bench; without crosstalk, of the default kernel at no strength."""
    for effect in parse_effects(scene.bench.effects, str(scene.folder)):
        if isinstance(effect, Ipc):
            return effect.couplings
    return Ipc().scaled(0.0).couplings


def by_paper(scene: Scene, name: str, iterations: int = CONVERGED) -> F64:
    """Offsets by the paper's iterations, A and B constant, px."""
    run = scene.reduced()
    cube, vector = read_cube(run, name), nominal_vector(run, name)
    psi = alternating.fit_phases(cube, vector, constant=True, iterations=iterations)
    return scene.truth(name).offsets(psi)


def by_pixcal(scene: Scene, name: str) -> F64:
    """Offsets of ``pixcal fit``, px."""
    return read_set(scene.fit(), name, "delta")[0]


def measure(scene: Scene, name: str, delta: F64, *, free: bool) -> Teeth:
    """Teeth of a map of offsets (y, x), px; ``free``: of a fit with A and B free."""
    truth, couplings = scene.truth(name), couplings_of(scene)
    period = period_of(couplings)
    kernel = predicted_teeth(couplings, truth.vector)
    modes = truth.modes(None if free else PLANE)
    found = teeth(without(delta - truth.delta, modes), period)
    pattern = np.broadcast_to(np.resize(kernel, len(delta))[:, None], delta.shape)
    expected = teeth(without(pattern, modes), period)
    inner = (slice(2, -2), slice(2, -2))
    rest = float(np.nanstd(truth.errors(delta - pattern)[inner]))
    pixels = np.isfinite(delta[inner]).sum() / period
    return Teeth(delta, kernel, found, expected, rest / float(np.sqrt(pixels)), rest)


Panels = list[tuple[str, dict[str, Teeth]]]


def draw(rows: Panels) -> Figure:
    """A row for each acquisition: maps of δy and δx, and their means along rows."""
    figure = new_figure(WIDE, 2.75 * len(rows))
    grid = figure.subplots(len(rows), 4, width_ratios=[1, 1, 0.8, 0.8], squeeze=False)
    for line, (title, found) in zip(grid, rows, strict=True):
        for axes, means, name in zip(line[:2], line[2:], SETS, strict=True):
            one = found[name]
            image(figure, axes, one.delta * 1e3, symmetric_scale(one.delta * 1e3), THOUSANDTHS)
            axes.set_title(OFFSET[name], fontsize=10)
            _profile(means, one, OFFSET[name])
        line[0].set_ylabel(f"{title}\ny (px)", fontsize=9)
    grid[-1][0].set_xlabel("x (px)")
    grid[-1][1].set_xlabel("x (px)")
    return figure


def _profile(axes: Axes, one: Teeth, label: str) -> None:
    rows = np.arange(len(one.delta))
    means = 1e3 * np.nanmean(one.delta, axis=1)
    axes.plot(means, rows, ".-", color=BLUE, markersize=3, linewidth=0.8)
    if np.any(one.kernel):
        axes.plot(1e3 * np.resize(one.kernel, len(rows)), rows, "+", color=RED, markersize=5)
    axes.axvline(0, color=GREY, linewidth=0.7)
    axes.set_title(f"mean {label} of rows ({THOUSANDTHS})", fontsize=9, color=INK)
    finish(axes)
    axes.tick_params(labelsize=8)


def make(lab: Lab) -> Outcome:
    """Simulate the three acquisitions, fit and draw."""
    noisy = lab.scene("figure-12", lab.sized("figure-12", frames=QUICK_NOISY))
    bench = lab.sized("figure-13", frames=QUICK_CLEAN)
    quiet = lab.scene("figure-13", bench)
    clean = lab.scene("figure-13-clean", replace(bench, effects={}))
    real = {name: measure(noisy, name, by_pixcal(noisy, name), free=True) for name in SETS}
    simulated = {name: measure(quiet, name, by_paper(quiet, name), free=False) for name in SETS}
    none = {name: measure(clean, name, by_paper(clean, name), free=False) for name in SETS}
    free = {name: measure(quiet, name, by_pixcal(quiet, name), free=True) for name in SETS}
    few = measure(quiet, SETS[0], by_paper(quiet, SETS[0], alternating.ITERATIONS), free=False)
    periods = [facts(s.fit(), SETS[0])["interfringe_px"] for s in (noisy, quiet)]
    panels: Panels = [
        (f"figure 12: {periods[0]:.2g} px, noise", real),
        (f"figure 13: {periods[1]:.2g} px", simulated),
        ("no crosstalk", none),
    ]
    worst = max(
        float(np.abs(one.found - one.expected).max())
        for group in (real, simulated)
        for one in group.values()
    )
    frames = noisy.bench.frames.fringes[0].count
    clean_frames = bench.frames.fringes[0].count
    sized = "" if lab.full else " (the paper: 10 000 with noise)"
    return Outcome(
        figure="12-13",
        title="Sawtooth by crosstalk",
        run=f"40 × 40 px; {number(frames)} frames of each direction with noise and a period of "
        f"{periods[0]:.2g} px; {number(clean_frames)} without noise and {periods[1]:.2g} px, with "
        f"and without crosstalk{sized}. The paper does not publish its kernel; this one has its "
        "size and kind.",
        caption="Maps of δy and δx and the means of their rows; red, the offsets arg(Σ kₙ "
        f"exp(iKn)) / K of the kernel. Upper row: pixcal. Others: {CONVERGED} of the paper's "
        "iterations with constant A and B.",
        rows=(
            Row("teeth of δy, figure 12, peak to peak", _height(real["horizontal"]), "teeth_y"),
            Row("teeth of δx, figure 12, peak to peak", _height(real["vertical"]), "teeth_x"),
            Row("teeth of δy, figure 13", _height(simulated["horizontal"]), "alike"),
            Row("teeth of δx, figure 13", _height(simulated["vertical"]), "alike"),
            Row(
                f"teeth of δy, figure 13, after {alternating.ITERATIONS} iterations",
                _height(few),
                "alike",
            ),
            Row("teeth against arg(Σ kₙ exp(iKn)) / K, worst row", f"{number(worst)} px", "kernel"),
            Row(
                "error without crosstalk, δy and δx",
                f"{number(none['horizontal'].rest)} and {number(none['vertical'].rest)} px",
                "clean",
            ),
            Row(
                f"teeth of δy at {periods[1]:.2g} px when A and B are free",
                _height(free["horizontal"]),
            ),
        ),
        difference="The teeth follow the closed form row by row. Without crosstalk the error is "
        "that of rounding to 16 bits, which the paper's 10⁻⁷ px do not contain. "
        f"At {periods[1]:.2g} px the second harmonic of horizontal fringes has the period of the "
        "kernel, four rows. A fit with free intensities then removes most of the teeth as a "
        "degenerate mode (last row). Constant intensities or another fringe period show them.",
        numbers={
            title: {
                OFFSET[name]: {
                    "teeth_px": one.found.tolist(),
                    "expected_px": one.expected.tolist(),
                    "kernel_px": one.kernel.tolist(),
                    "height_px": one.height,
                    "expected_height_px": one.expected_height,
                    "sigma_px": one.sigma,
                    "rest_px": one.rest,
                }
                for name, one in found.items()
            }
            for title, found in (
                ("figure_12", real),
                ("figure_13", simulated),
                ("no_crosstalk", none),
                ("figure_13_free_intensities", free),
            )
        },
        picture=png(draw(panels)),
    )


def _height(one: Teeth) -> str:
    height, expected = (number(100 * v) for v in (one.height, one.expected_height))
    return f"{height} % of a pixel, kernel {expected} %"
