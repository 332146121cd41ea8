"""A conversion gain that is not the one that samples were turned into electrons with."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.detector.flat_ladder import ladder_response
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack
from pixcal.kernels.noise_sums import product_sums
from pixcal.kernels.scene import DetectorMaps, Rows
from pixcal.model.bench import Bench
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

STEPS = np.array([(0, 0), (0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0)])
"""Rows and columns from a pixel to itself and to those that it may share its noise with."""
FLOOR = 5e-3
"""Error of a share of the variance that is left however many samples there are: no owner knows the
gain of a detector better than this, and amplifiers differ by as much."""

_CLIP = 6.0
_DISAGREE = 4.0
_MIN_PIXELS = 200
_MIN_FRAMES = 8
_MIN_LEVELS = 3
_CURVED = 3.0
_ALIKE = 1e4
_READ_KNOWN = 0.3
"""Relative error of the read noise's variance as it was used."""


@dataclass(frozen=True)
class GainError(Effect):
    """True gain (electrons per ADU) over the one used, less one; samples in ADU stay as they are.

    Light and dark signal are as many ADU as before, which are other numbers of electrons: their
    shot noise in ADU changes by ``1 / sqrt(1 + relative)``, and nothing else does. Read noise is
    known in ADU. Maps of a fit keep their offsets, so maps alone do not tell of it and there is
    nothing to undo on them: SIGMA is mended by the right gain.
    """

    name = "gain_error"
    title = "gain that is not the one declared"
    acts_at = Stage.CONVERTER
    domains = ("noise", "intensity")
    strengths = ("relative",)
    left_because = (
        "only SIGMA is wrong: correct gain_e_per_adu in acquisition.yaml, or use 'pixcal "
        "reduce --gain measured', and fit again"
    )
    frames_needed = ("flat",)
    sources = (
        "Janesick 2007, Photon Transfer (SPIE PM170): gain by photon transfer, to about 1 % with "
        "some ten thousand pixels",
        "Moore, Ninkov & Forrest 2006, Opt. Eng. 45, 076402: crosstalk that the noise of single "
        "pixels does not tell makes the gain wrong by per cents",
        "EMVA Standard 1288, release 4.0 (2021): system gain from variance against mean, "
        "of the camera's operating point and temperature",
    )

    relative: float = quantity(
        0.03, low=-0.9, high=9.0, doc="true gain over the one used, less one; shot noise in ADU "
        "has a variance smaller by as much"
    )  # fmt: skip

    def detector(self, maps: DetectorMaps, bench: Bench, rows: Rows) -> DetectorMaps:
        """As in `Effect.detector`."""
        return replace(maps, dark_rate=maps.dark_rate * np.float32(1 + self.relative))

    def photons(self, mean: F32, shot: Shot) -> F32:
        """As in `Effect.photons`."""
        return mean * np.float32(1 + self.relative)

    def signal(self, signal: F32, shot: Shot) -> F32:
        """As in `Effect.signal`."""
        return signal / np.float32(1 + self.relative)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """What the noise that grows with the level is of that expected, in fringes and in flats.

        Noise that neighbours share counts with that of the pixels themselves: crosstalk and
        brighter-fatter move it from one to the other and leave the sum, as far as `STEPS` reach
        (noise of single pixels alone is lower by the sum of the kernel's squares; the diagnosis
        allows for the rest by simulation). Noise that is the same at all levels is left out. In the
        fringes anything that the fit cannot follow adds to it, so flats are believed alone where
        the two do not agree.
        """
        ways = {
            "fringes": _shot_share(
                s for f in evidence.fringes.values() if (s := _of_fringes(f)) is not None
            ),
            "flats": shot_share_of_flats(evidence),
        }
        found = {name: way for name, way in ways.items() if way is not None}
        if not found:
            return None
        details = {f"of_{n}": 1 / share - 1 for n, (share, _) in found.items()}
        details |= {f"of_{n}_error": error / share**2 for n, (share, error) in found.items()}
        share, error = _joined(found)
        relative, error = 1 / share - 1, error / share**2
        return Estimate(
            cls(float(np.clip(relative, -0.9, 9.0))),
            {"relative": float(error)},
            float(abs(relative) / error),
            f"noise that grows with the level in the {' and the '.join(found)} is "
            f"{share:.3f} times that of the gain used",
            details,
        )


