"""Charge that stays behind in the pixel and comes out with later frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import minimize_scalar

from pixcal.estimators.detector.flat_ladder import FLICKER_KNOWN, flicker
from pixcal.estimators.detector.noiseless_charge import missing_noise
from pixcal.estimators.detector.traps import BANDS, LossFit, in_bands
from pixcal.estimators.diagnosis.distortions import Freedom
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack
from pixcal.estimators.diagnosis.middle import MOST, middle
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.kernels.scene import TILE, Rows, chip_map
from pixcal.kernels.significance import sigmas_of_best
from pixcal.kernels.transfer import fill_traps, left_behind
from pixcal.model.arrays import F32, F64
from pixcal.model.bench import SimulatedDetector
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

TAIL = 1e-3  # share of the charge left behind whose release is brought forward to the last frame
LAGS = 6  # frames back that are looked at
# of the phase that pixels are free to have, so that a bent response is not taken for lag
HARMONICS = 5
CONTROLS = 8  # frames after a frame that are compared with the one before it
_MAX_DECAY = 3.0
_CLIP = 5.0
_MIN_FRAMES = 20
_SERIES = 8
_STEADIEST = 1e-4
_ROUNDS = 2
_CLEAR = 4.0
# chi-squares from which releases, or the level, are taken as they come
_NOT_EXPONENTIAL, _NOT_EVEN = 40.0, 25.0
_TURNS = 3  # of the inverse: each gains a factor of the share
# trials for traps that fill up: what they keep from frame to frame, and hold at most, over what
# they would take of full scale
_KEEPS, _ROOMS = (0.3, 0.6), (0.1, 0.2, 0.4, 0.7)
_STEPS = 12  # of all parameters of such traps


@dataclass(frozen=True)
class Lag(Effect):
    """Part of the charge of a frame appears in later frames.

    It comes out with the next frame, or over several. No charge is lost, and before the first frame
    of a recording the pixels were dark and empty. A barrier may hold back another share of each
    band of the level; traps take charge as long as they have room (`capacity_e`), so that what they
    hold of earlier frames limits what they take.

    A fit of the fringes takes up what all pixels have in common: the frame before is a sum of the
    same maps, so every frame only gets another amplitude and phase. So maps show nothing of it;
    `restored` undoes it on frames.
    """

    name = "lag"
    title = "charge left behind in the next frames"
    acts_at = Stage.CHARGE
    order = 3
    domains = ("time", "intensity")
    strengths = ("share",)
    absorbed_because = (
        "the fit absorbs a uniform lag; its variation moves phases by hundredths of the bound"
    )
    optional_parameters = ("decay_frames", "spread", "quiet")
    frames_needed = ("random",)
    quick = False
    sources = (
        "Bonjour, Blanc and Kayal 2012, IEEE Electron Device Letters 33(12), 1735: lag of pinned "
        "photodiodes by barriers, pockets and traps of the transfer gate",
        "Fossum and Hondongwa 2014, IEEE J. Electron Devices Soc. 2(3), 33: review of the pinned "
        "photodiode; lag of a few per mille and below",
    )

    share: float = quantity(
        0.002, low=0, high=0.5, doc="share of the charge of a frame that appears in later frames"
    )
    decay_frames: float = quantity(
        0.0,
        unit="frames",
        low=0,
        high=_MAX_DECAY,
        doc="frames in which the release falls by a factor e; 0: all in the next frame",
    )
    spread: float = quantity(
        0.1, low=0, high=1, doc="relative rms of the share from pixel to pixel"
    )

    bands: tuple[float, ...] = quantity(
        (), low=0, high=100, doc="factors of the share at signals from 0, 1/8, 1/4 and 1/2 of "
        "level_e on; empty: the same share at all signals"
    )  # fmt: skip
    level_e: float = quantity(
        50_000.0, unit="e-", above=0, high=1e7, doc="signal that bands refers to"
    )
    later: tuple[float, ...] = quantity(
        (), low=0, high=1, doc="parts of the lagging charge that appear 1, 2, ... frames later; "
        "empty: an exponential decay over decay_frames"
    )  # fmt: skip
    quiet: float = quantity(
        0.0, low=0, high=1, doc="part of the released charge without shot noise of its own"
    )
    capacity_e: float = quantity(
        0.0, unit="e-", low=0, high=1e7, doc="largest charge that a pixel holds back, released "
        "over decay_frames; 0: no limit"
    )  # fmt: skip

    @property
    def releases(self) -> F64:
        """Share of what stayed behind that comes out 1, 2, ... frames later; their sum is one."""
        if sum(self.later) > 0 and not self.capacity_e:
            return np.array(self.later) / sum(self.later)
        if not self.decay_frames:
            return np.ones(1)
        keep = self._keep
        count = int(np.ceil(np.log(TAIL) / np.log(keep)))
        releases = (1 - keep) * keep ** np.arange(count, dtype=float)
        return np.asarray(releases / releases.sum())

    @property
    def frames_back(self) -> int:
        return len(self.releases)

    @property
    def _keep(self) -> float:
        """Part of what is held that stays for another frame."""
        return float(np.exp(-1 / self.decay_frames)) if self.decay_frames else 0.0

    def charge(self, charge: F32, shot: Shot) -> F32:
        if self.capacity_e:
            return self._with_traps(charge, shot)
        found = charge - self._left_behind(charge, shot, shot.frame)
        for back, release in enumerate(self.releases, start=1):
            before = shot.charge(shot.frame - back)
            if before is None:
                break
            stayed = self._left_behind(before, shot, shot.frame - back, 1 - self.quiet)
            found += np.float32(release) * stayed
        return found

    def _with_traps(self, charge: F32, shot: Shot) -> F32:
        """A frame without what traps take of it, and with what they give back of earlier ones."""
        scale = _shares(self, shot.bench.detector, shot.rows) / np.float32(self.share)
        held = np.zeros_like(charge)
        for back in range(self.frames_back, 0, -1):
            before = shot.charge(shot.frame - back)
            if before is not None:
                held = self._held(held, before, scale, shot, shot.frame - back, 1 - self.quiet)
        return np.asarray(charge + held - self._held(held, charge, scale, shot, shot.frame))

    def _held(
        self, held: F32, charge: F32, scale: F32, shot: Shot, frame: int, noisy: float = 1.0
    ) -> F32:
        """What traps hold after a frame, e-: each electron is caught by its own chance."""
        taken = scale * self._left(np.maximum(charge, 0))
        if shot.bench.shot_noise and noisy > 0:
            taken += np.sqrt(np.float32(noisy) * taken) * shot.normals(self.name, frame)
        full = np.float32(self._keep) * held + np.maximum(taken, 0)
        return np.asarray(np.minimum(full, scale * np.float32(self.capacity_e)))

    def lost(self, charge: F32) -> tuple[F32, F32]:
        """Mean net loss of frames, and what comes out with them of what was left of earlier ones.

        Parameters
        ----------
        charge : (t, ...) float32
            e-, in the order of time without gaps; the first one after darkness.

        Returns
        -------
        lost, released : (t, ...) float32
            e-.
        """
        taken = self._left(charge)
        released = np.zeros_like(taken)
        if self.capacity_e:
            lost = np.empty_like(taken)
            flat = [part.reshape(len(charge), -1) for part in (taken, lost, released)]
            fill_traps(flat[0], self._keep, self.capacity_e, *flat[1:])
            return lost, released
        for back, release in enumerate(self.releases, start=1):
            released[back:] += np.float32(release) * taken[:-back]
        return taken - released, released

    def _left_behind(self, charge: F32, shot: Shot, frame: int, noisy: float = 1.0) -> F32:
        """Electrons of a frame that stay: each by its own chance, so that noise stays white."""
        share = _shares(self, shot.bench.detector, shot.rows)
        left = np.empty_like(charge)
        noise = np.zeros_like(charge)
        if shot.bench.shot_noise and noisy > 0:
            noise = shot.normals(self.name, frame) * np.float32(np.sqrt(noisy))
        begins, weights = _bands(self)
        left_behind(charge, share, begins, weights, noise, left)
        return left

    def _left(self, charge: F32) -> F32:
        """Mean of what stays of a charge, e-."""
        share = np.float32(self.share)
        if not self.bands:
            return share * charge
        parts = in_bands(charge, self.level_e)
        return np.asarray(
            share * sum(np.float32(w) * p for w, p in zip(self.bands, parts, strict=True))
        )

    def restored(self, frames: F32) -> F32:
        """Frames without lag, from those with it.

        Parameters
        ----------
        frames : (t, y, x) float32
            e-, in the order of time without gaps; the first one after darkness.

        Returns
        -------
        (t, y, x) float32
            e-; the scatter of the share from pixel to pixel is left.
        """
        if not self.bands and not self.capacity_e:
            return self._restored_exactly(frames)
        found = frames
        for _ in range(_TURNS + 1):
            found = frames + self.lost(found)[0]
        return found

    def _restored_exactly(self, frames: F32) -> F32:
        found = np.empty_like(frames)
        for n, frame in enumerate(frames):
            late = np.zeros_like(frame)
            for back, release in enumerate(self.releases[:n], start=1):
                late += np.float32(release) * self._left(found[n - back])
            found[n] = (frame - late) / np.float32(1 - self.share)
        return found

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Contrast of a frame by the step of the phase since the one before; pixels that differ.

        What stays of a fringe of another phase lowers the contrast of the frame by
        ``share (1 - cos step)``: random phases show it even where the contrast is noisy. Phases
        that rise by equal steps show nothing. Pixels with another share than the rest leave the
        frame before in their residuals; the frame after is the control. Without fringes the first
        frame of each flat tells, which lacks what the dark before it could not give.
        """
        if not evidence.fringes:
            return _of_flats(evidence)
        fringes = tuple(evidence.fringes.values())
        found = cls(0.0)
        for _ in range(_ROUNDS):
            steps = [s for f in fringes if (s := _contrast_steps(f, found)) is not None]
            if not steps:
                return None
            share, keep, share_error, keep_error, sigmas = _decay(steps)
            found = cls(float(np.clip(share, 0, 0.5)), -1 / np.log(keep) if keep else 0.0)
        share, share_error, later = _freely(steps, keep, share, share_error)
        part = middle(evidence)
        level_e = max(float(np.nanquantile(f.electrons[::7], 0.99)) for f in fringes)
        uneven, uneven_error = _mean(
            [p for f in part.fringes.values() if (p := uneven_pixels(f)) is not None]
        )
        # What the pixels have in common is no less than how much they differ by.
        rms = float(np.sqrt(max(uneven, 0.0))) / (1 - keep)
        least = rms if uneven > _CLEAR * uneven_error else 0.0
        share = float(np.clip(share, least, 0.5))
        spread, spread_error = 0.0, 1.0
        if share > 0:
            spread = rms / share
            size = max(rms, np.sqrt(uneven_error) / (1 - keep))
            spread_error = uneven_error / (1 - keep) ** 2 / (2 * size)
            spread_error = float(np.hypot(spread_error, spread * share_error) / share)
        whole = cls(share, found.decay_frames, 0.0, (), level_e, later)
        of_level: dict[str, float] = {}
        if sigmas > _CLEAR:
            whole, of_level = _by_level(part, whole)
        quiet, quiet_error = _quiet(part, whole) if sigmas > _CLEAR else (0.0, 1.0)
        decay = -1 / np.log(keep) if keep else 0.0
        decay_error = keep_error * decay**2 / keep if keep else -1 / np.log(min(keep_error, 0.9))
        return Estimate(
            replace(
                whole,
                decay_frames=whole.decay_frames
                if whole.capacity_e
                else min(float(decay), _MAX_DECAY),
                spread=min(spread, 1.0),
                quiet=quiet,
            ),
            {
                "share": share_error,
                "decay_frames": float(decay_error),
                "spread": min(spread_error, 1.0),
                "quiet": quiet_error,
            }
            | of_level,
            sigmas_of_best(sigmas, uneven / uneven_error),
            "the contrast falls with the phase step from the previous frame"
            + (", unevenly from pixel to pixel" if uneven > _CLEAR * uneven_error else ""),
            {"by_contrast_sigmas": sigmas, "by_pixels_sigmas": uneven / uneven_error},
        )


