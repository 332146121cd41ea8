"""Deviations of the light from two steady fibres."""

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import j0

from second_bench.effects.fringes import SLOW
from second_bench.effects.law import Drawn, law
from second_bench.model import F64, Beam, Bench


def _white(bench: Bench, size: float, rng: np.random.Generator, *, sources: int) -> None:
    """Light of the laser (1 source), or the coupling into each fibre (2), varies independently."""
    for run in bench.fringe_runs():
        light = 1 + size * rng.standard_normal((run.frames, sources))
        run.power = run.power * np.maximum(light, 0.1)


for _sources, _name in ((1, "laser"), (2, "fibres")):
    law("intensity_noise", _name, 3e-4, 0.03, "rms")(partial(_white, sources=_sources))


@law("intensity_noise", "flicker", 3e-4, 0.03, "rms")
def flicker(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """A laser with 1/f noise."""
    for run in bench.fringe_runs():
        spectrum = np.fft.rfft(rng.standard_normal(run.frames))
        spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))
        spectrum[0] = 0
        course = np.fft.irfft(spectrum, run.frames)
        run.power = run.power * np.maximum(1 + size * course / course.std(), 0.1)[:, None]


@law("contrast_noise", "vibration", 0.08, 0.7, "rad rms of the amplitude")
def vibration(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """Fringe vibration within an exposure reduces contrast by J0 of the amplitude."""
    for run in bench.fringe_runs():
        run.contrast = run.contrast * j0(size * np.abs(rng.standard_normal(run.frames)))


@law("contrast_noise", "polarisation", 0.002, 0.06, "of the contrast over a run")
def polarisation(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """The fibres slowly rotate the polarisation."""
    course = str(rng.choice(list(SLOW)))
    for run in bench.fringe_runs():
        run.contrast = run.contrast * (1 - size * SLOW[course](run.frames, rng))
    return {"course": course}


def _ghost(bench: Bench, beam: Beam, size: float, rng: np.random.Generator) -> tuple[Beam, Drawn]:
    """Image of a fibre's tip in a slightly wedged plate."""
    angle, aside = rng.uniform(0, 2 * np.pi), rng.uniform(0.7, 8)
    moved = np.array([aside * np.cos(angle), aside * np.sin(angle), -rng.uniform(0, 4)])
    image = replace(
        beam,
        tip_mm=beam.tip_mm + moved,
        aim_mm=beam.aim_mm + rng.normal(0, 3, 2),
        amplitude=beam.amplitude * size,
        delay_rad=float(rng.uniform(0, 2 * np.pi)),
    )
    period = bench.wavelength_nm * 1e-6 * bench.distance_mm / (aside * bench.pitch_um * 1e-3)
    return image, {"moved_mm": moved.tolist(), "period_px": float(period)}


def _reflected(bench: Bench, size: float, rng: np.random.Generator, *, fibre: int) -> Drawn:
    """A reflection of one fibre: the unmodulated one (0) or the modulated one (1)."""
    drawn = {}
    for one in bench.sets:
        image, drawn[one.name] = _ghost(bench, one.beams[fibre], size, rng)
        one.beams.append(image)
    return drawn


for _fibre, _name in enumerate(("first_fibre", "second_fibre")):
    law("ghost_fringes", _name, 8e-4, 0.02, "of the amplitude")(partial(_reflected, fibre=_fibre))


@law("ghost_fringes", "both", 8e-4, 0.02, "of the amplitude")
def both_fibres(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Reflections of both fibres in one plate, with equally displaced images."""
    drawn = {}
    for one in bench.sets:
        image, facts = _ghost(bench, one.beams[0], size, rng)
        moved = np.array(facts["moved_mm"])
        other = replace(
            one.beams[1],
            tip_mm=one.beams[1].tip_mm + moved,
            aim_mm=one.beams[1].aim_mm + image.aim_mm - one.beams[0].aim_mm,
            amplitude=one.beams[1].amplitude * size,
            delay_rad=image.delay_rad,
        )
        one.beams += [image, other]
        drawn[one.name] = facts
    return drawn


@law("ghost_fringes", "crossed", 2e-3, 0.05, "of the amplitude")
def crossed(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """A reflection of the second fibre, polarised orthogonally to the first: static fringes.

    The second fibre is polarised some 20 degrees away from the first, and so interferes with both.
    """
    drawn = {}
    for one in bench.sets:
        turn = float(np.deg2rad(rng.uniform(15, 28)))
        one.beams[1].jones = (np.cos(turn), np.sin(turn))
        image, facts = _ghost(bench, one.beams[1], size, rng)
        image.jones = (0.0, 1.0)
        one.beams.append(image)
        drawn[one.name] = facts | {"turned_rad": turn}
    return drawn


def _stray(bench: Bench, shape: F64) -> None:
    for one in bench.sets:
        one.stray = one.stray + shape


@law("straylight", "uniform", 0.01, 0.08, "of the mean", decidable=False)
def uniform(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """Uniform light, degenerate with a slightly lower coherence of the fibres."""
    _stray(bench, np.full(bench.shape, size))


@law("straylight", "slope", 0.01, 0.08, "of the mean", decidable=False)
def slope(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """A ramp from zero at one edge, nearly degenerate with the aims of the beams."""
    x, y = bench.grid()
    angle = float(rng.uniform(0, 2 * np.pi))
    along = np.cos(angle) * x / bench.shape[1] + np.sin(angle) * y / bench.shape[0]
    _stray(bench, size * (along - along.min()) / np.ptp(along) * 2)
    return {"angle_rad": angle}


@law("straylight", "bump", 0.004, 0.08, "of the mean, at the top")
def bump(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """One broad bump, as from a reflection of the lens mount."""
    x, y = bench.grid()
    ny, nx = bench.shape
    wide = float(rng.uniform(0.12, 0.35))
    centre = rng.uniform(-0.4, 0.4, 2)
    r2 = (x / nx - centre[0]) ** 2 + (y / ny - centre[1]) ** 2
    _stray(bench, size * np.exp(-r2 / (2 * wide**2)))
    return {"width_windows": wide, "centre_windows": centre.tolist()}
