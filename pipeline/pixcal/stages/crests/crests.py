"""Crests and valleys of the fringes (paper, section 6, equation 6), found in noisy frames.

Where the phase of the fringes is k pi they have a crest (k even) or a valley (k odd). The phase is
measured in windows a few fringes wide and a segment long, apart from the background and from slopes
of the contrast; a path's point is where it crosses k pi. Windows share no pixel, so the errors of
their points are independent. A first pass over one frame, with a straight carrier, gives a
polynomial that numbers the fringes; the second, over every frame, uses it as a carrier and divides
by the smooth illumination.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.fringe_fit.fringes import find_fringe_vector
from pixcal.kernels.optics import interfringe
from pixcal.model.arrays import F64, I64, Mask
from pixcal.model.errors import InputError
from pixcal.stages.crests.windows import (
    FRINGES_A_WINDOW,
    CrestCarrier,
    Vector,
    Windows,
    solve_windows,
)

MAX_SIGMA = 0.2  # phase error (rad) above which a window counts as without fringes
MIN_COVERAGE = 0.5  # least share of a window's pixels that exist and are good
MIN_POINTS = 12  # fewest windows with fringes: as many again as the geometry has parameters
# relative distance from the nominal vector above which a peak is due to the beam, not the fringes
MAX_DEVIATION = 0.5
SEED_PIXELS = 256  # side of the patch where the fringe vector is first sought
# passes over the first frame: curvature left by the second moves points by some 1e-6 rad
SETTLING = 2

# (number of a frame, windows, carrier) -> sums (across, along, N_SUMS) of the whole frame
Accumulate = Callable[[int, Windows, CrestCarrier], F64]


@dataclass(frozen=True)
class CrestPaths:
    """Points on crests (k even) and valleys (k odd)."""

    x: F64  # x, y: (point,) r_jk, pixel coordinates
    y: F64
    k: I64  # (point,) number of the path, consistent over the frame; grows along the fringe vector
    sigma: F64  # (point,) 1-sigma error of the phase there, rad, from the scatter of the samples
    slope: F64  # (point,) length of the local fringe vector, rad/px
    # (frame,) phase of each frame relative to the first, rad; NaN where a frame has no fringes
    phi: F64
    vector: Vector  # fringe vector (kx, ky) at the frame's centre, rad/px
    frame: tuple[int, int]  # (y, x) size
    segment: float  # length of the windows along the fringes, px

    def __len__(self) -> int:
        return len(self.x)

    @property
    def interfringe(self) -> float:
        """At the frame's centre, px."""
        return interfringe(self.vector)

    @property
    def sigma_px(self) -> F64:
        """Errors of the points across their path, px."""
        return self.sigma / self.slope

    @property
    def reference(self) -> Vector:
        """(y, x) of the frame's centre, px."""
        return (self.frame[0] - 1) / 2, (self.frame[1] - 1) / 2

    def take(self, use: NDArray[Any]) -> "CrestPaths":
        """The points that a mask or indices select."""
        some = {n: getattr(self, n)[use] for n in ("x", "y", "k", "sigma", "slope")}
        return replace(self, **some)

    def outermost(self, paths: int) -> "CrestPaths":
        """The outermost paths at each end, the most informative ones (paper, figure 16)."""
        every = np.unique(self.k)
        return self.take(np.isin(self.k, [*every[:paths], *every[-paths:]]))


def seed_vector(patch: NDArray[Any], good: Mask, nominal: Vector) -> Vector:
    """Fringe vector (kx, ky), rad/px, of a patch (y, x) of a frame; its sign is nominal."""
    if good.sum() < MIN_POINTS**2:
        raise InputError(
            "no fringes found: too few good samples in the centre of the frame; see its mask"
        )
    level = float(patch[good].mean())
    if not level > 0:
        raise InputError("no fringes found: the frame is dark; check which files the set lists")
    maps = np.where(good, patch, level).astype(np.float64)[None] / level - 1
    k = find_fringe_vector(maps, good, nominal)
    if np.hypot(k[0] - nominal[0], k[1] - nominal[1]) > MAX_DEVIATION * np.hypot(*nominal):
        measured, expected = interfringe(k), interfringe(nominal)
        raise InputError(
            f"no fringes found near the nominal ones: the strongest period is {measured:.1f} px, "
            f"at {np.degrees(np.arctan2(k[1], k[0])):.0f} degrees from x, where baseline_mm gives "
            f"{expected:.1f} px at {np.degrees(np.arctan2(nominal[1], nominal[0])):.0f} degrees; "
            "correct it"
        )
    return k


def find_crests(
    accumulate: Accumulate,
    n_frames: int,
    frame: tuple[int, int],
    k: Vector,
    segment: int | None = None,
) -> CrestPaths:
    """Crests and valleys, from frames that are read one by one.

    ``accumulate``: makes the sums of a frame; called twice more for the first. ``frame``: (y, x)
    size. ``k``: near its centre, rad/px. ``segment``: pixels along the fringes that share a point.
    Raises InputError if there are too few fringes, or too few windows show them.
    """
    carrier, windows, vector = _from_first_frame(accumulate, frame, k, segment)
    phi = np.full(n_frames, np.nan)
    total, weight = np.zeros(windows.shape), np.zeros(windows.shape)
    for n in range(n_frames):
        phase, sigma, _ = _window_phases(accumulate(n, windows, carrier), windows)
        precision = sigma**-2.0
        if not precision.any():
            continue
        phi[n] = np.angle((precision * np.exp(1j * phase)).sum())
        residual = _wrapped(phase - phi[n])
        # More than a radian from the carrier is beyond the reach of the polynomial.
        precision[np.abs(residual) > 1] = 0
        total += precision * residual
        weight += precision
    use = weight > 0
    _check(use)
    # A column of windows follows one path as long as that path runs through its windows.
    start = np.nan_to_num(phi[0])
    rest = np.where(use, total / np.where(use, weight, 1.0), 0.0) + start
    y, x = windows.centres
    here = carrier.at(y, x) + rest
    column = [np.median(p[u]) if u.any() else 0.0 for p, u in zip(here, use, strict=True)]
    number = np.broadcast_to(np.rint(np.array(column) / np.pi)[:, None], here.shape)
    near = np.abs(here - number * np.pi) < np.pi * FRINGES_A_WINDOW / 2
    number = np.where(near, number, np.rint(here / np.pi))[use]
    y, x, rest = y[use], x[use], rest[use]
    for _ in range(4):
        gx, gy = carrier.vector(y, x)
        step = (number * np.pi - carrier.at(y, x) - rest) / (gx**2 + gy**2)
        y, x = y + step * gy, x + step * gx
    return CrestPaths(
        x,
        y,
        number.astype(np.int64),
        weight[use] ** -0.5,
        np.hypot(*carrier.vector(y, x)),
        phi - start,
        vector,
        frame,
        windows.size[1],
    )