def shot_share_of_flats(evidence: Evidence) -> tuple[float, float] | None:
    """Noise that grows with the level in flats over that expected; None without samples.

    A response that is not linear changes the noise in proportion to the level, and a wrong gain
    changes it by one factor: the former is taken out as the levels show it or, where the lamp was
    changed between them, by the noise at level zero.
    """
    pooled = _shot_share(_of_stacks(evidence))
    curve = transfer_curve(evidence)
    if pooled is None or curve is None:
        return pooled
    response = ladder_response(evidence, curve.top)
    if response is None:
        curved = abs(curve.slope) > _CURVED * curve.slope_error
        return (curve.share, curve.error) if curved else pooled
    (quadratic, cubic), _ = response
    u = curve.levels / curve.top
    rise = 1 + u * (2 * quadratic + 3 * u * cubic)
    weight = curve.errors**-2
    straight = curve.shares * (1 + u * (quadratic + u * cubic)) / rise**2
    return float(np.average(straight, weights=weight)), float(weight.sum() ** -0.5)


@dataclass(frozen=True)
class TransferCurve:
    """Photon transfer of flats over that of the gain used, as a line over the level.

    Attributes
    ----------
    share, error : float
        At level zero.
    slope, slope_error : float
        Change up to the top.
    top : float
        Highest level, e-.
    levels, shares, errors : (n,) float64
        Of each level (e-).
    """

    share: float
    error: float
    slope: float
    slope_error: float
    top: float
    levels: F64
    shares: F64
    errors: F64


def transfer_curve(evidence: Evidence) -> TransferCurve | None:
    """Photon transfer of each level of flats; None with fewer than three levels.

    Noise that neighbours share counts with that of the pixels themselves, as in `GainError`.
    """
    return evidence.once("transfer curve", make=lambda: _transfer_curve(evidence))


def _transfer_curve(evidence: Evidence) -> TransferCurve | None:
    darks = [
        s for stack in evidence.stacks
        if stack.kind != "flat" and _is_enough(stack)
        and (s := _of_stack(stack, evidence)) is not None
    ]  # fmt: skip
    points = []
    for stack in filter(_is_enough, evidence.ladder):
        sums = _of_stack(stack, evidence)
        share = None if sums is None else _shot_share([sums, *darks])
        level = float((stack.adu.mean(axis=0) - evidence.bias)[evidence.good].mean())
        if share is not None and level > 0:
            points.append((level * evidence.gain, *share))
    if len(points) < _MIN_LEVELS:
        return None
    level, share, error = np.array(points).T
    top = float(level.max())
    design = np.stack([np.ones_like(level), level / top]) / error
    normal = design @ design.T
    if np.linalg.cond(normal) > _ALIKE:
        return None
    covariance = np.linalg.inv(normal)
    found = covariance @ (design @ (share / error))
    errors = np.sqrt(np.diag(covariance))
    at_zero, rise = zip(found.tolist(), errors.tolist(), strict=True)
    return TransferCurve(*at_zero, *rise, top, level, share, error)


def _joined(found: dict[str, tuple[float, float]]) -> tuple[float, float]:
    """Share and error of all ways; of the flats alone where fringes have another one."""
    shares, errors = np.array(list(found.values())).T
    if len(found) == 2 and abs(shares[0] - shares[1]) > _DISAGREE * np.hypot(*errors):
        found = {"flats": found["flats"]}
        shares, errors = np.array(list(found.values())).T
    weight = 1 / errors**2
    return float((weight * shares).sum() / weight.sum()), float(weight.sum() ** -0.5)


def _shot_share(sums: Iterable[F64]) -> tuple[float, float] | None:
    """Noise that grows with the level over that expected, with its error; None without samples."""
    total = sum(sums, np.zeros((len(STEPS), 7)))
    if not total[0, 0]:
        return None
    share = variance = 0.0
    for number, (n, s11, s12, s22, p1, p2, square) in enumerate(total):
        own = number == 0
        normal, right = np.array([[s11, s12], [s12, s22]]), np.array([p1, p2])
        scatter = square / n - own
        known = scatter / _READ_KNOWN**2
        normal[1, 1] += known
        right[1] += known * own
        inverse = np.linalg.inv(normal)
        times = 1 if own else 2
        share += times * (inverse @ right)[0]
        variance += times**2 * scatter * inverse[0, 0]
    if share <= 0.1 or not np.isfinite(variance):
        return None
    return float(share), float(np.sqrt(variance + FLOOR**2))


