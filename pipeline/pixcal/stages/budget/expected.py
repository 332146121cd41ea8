"""Expected precision of a bench: frames for a given precision, and what limits it.

The Cramér-Rao bound (`phase_information`) on a grid of pixels spread over the window, for each
fringe set and for the combined sets. Systematic errors are not included.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil

import numpy as np
from scipy.optimize import minimize

from pixcal.effects import effects, parse_effects
from pixcal.estimators.fringe_fit.combine import axes_span_plane
from pixcal.kernels.optics import fringe_vector
from pixcal.kernels.scene import fibre_light, geometry
from pixcal.model.arrays import F64, I64
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect
from pixcal.simulation.exposure import states_of
from pixcal.simulation.recording import Recording
from pixcal.stages.budget.information import FrameSpread, phase_information, sampling_loss

Shares = Sequence[float] | F64

SAMPLES = 96  # pixels along each side of the grid: light changes little between them
# most frames of a ramp that are used: by then it repeats, or fills the cycle evenly
MAX_PHASES = 2000
FRAMES_DRAWN = 20_000  # to measure frame-to-frame changes of light and contrast
DARKNESS = 1e-12  # least information of one frame, 1/rad²


def sample_variance(bench: Bench) -> float:
    """Variance (e-²) of a sample without light: read noise, converter's step, dark current."""
    d = bench.detector
    dark = d.dark_e_s * bench.frames.exptime_s
    return d.read_noise_e**2 + d.gain_e_per_adu**2 / 12 + dark


def own_effects(bench: Bench, where: str) -> tuple[Effect, ...]:
    """Effects of a bench that pixcal knows, as read by `parse_effects`."""
    return parse_effects({n: v for n, v in bench.effects.items() if n in effects()}, where)


def frame_rms(bench: Bench, number: int) -> tuple[float, float]:
    """Relative frame-to-frame rms of light and of contrast, from the effects of a bench."""
    scan, f = replace(bench.frames.fringes[number], count=FRAMES_DRAWN), bench.frames
    sets = (*f.fringes[:number], scan, *f.fringes[number + 1 :])
    bench = replace(bench, frames=replace(f, fringes=sets))
    drawn = Recording(bench, "fringes", number, scan.count, f.exptime_s, 0.0, f.period_s)
    states = states_of(drawn, own_effects(bench, "bench"))
    contrast = states.amplitude / np.maximum(states.level, DARKNESS)
    return float(states.level.std()), float(contrast.std() / contrast.mean())