def _from_first_frame(
    accumulate: Accumulate, frame: tuple[int, int], k: Vector, segment: int | None
) -> tuple[CrestCarrier, Windows, Vector]:
    """Carrier that follows the first frame, windows along it, and its vector at the centre."""
    carrier, windows, vector = CrestCarrier.straight(k, frame), Windows.lay(frame, k, segment), k
    for _ in range(SETTLING):
        phase, sigma, light = _window_phases(accumulate(0, windows, carrier), windows)
        _check(np.isfinite(sigma))
        followed = _follow(windows, phase, sigma, carrier)
        # Logarithm of the previous illumination times the light of the windows with fringes.
        use = np.isfinite(sigma) & (light > 0)
        y, x = carrier.scaled(*(c[use] for c in windows.centres))
        basis, powers = _design(y, x, _highest_degree(windows, len(y)))
        fit = np.linalg.lstsq(basis, np.log(light[use]), rcond=1e-12)[0]
        carrier = replace(carrier, phase=followed, light=_plus(carrier.light, powers, fit))
        kx, ky = carrier.vector(*np.array(carrier.centre))
        vector = float(kx), float(ky)
        windows = Windows.lay(frame, vector, segment)
    return carrier, windows, vector


def _check(use: Mask) -> None:
    if use.sum() < MIN_POINTS:
        raise InputError(
            f"fringes found in only {use.sum()} of {use.size} windows, at least {MIN_POINTS} are "
            f"needed; give a shorter --segment, or more --frames"
        )


def _wrapped(phase: F64) -> F64:
    return np.asarray(np.remainder(phase + np.pi, 2 * np.pi) - np.pi)


def _window_phases(sums: F64, windows: Windows) -> tuple[F64, F64, F64]:
    """Phases relative to the carrier, errors (infinite if unusable), light: (across, along)."""
    phase, sigma, light = (np.stack(part) for part in zip(*map(solve_windows, sums), strict=True))
    y, x = windows.centres
    inside = (y > -0.5) & (y < windows.frame[0] - 0.5) & (x > -0.5) & (x < windows.frame[1] - 0.5)
    enough = sums[..., -1] >= MIN_COVERAGE * windows.size[0] * windows.size[1]
    return phase, np.where(inside & enough & (sigma < MAX_SIGMA), sigma, np.inf), light


def _design(y: F64, x: F64, degree: int) -> tuple[F64, list[tuple[int, int]]]:
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.stack([y**i * x**j for i, j in powers], axis=1), powers


def _plus(before: F64, powers: list[tuple[int, int]], values: NDArray[Any]) -> F64:
    """A polynomial (n, n) with terms added to it."""
    size = max(powers[-1][0] + 1, len(before))
    total = np.zeros((size, size))
    total[: len(before), : len(before)] = before
    np.add.at(total, tuple(np.transpose(powers)), values)
    return total


def _highest_degree(windows: Windows, number: int) -> int:
    """Of a polynomial that the windows determine."""
    degree = min(5, max(1, min(windows.shape) - 1))
    while degree > 1 and 0.75 * (degree + 1) * (degree + 2) > number:
        degree -= 1
    return degree


def _follow(windows: Windows, phase: F64, sigma: F64, carrier: CrestCarrier) -> F64:
    """Polynomial through the phases of the windows, numbered outwards from the middle."""
    # Each time the known region grows by a third, the polynomial through it fixes the cycle of the
    # phases beyond: gaps are bridged, and single bad windows have no effect.
    use = np.isfinite(sigma)
    y, x = carrier.scaled(*(c[use] for c in windows.centres))
    measured, precision = phase[use], 1 / sigma[use]
    distance = np.hypot(y, x)
    highest = _highest_degree(windows, len(measured))
    reach = float(np.sort(distance)[MIN_POINTS - 1])
    nearest = np.argsort(distance)[:4]
    known = np.full(len(measured), float(np.angle(np.exp(1j * measured[nearest]).sum())))
    while True:
        near = distance <= reach
        number = int(near.sum())
        degree = min(highest, 1 if number < 40 else 2 if number < 150 else 3)
        basis, powers = _design(y, x, highest if near.all() else degree)
        for _ in range(3):
            off = _wrapped(measured - known)
            kept = near & (np.abs(off) <= max(1.0, 6 * float(np.median(np.abs(off[near])))))
            scaled = basis[kept] * precision[kept, None]
            value = (known + off)[kept] * precision[kept]
            fit = np.linalg.lstsq(scaled, value, rcond=1e-12)[0]
            known = basis @ fit
        if near.all():
            return _plus(carrier.phase, powers, fit)
        reach *= 1.33
