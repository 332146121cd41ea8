"""Figure 10: parameters of a simulation with bias and response maps, and their errors."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pixcal.kernels.scene import fringe_light
from pixcal.report.colours import BAR, BLUE, INK
from pixcal.report.drawing import WIDE, finish, new_figure, png, span_scale, symmetric_scale
from pixcal.report.text import number
from pixcal.simulation.exposure import Camera
from pixcal.simulation.recording import recordings
from pixcal.stages.budget.information import phase_information
from reproduction.draw import THOUSANDTHS, image
from reproduction.lab import Lab, Scene, read_set
from reproduction.maps import Whiteness, plane, without
from reproduction.outcome import Outcome, Row

F64 = NDArray[np.float64]

QUICK_SIDE = 128


@dataclass(frozen=True)
class Estimates:
    """Maps (y, x) of a fit and their errors, and those of its frames."""

    # iota, alpha: (y, x) e-
    iota: F64
    alpha: F64
    delta: F64  # (y, x) px
    # iota_error, alpha_error: (y, x) relative, less the modes that free intensities leave open
    iota_error: F64
    alpha_error: F64
    # delta_error, sigma: (y, x) px; error less the modes, and what the fit says of it
    delta_error: F64
    sigma: F64
    phi: F64  # (t,) rad
    # phi_error, level_error: (t,) rad, and relative; less the modes that free intensities leave
    # open
    phi_error: F64
    level_error: F64
    response: float  # correlation of iota, less its smooth part, with the true response
    # bound, phi_bound: Cramér-Rao bounds of an offset, px, and of a frame's phase, rad
    bound: float
    phi_bound: float


def true_light(scene: Scene) -> tuple[F64, F64, F64]:
    """iota, alpha (e-) and psi (rad) of the first set, (y, x)."""
    bench = scene.bench
    rows = (0, bench.detector.shape[0])
    (recording,) = (r for r in recordings(bench) if r.kind == "fringes" and r.number == 0)
    maps = Camera(bench, rows).maps
    light = fringe_light(bench, 0, rows, maps, recording.electrons).collected(maps.response)
    return light.iota.astype(float), np.abs(light.phasor), np.angle(light.phasor)


def measure(scene: Scene) -> Estimates:
    """Fit the first set and compare everything with the truth."""
    name = scene.bench.frames.fringes[0].name
    run, truth, told = scene.fit(), scene.truth(name), scene.truth_of_sets()[name]
    iota, alpha, delta, sigma = read_set(run, name, "iota", "alpha", "delta", "sigma")
    level, phi = read_set(run, name, "B", "phi")
    true_iota, true_alpha, psi = true_light(scene)
    fringe = np.stack([np.cos(psi), np.sin(psi)])
    second = np.stack([np.cos(2 * psi), np.sin(2 * psi)])
    ones = np.ones((1, *iota.shape))
    rough = without(iota, plane(iota.shape))
    away = np.angle(np.exp(1j * (phi - np.array(told["phi"]))))
    away = np.angle(np.exp(1j * (away - np.angle(np.exp(1j * away).mean()))))
    level_away = level / level.mean() - np.array(told["B"]) / np.mean(told["B"])
    turns = np.stack([np.ones(len(phi)), *(f(n * phi) for n in (1, 2) for f in (np.cos, np.sin))])
    noise = scene.bench.detector.read_noise_e**2
    information = phase_information(true_iota, true_alpha, noise).sum()
    return Estimates(
        iota,
        alpha,
        delta,
        iota_error=without(iota / true_iota, np.concatenate([ones, fringe])),
        alpha_error=without(alpha / true_alpha, np.concatenate([ones, fringe, second])),
        delta_error=truth.errors(delta),
        sigma=sigma,
        phi=phi,
        phi_error=without(away[None], turns[:, None]).ravel(),
        level_error=without(level_away[None], turns[:3, None]).ravel(),
        response=float(
            np.corrcoef(rough.ravel(), without(true_iota, plane(iota.shape)).ravel())[0, 1]
        ),
        bound=truth.bound,
        phi_bound=float(information**-0.5),
    )


def draw(found: Estimates) -> Figure:
    """Estimates above, their errors below."""
    figure = new_figure(WIDE, 5.2)
    grid = figure.subplots(2, 4)
    maps = [
        ("ι", found.iota / 1e3, "ke⁻", found.iota_error * 1e3, "relative error (10⁻³)"),
        ("α", found.alpha / 1e3, "ke⁻", found.alpha_error * 1e3, "relative error (10⁻³)"),
        ("δx", found.delta * 1e3, THOUSANDTHS, found.delta_error * 1e3, f"error ({THOUSANDTHS})"),
    ]
    for (top, below), (name, values, unit, errors, error_unit) in zip(
        grid.T[:3], maps, strict=True
    ):
        scale = span_scale(values) if name != "δx" else symmetric_scale(values)
        image(figure, top, values, scale, unit)
        image(figure, below, errors, symmetric_scale(errors), error_unit)
        top.set_title(name)
    top, below = grid.T[3]
    top.plot(np.mod(found.phi, 2 * np.pi), ".", color=BLUE, markersize=2)
    top.set(title="φ(t)", xlabel="frame", ylabel="rad")
    pull = (found.delta_error / found.sigma).ravel()
    edges = np.linspace(-5, 5, 61)
    below.hist(pull, edges.tolist(), density=True, color=BAR)
    below.plot(edges, np.exp(-(edges**2) / 2) / np.sqrt(2 * np.pi), color=INK, linewidth=1)
    below.set(xlabel="error of δx / its sigma", ylabel="density")
    for axes in (top, below):
        finish(axes)
        axes.tick_params(labelsize=8)
    return figure


def make(lab: Lab) -> Outcome:
    """Simulate, fit and draw."""
    bench = lab.sized("figure-10", side=QUICK_SIDE)
    scene = lab.scene("figure-10", bench)
    found = measure(scene)
    white = Whiteness.of(found.delta_error)
    frames = bench.frames.fringes[0].count
    rms = float(np.sqrt(np.mean(found.delta_error**2)))
    pull = float(np.std(found.delta_error / found.sigma))
    photons = 1 / float(np.sqrt(frames * found.iota.mean()))
    numbers: dict[str, Any] = {
        "delta_error_px": rms,
        "bound_px": found.bound,
        "error_over_sigma": pull,
        "delta_mean_error_px": float(found.delta_error.mean()),
        "iota_error": float(found.iota_error.std()),
        "photon_error_of_iota": photons,
        "alpha_error": float(found.alpha_error.std()),
        "phi_error_rad": float(found.phi_error.std()),
        "phi_bound_rad": found.phi_bound,
        "level_error": float(found.level_error.std()),
        "response_correlation": found.response,
        "whiteness": asdict(white),
    }
    worst = max(map(abs, (white.neighbours_x, white.neighbours_y, white.rows, white.columns)))
    side = bench.detector.shape[0]
    return Outcome(
        figure="10",
        title="Parameters and their errors",
        run=f"{number(frames)} frames of {side} × {side} px, fringe period 5 px, with random bias "
        "and response maps. No flats, so the response stays in α and ι as in the paper.",
        caption="Above: fitted parameters. Below: errors without degenerate modes; right, the "
        "errors of δx over their sigma.",
        rows=(
            Row("error of δx over the Cramér–Rao bound", f"{rms / found.bound:.3f}", "systematics"),
            Row("error of δx over its own sigma", f"{pull:.3f}"),
            Row(
                "largest of four tests for patterns (neighbours, rows, columns)",
                f"{worst:.1f} standard deviations",
                "map",
            ),
            Row("p-value of the highest peak of its power spectrum", f"{white.peak:.2f}"),
            Row("correlation of ι with the true response", f"{found.response:.4f}", "response"),
            Row(
                "error of φ(t) over the Cramér–Rao bound",
                f"{numbers['phi_error_rad'] / found.phi_bound:.3f}",
            ),
            Row("error of B(t)", number(numbers["level_error"])),
        ),
        difference="None in the result. The paper holds A, B and the fringe vector constant from "
        "the second iteration on. Here they are free in every frame, and the degenerate modes are "
        "removed.",
        numbers=numbers,
        picture=png(draw(found)),
    )