def _of_fringes(found: FringeEvidence) -> F64 | None:
    """Sums of `product_sums` of a fringe set's residuals; None of too few."""
    pixels = np.count_nonzero(found.good)
    if len(found.g) < _MIN_FRAMES or pixels < _MIN_PIXELS:
        return None
    b, c, s = found.g.T.astype(np.float32)
    of_time = np.stack([b * b, 2 * b * c, 2 * b * s, c * c, 2 * c * s, s * s], axis=1)
    shape = found.good.shape
    weight = (1 / found.variance).reshape(len(b), -1)
    weight[~np.isfinite(found.electrons.reshape(len(b), -1))] = 0
    sums = of_time.T @ weight / np.array([1, 2, 2, 1, 2, 1], np.float32)[:, None]
    n00, n01, n02, n11, n12, n22 = sums.astype(float)
    normal = np.stack([[n00, n01, n02], [n01, n11, n12], [n02, n12, n22]]).transpose(2, 0, 1)
    good = found.good.ravel() & (np.linalg.det(normal / normal[:, :1, :1]) > 1e-6)
    normal[~good] = np.eye(3)
    inverse = np.linalg.inv(normal)
    of_pixels = inverse[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)].T
    # (B, A cos phi, A sin phi) of every frame, and the fringe vector where it is free: what they
    # take from the residuals is alike in neighbours as far as the pattern is.
    alike = np.cos(STEPS @ np.array([found.k[1], found.k[0]]))
    taken = (1 + (4 if np.any(found.dk) else 2) * alike) / pixels
    return _sums(
        found.residual, found.model, found.shot_factor, found.read_variance,
        good.reshape(shape), of_time, of_pixels.reshape(6, *shape), taken,
    )  # fmt: skip


def _of_stacks(evidence: Evidence) -> Iterable[F64]:
    """The same of flats, and of frames without light, which tell the noise at no level."""
    if any(s.kind == "flat" and _is_enough(s) for s in evidence.stacks):
        for stack in filter(_is_enough, evidence.stacks):
            sums = _of_stack(stack, evidence)
            if sums is not None:
                yield sums


def _is_enough(stack: Stack) -> bool:
    return len(stack.adu) >= 2


def _of_stack(stack: Stack, evidence: Evidence) -> F64 | None:
    good = evidence.good & (stack.adu < evidence.saturation_adu).all(axis=0)
    pixels = np.count_nonzero(good)
    if pixels < _MIN_PIXELS:
        return None
    frames = (stack.adu - evidence.bias.astype(np.float32)) * np.float32(evidence.gain)
    level = frames.mean(axis=0)
    noise = np.maximum(level, 0) + np.float32(evidence.read_noise**2)
    # What a frame has more: of light, or of bias.
    pattern = np.where(good, level if stack.kind == "flat" else 1, 0).astype(np.float32)
    more = (frames - level) * (pattern / noise)
    change = more[:, good].sum(axis=1) / (pattern**2 / noise).sum()
    model = level + change[:, None, None] * pattern
    ones = np.ones(level.shape)
    return _sums(
        frames - model, model, ones, evidence.read_noise**2 * ones, good,
        np.ones((len(frames), 1)), (noise / len(frames))[None], np.full(len(STEPS), 1 / pixels),
    )  # fmt: skip


def _sums(
    rest: F32, model: F32, shot_factor: F64, read: F64,
    good: NDArray[np.bool_], of_time: NDArray[np.floating], of_pixels: NDArray[np.floating],
    taken: F64,
) -> F64:  # fmt: skip
    single = (np.ascontiguousarray(a, np.float32) for a in (rest, model, shot_factor, read))
    return np.asarray(
        product_sums(
            *single, np.ascontiguousarray(good),
            np.ascontiguousarray(of_time, np.float32), np.ascontiguousarray(of_pixels, np.float32),
            STEPS, taken.astype(np.float32), _CLIP,
        )
    )  # fmt: skip