@lru_cache(maxsize=4)
def _bands(lag: Lag) -> tuple[F32, F32]:
    """Where bands of the charge begin, e-, and the share in each over the mean one."""
    weights = lag.bands or (1.0,)
    begins = np.array(BANDS[: len(weights)], np.float32) * np.float32(lag.level_e)
    return begins, np.array(weights, np.float32)


@lru_cache(maxsize=4)
def _pixels(detector: SimulatedDetector, rows: Rows) -> F32:
    """Standard normals of the chip's pixels on these rows."""
    return chip_map(detector, rows, Lag.name, lambda rng: rng.standard_normal(TILE))


@lru_cache(maxsize=4)
def _shares(lag: Lag, detector: SimulatedDetector, rows: Rows) -> F32:
    """Share (y, x) that stays behind in each pixel."""
    ny, nx = rows[1] - rows[0], detector.shape[1]
    share = np.full((ny, nx), lag.share, np.float32)
    if lag.spread:
        share *= np.clip(1 + np.float32(lag.spread) * _pixels(detector, rows), 0, 1 / lag.share)
    return share


def _contrast_steps(fringes: FringeEvidence, lag: Lag) -> tuple[F64, F64] | None:
    """Shares (lag,) that come out 1, 2, ... frames later, and their information (lag, lag).

    Linear about a lag that is known in part: its share is taken out of the frames first.
    """
    b, a_cos, a_sin = lag.restored(fringes.free[:, :3].astype(np.float32)).astype(float).T
    count = len(b)
    if count < _MIN_FRAMES + LAGS:
        return None
    phase = np.arctan2(a_sin, a_cos)
    contrast = np.hypot(a_cos, a_sin) / b
    contrast = contrast / np.median(contrast)
    terms = np.zeros((LAGS, count))
    for back in range(1, LAGS + 1):
        light = b[:-back] / b[back:]
        terms[back - 1, back:] = light * (np.cos(phase[:-back] - phase[back:]) - 1)
    time = np.linspace(-1, 1, count)
    # What a wrong gauge of the fit and slow changes do to the contrast.
    other = [np.ones(count), time, time**2]
    for n in (1, 2):
        other += [np.cos(n * phase), np.sin(n * phase)]
    basis, size, _ = np.linalg.svd(np.stack(other).T, full_matrices=False)
    basis = basis[:, size > 1e-6 * size[0]]
    used = np.ones(count, bool)
    for _ in range(2):
        inside = np.linalg.qr(basis[used])[0]
        rest = terms[:, used] - (terms[:, used] @ inside) @ inside.T
        y = contrast[used] - inside @ (inside.T @ contrast[used])
        normal = rest @ rest.T
        if np.any(np.diag(normal) < 1e-3 * used.sum()):
            return None
        shares = np.linalg.solve(normal, rest @ y)
        left = y - shares @ rest
        scatter = np.sqrt(left @ left / (used.sum() - LAGS - basis.shape[1]))
        spread = 1.4826 * np.median(np.abs(left))
        used[used] = np.abs(left) <= _CLIP * max(spread, 1e-12)
    known = np.zeros(LAGS)
    known[: len(lag.releases)] = (lag.share * lag.releases)[:LAGS]
    return known + shares, normal / scatter**2