@dataclass(frozen=True)
class SetBound:
    """Bound of a fringe set on the grid of pixels."""

    iota: F64  # iota, alpha: (n,) mean and amplitude, e-
    alpha: F64
    kx: F64  # kx, ky: (n,) local fringe vector, rad/px
    ky: F64
    variance: float  # of a sample without light, e-²
    frames: FrameSpread
    # factor on frames by the choice of phases: at the median and worst fringe phase
    loss: tuple[float, float]

    @classmethod
    def of(cls, bench: Bench, number: int, contrast: float = 1.0) -> "SetBound":
        """For a set of a bench, by its number, with ``contrast`` times the bench's visibility."""
        scan, optics = bench.frames.fringes[number], bench.optics_of(number)
        x, y = grid(bench.detector.shape)
        a, b = (
            np.concatenate([fibre_light(bench, number, (row, row + 1))[fibre][:, x] for row in y])
            for fibre in (0, 1)
        )
        visibility = optics.visibility * contrast
        mean, swing = a + b, 2 * visibility * np.sqrt(a * b)
        brightest = float((mean + swing).max())
        if brightest == 0:
            raise InputError(
                f"set {scan.name!r}: no light falls on the window; see beam_radius_mm and pointing"
            )
        electrons = scan.peak_e / brightest
        kx, ky = fringe_vector(x[None, :], y[:, None], geometry(bench, number))
        spread = FrameSpread.normal(*frame_rms(bench, number), min(visibility, 1.0))
        iota, alpha = (electrons * mean).ravel(), (electrons * swing).ravel()
        bare = cls(iota, alpha, kx.ravel(), ky.ravel(), sample_variance(bench), spread, (1.0, 1.0))
        if scan.phase_law == "random":
            return bare
        phases = scan.phase_step_rad * np.arange(min(scan.count, MAX_PHASES), dtype=float)
        n = bare.typical
        return replace(bare, loss=sampling_loss(iota[n], alpha[n], bare.variance, phases))

    @property
    def typical(self) -> int:
        """Number of the pixel with the median of the light."""
        return int(np.argsort(self.iota)[len(self.iota) // 2])

    @cached_property
    def information(self) -> F64:
        """Information of one frame on each pixel's phase, 1/rad², at the median fringe phase."""
        per_pixel = phase_information(self.iota, self.alpha, self.variance, self.frames)
        # A pixel outside the beams has no information, but must get a finite number.
        return np.asarray(np.maximum(per_pixel, DARKNESS) / self.loss[0])

    @property
    def k(self) -> F64:
        """Length of the fringe vector, rad/px."""
        return np.hypot(self.kx, self.ky)

    @property
    def axis(self) -> tuple[float, float]:
        """Unit vector along which the set measures, at the typical pixel."""
        n = self.typical
        return float(self.kx[n] / self.k[n]), float(self.ky[n] / self.k[n])

    @property
    def interfringe(self) -> float:
        """Fringe period at the typical pixel, px."""
        return float(2 * np.pi / self.k[self.typical])

    @property
    def visibility(self) -> float:
        """Median over the window."""
        return float(np.median(self.alpha / self.iota))

    @property
    def per_frame(self) -> F64:
        """Variance of the offset along the set's axis from one frame, px²."""
        return np.asarray(1 / (self.information * self.k**2))

    def reach(self, frames: Shares) -> tuple[float, float]:
        """Variance (px²) of the median pixel, and of the worst pixel at the worst fringe phase."""
        variance = self.per_frame / sum(frames)
        return float(np.median(variance)), float(variance.max()) * self.loss[1] / self.loss[0]

    def shares(self) -> dict[str, float]:
        """Variance (px²) of one frame from ``photons`` alone, and the factors that increase it.

        Each factor is relative to the preceding ones.
        """
        peak = float((self.iota + self.alpha).max())
        bright = np.array([peak / 2])
        ideal = float(np.median(1 / (phase_information(bright, bright, 0.0) * self.k**2)))
        level = (self.iota + self.alpha) / 2
        steps = {
            "uneven_light": phase_information(level, level, 0.0),
            "visibility": phase_information(self.iota, self.alpha, 0.0, self.frames),
            "read_noise": phase_information(self.iota, self.alpha, self.variance, self.frames),
            "phases": self.information,
        }
        factors, before = {"photons": ideal}, ideal
        for name, information in steps.items():
            now = float(np.median(1 / (np.maximum(information, DARKNESS) * self.k**2)))
            factors[name] = now / before
            before = now
        return factors


def grid(shape: tuple[int, int]) -> list[I64]:
    """Columns and rows of a window at which the bound is evaluated, edges included."""
    return [
        np.unique(np.linspace(0, n - 1, min(n, SAMPLES)).round().astype(int)) for n in shape[::-1]
    ]


@dataclass(frozen=True)
class JoinedBound:
    """Fringe sets combined by weighted least squares."""

    sets: tuple[SetBound, ...]  # on the same grid

    @property
    def components(self) -> tuple[str, ...]:
        """Components that the combined sets give."""
        both = axes_span_plane([s.axis for s in self.sets])
        return ("delta_x", "delta_y") if both else ("delta_fringe",)

    def variance(self, frames: Shares, *, worst: bool = False) -> F64:
        """Variance (component, pixel), px², with given frames, or shares of one, of each set."""
        xx, xy, yy = np.zeros((3, len(self.sets[0].iota)))
        for n, s in zip(frames, self.sets, strict=True):
            weight = n * s.information / (s.loss[1] / s.loss[0] if worst else 1.0)
            xx, xy, yy = xx + weight * s.kx**2, xy + weight * s.kx * s.ky, yy + weight * s.ky**2
        if len(self.components) == 1:
            return np.asarray(1 / (xx + yy))[None]
        return np.stack([yy, xx]) / (xx * yy - xy**2)

    def median(self, frames: Shares) -> F64:
        """Variance (component,) of the median pixel, px²."""
        return np.asarray(np.median(self.variance(frames), axis=1))

    def reach(self, n: int) -> Callable[[Shares], tuple[float, float]]:
        """As `SetBound.reach`, for one component."""
        return lambda frames: (
            float(self.median(frames)[n]),
            float(self.variance(frames, worst=True)[n].max()),
        )

    def best_split(self) -> F64:
        """Shares of the sets' frames that minimise the variance of the worse component."""
        n = len(self.sets)
        if len(self.components) == 1 or n == 1:
            best = int(np.argmin([np.median(s.per_frame) for s in self.sets]))
            return np.asarray(np.eye(n)[best])
        scale = float(self.median(np.full(n, 1 / n)).max())
        # Minimise t subject to every component below t: smooth, unlike the maximum.
        split = minimize(
            lambda v: v[-1],
            [*np.full(n, 1 / n), 1.0],
            bounds=[(1e-4, 1.0)] * n + [(0.0, None)],
            constraints=[
                {"type": "eq", "fun": lambda v: v[:-1].sum() - 1},
                {"type": "ineq", "fun": lambda v: v[-1] - self.median(v[:-1]) / scale},
            ],
        ).x[:-1]
        return np.asarray(split / split.sum(), float)


def joined(bench: Bench, contrast: Sequence[float] | None = None) -> JoinedBound:
    """Bounds of all sets of a bench; ``contrast`` of each as in `SetBound.of`."""
    factors = contrast or [1.0] * len(bench.frames.fringes)
    return JoinedBound(tuple(SetBound.of(bench, n, c) for n, c in enumerate(factors)))


def planned_split(bench: Bench) -> F64:
    """Share of each set in the planned frames of the bench."""
    counts = np.array([s.count for s in bench.frames.fringes], float)
    return np.asarray(counts / counts.sum())


def frames_needed(variance: float, precision: float) -> int:
    """Frames that reduce a variance (px²) of one frame to the squared precision (px).

    InputError if no number of frames is enough.
    """
    if not variance < np.inf:
        raise InputError(
            "optics: the fringes have no contrast, so no number of frames is enough; raise "
            "visibility, or point both beams at the detector (pointing_a_mm, pointing_b_mm)"
        )
    return max(1, ceil(variance / precision**2))


def pixel_contrast(kx: float, ky: float) -> float:
    """Contrast of fringes (kx, ky), rad/px, averaged over a square, uniform pixel."""
    return float(np.sinc(kx / (2 * np.pi)) * np.sinc(ky / (2 * np.pi)))


def brightest_allowed(bench: Bench) -> float | None:
    """Largest signal allowed by full well and converter, e-; None without a limit."""
    d = bench.detector
    converter = (d.top_adu - d.bias_adu) * d.gain_e_per_adu
    return converter if d.full_well_e is None else min(d.full_well_e, converter)