def _decay(steps: list[tuple[F64, F64]]) -> tuple[float, float, float, float, float]:
    """Share, what is kept from frame to frame, their errors, and how significant the share is."""
    information = np.sum([n for _, n in steps], axis=0)
    right = np.sum([n @ w for w, n in steps], axis=0)
    power = np.arange(LAGS)

    def release(keep: float) -> F64:
        return np.asarray((1 - keep) * keep**power)

    def gain(keep: float) -> float:
        """Significance of the share, with its sign."""
        u = release(keep)
        return float(u @ right / np.sqrt(u @ information @ u))

    highest = float(np.exp(-1 / _MAX_DECAY))
    best = float(minimize_scalar(lambda k: -gain(k), bounds=(0, highest), method="bounded").x)
    # Without lag the decay has no meaning; it must show.
    if gain(best) ** 2 < gain(0.0) ** 2 + _CLEAR**2:
        best = 0.0
    u = release(best)
    share = float(u @ right / (u @ information @ u))
    slope = power * (1 - best) * best ** np.maximum(power - 1, 0) - best**power
    jacobian = np.stack([u, max(share, 1e-9) * slope])
    covariance = np.linalg.inv(jacobian @ information @ jacobian.T)
    errors = np.sqrt(np.diag(covariance))
    if not best:
        errors[0] = 1 / np.sqrt(u @ information @ u)
    return share, best, float(errors[0]), float(errors[1]), gain(best)


def _freely(
    steps: list[tuple[F64, F64]], keep: float, share: float, error: float
) -> tuple[float, float, tuple[float, ...]]:
    """Share, its error and what comes out in each frame, where an exponential does not describe it.

    Else share and error as given, and nothing.
    """
    information = np.sum([n for _, n in steps], axis=0)
    free = np.linalg.solve(information, np.sum([n @ w for w, n in steps], axis=0))
    away = free - share * (1 - keep) * keep ** np.arange(LAGS)
    if float(away @ information @ away) < _NOT_EXPONENTIAL or share < _CLEAR * error:
        return share, error, ()
    covariance = np.linalg.inv(information)
    kept = np.maximum(free, 0)
    total = float(kept.sum())
    return total, float(np.sqrt(covariance.sum())), tuple(map(float, kept / total))


def _by_level(evidence: Evidence, lag: Lag) -> tuple[Lag, dict[str, float]]:
    """The lag with what it does at each level, and errors of that, where it is not the same at all.

    Either a share of each band of the level stays, whatever stayed before, or traps fill up.
    """
    fit = LossFit(middle(evidence, MOST // 2), lag.level_e)

    def banded(shares: F64, charge: F32) -> F32:
        return _banded(lag, shares).lost(charge)[0]

    even = np.full(len(BANDS), lag.share)
    fit.weigh(banded, even)
    found = fit.fit(banded, even, 2)
    errors = np.sqrt(np.diag(found.covariance))
    precision = inverse_normal(found.covariance)
    # The contrast tells the common share to its square, which steps about a model leave out.
    away = found.value - (precision @ found.value).sum() / precision.sum()
    if float(away @ precision @ away) < _NOT_EVEN:
        return lag, {}

    def trapped(values: F64, charge: F32) -> F32:
        return _trapped(lag, values).lost(charge)[0]

    full = lag.share * lag.level_e
    starts = [(*even, keep, room * full) for keep in _KEEPS for room in _ROOMS]
    best = min(starts, key=lambda start: fit.chi2(trapped, start))
    traps = fit.fit(trapped, best, _STEPS // 2)
    fit.weigh(trapped, traps.value)
    traps = fit.fit(trapped, traps.value, _STEPS)
    if traps.chi2 > fit.chi2(banded, found.value) - _NOT_EVEN:
        relative = {f"bands[{n}]": float(e / lag.share) for n, e in enumerate(errors)}
        return _banded(lag, found.value), relative
    errors = np.sqrt(np.diag(traps.covariance))
    of_traps = _trapped(lag, traps.value)
    scale = (*(1 / of_traps.share for _ in BANDS), of_traps.decay_frames**2 / of_traps._keep, 1)
    names = (*(f"bands[{n}]" for n in range(len(BANDS))), "decay_frames", "capacity_e")
    return of_traps, {n: float(e * s) for n, e, s in zip(names, errors, scale, strict=True)}


def _banded(lag: Lag, shares: F64) -> Lag:
    """The lag with a share of each band of the level."""
    return replace(lag, bands=tuple(float(v) for v in np.clip(shares / lag.share, 0, 100)))


def _trapped(lag: Lag, values: F64) -> Lag:
    """Traps that take shares of the bands of the level, keep a part, and hold so much at most."""
    *shares, keep, most = values
    decay = -1 / np.log(np.clip(keep, 1e-3, np.exp(-1 / _MAX_DECAY)))
    share = float(np.mean(np.maximum(shares, 0)))
    traps = replace(
        lag, share=min(share, 0.5), decay_frames=float(decay), capacity_e=float(most), later=()
    )
    return _banded(traps, np.array(shares))


def _quiet(evidence: Evidence, lag: Lag) -> tuple[float, float]:
    """Part of what comes out that has no shot noise, and its error; zero unless it shows."""

    def comes_out(_: FringeEvidence, signal: F32) -> F32:
        return lag.lost(signal)[1]

    part, error = missing_noise(evidence, comes_out)
    return float(np.clip(part, 0, 1)) if part > _CLEAR * error else 0.0, min(error, 1.0)


def uneven_pixels(fringes: FringeEvidence) -> tuple[float, float] | None:
    """Mean square deviation of the pixels' shares from their mean, and its error.

    From the frame before, less what the frames after give: they have no part in the frame, but as
    much of everything else.
    """
    if len(fringes.g) < _MIN_FRAMES + CONTROLS:
        return None
    freedom = Freedom(fringes, HARMONICS)
    residual = freedom.left_over(freedom.of_good(fringes.residual))
    weighted = freedom.weight * residual
    steps = (1, *range(-1, -CONTROLS - 1, -1))
    before, *after = _squares_of_shares(fringes, freedom, weighted, steps)
    value, error = np.array(after).T
    noise = np.hypot(before[1], np.sqrt((error**2).mean() / CONTROLS))
    scatter = value.std(ddof=1) * np.sqrt(1 + 1 / CONTROLS)
    return before[0] - float(value.mean()), float(max(noise, scatter))


def _squares_of_shares(
    fringes: FringeEvidence, freedom: Freedom, weighted: F32, steps: Sequence[int]
) -> list[tuple[float, float]]:
    """Mean square, above noise, of the pixels' shares of an earlier frame, and its error.

    One for each number of steps back, from the residuals (t, n) times their weights.
    """
    others = np.zeros((len(steps), *fringes.g.T.shape), np.float32)
    for other, step in zip(others, steps, strict=True):
        other[:] = np.roll(fringes.g, step, axis=0).T
        other[:, slice(0, step) if step > 0 else slice(step, None)] = 0
    own, weight, theta = freedom.of_time, freedom.weight, fringes.theta[:, freedom.good]
    count = weight.shape[1]
    upper = np.triu_indices(3)

    def summed(products: F32, samples: F32) -> F32:
        """Sums over time (..., n) of products (..., t) with samples (t, n); all in one product."""
        found = products.reshape(-1, products.shape[-1]) @ samples
        return found.reshape(*products.shape[:-1], count)

    mixed = summed(own[:, None] * others[:, None], weight)
    rights = summed(others, weighted)
    found = []
    for own_squares, own_mixed, own_right in zip(
        summed(others[:, upper[0]] * others[:, upper[1]], weight), mixed, rights, strict=True
    ):
        squares = np.empty((3, 3, count))
        squares[upper] = squares[upper[::-1]] = own_squares
        # The other frame is a sum of the pixel's maps, less what the pixel can have of its own; of
        # that nothing is left in the residuals.
        along = np.einsum("kin,in->kn", own_mixed, theta)
        taken = np.einsum("nij,jn->in", freedom.pixel_inverse, along)
        information = np.einsum("in,ijn,jn->n", theta, squares, theta)
        information -= np.einsum("kn,kn->n", along, taken)
        found.append(_mean_square(np.einsum("in,in->n", theta, own_right), information))
    return found


def _mean_square(right: F64, information: F64) -> tuple[float, float]:
    """Mean square of shares less that of their noise, and its error, from normal equations (n,)."""
    told = information > 1e-3 * np.median(information)
    share, variance = right[told] / information[told], 1 / information[told]
    square = share**2 - variance
    trust = 1 / (variance**2 + np.median(variance) ** 2)
    # Particles leave wild values in a few pixels.
    trust *= np.abs(square) < _CLIP**2 * np.median(np.abs(square))
    total = trust.sum()
    mean = float(trust @ square / total)
    return mean, float(np.sqrt(trust**2 @ (square - mean) ** 2) / total)


def _mean(values: list[tuple[float, float]]) -> tuple[float, float]:
    """Weighted mean and its error; of an empty list one that says nothing."""
    if not values:
        return 0.0, 1.0
    value, error = np.array(values).T
    weight = error**-2
    return float(weight @ value / weight.sum()), float(weight.sum() ** -0.5)


def _of_flats(evidence: Evidence) -> Estimate | None:
    """The first frame of each flat against the rest, over the level.

    Any offset of first frames is taken from stacks without light.
    """
    found = np.array([f for s in evidence.stacks if (f := _first_frame(s, evidence)) is not None])
    if len(found) < 2 or np.ptp(found[:, 0]) < 10 * found[:, 2].min():
        return None
    level, step, error = found.T
    design = np.stack([-level, np.ones_like(level)]) / error
    covariance = np.linalg.inv(design @ design.T)
    share = float((covariance @ (design @ (step / error)))[0])
    share_error = float(np.sqrt(covariance[0, 0]))
    return Estimate(
        Lag(float(np.clip(share, 0, 0.5)), 0.0, 0.0),
        {"share": share_error},
        share / share_error,
        "the first flat of a level is fainter; if another flat came before it, the share is a "
        "lower limit",
        {"share": share},
    )


def _first_frame(stack: Stack, evidence: Evidence) -> tuple[float, float, float] | None:
    """Level of a stack, how much its first frame differs from the others, and the error; e-."""
    count = len(stack.adu)
    lamp, known = flicker(evidence)
    if count < (2 if stack.kind == "flat" and known > FLICKER_KNOWN else _SERIES):
        return None
    light = (stack.adu - evidence.bias)[:, evidence.good] * evidence.gain
    means = light.mean(axis=1)
    rest = means[1:]
    level = float(rest.mean())
    # What the lamp did from frame to frame is measured by the frames themselves.
    scatter = level * max(lamp, _STEADIEST) if count < _SERIES else float(rest.std(ddof=2))
    return level, float(means[0] - level), scatter * float(np.sqrt(1 + 1 / len(rest)))
