"""Truth of a simulated fringe set: the error of a map, and its Cramér-Rao bound."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from astropy.io import fits
from numpy.typing import NDArray

F64 = NDArray[np.float64]

PLANE = 3
"""The modes that any straight fringes leave open come first: piston and slopes."""


@dataclass(frozen=True)
class Truth:
    """True offsets along a set's fringe axis."""

    delta: F64  # (y, x) offsets along the fringe axis, px
    vector: tuple[float, float]  # true fringe vector (kx, ky), rad/px
    bound: float  # Cramér-Rao bound of an offset, px, rms over the pixels

    @classmethod
    def read(cls, folder: Path, name: str) -> "Truth":
        """Truth of a set lit evenly, from the directory that ``pixcal simulate`` leaves."""
        bench = yaml.safe_load((folder / "bench.yaml").read_text())
        told = json.loads((folder / "truth.json").read_text())["sets"][name]
        (scan,) = (s for s in bench["frames"]["fringes"] if s["name"] == name)
        delta_x, delta_y, response, dark = (
            np.asarray(fits.getdata(folder / f"{m}.fits"), float)
            for m in ("delta_x", "delta_y", "response", "dark_rate")
        )
        kx, ky = told["kx"], told["ky"]
        k = float(np.hypot(kx, ky))
        level, amplitude, phi, dkx, dky = (
            np.array(told[key]) for key in ("B", "A", "phi", "dkx", "dky")
        )
        # A hundredth of the pixels, at all phases of the fringes.
        ny, nx = delta_x.shape
        y, x = np.divmod(np.arange(0, ny * nx, 101), nx)
        turn = phi + np.outer(x - (nx - 1) / 2, dkx) + np.outer(y - (ny - 1) / 2, dky)
        visibility = bench["optics"]["visibility"]
        detector = bench["detector"]
        variance = phase_bound(
            iota=scan["peak_e"] / (1 + visibility) * response[y, x],
            visibility=visibility,
            psi=kx * x + ky * y,
            level=level,
            amplitude=amplitude,
            turn=turn,
            noise=dark[y, x] * bench["frames"]["exptime_s"]
            + detector["read_noise_e"] ** 2
            + detector["gain_e_per_adu"] ** 2 / 12,
        )
        bound = float(np.sqrt(np.mean(variance))) / k
        return cls((kx * delta_x + ky * delta_y) / k, (kx, ky), bound)

    def offsets(self, phase: F64) -> F64:
        """Offsets along the fringe axis, px, from a map of phases (y, x), rad, modulo 2π."""
        y, x = np.indices(phase.shape)
        rest = np.exp(1j * (phase - self.vector[0] * x - self.vector[1] * y))
        return np.asarray(np.angle(rest / np.nanmean(rest)) / np.hypot(*self.vector))

    def modes(self, most: int | None = None) -> F64:
        """Modes (mode, y, x) of the physics note's section 2: the first ``PLANE``, or all seven."""
        shape = self.delta.shape
        return np.concatenate([plane(shape), harmonics(shape, self.vector)])[:most]

    def errors(self, offsets: F64, modes: int | None = None) -> F64:
        """Errors (y, x) of a map along the fringe axis, px, less the modes; NaN where it is NaN."""
        return without(offsets - self.delta, self.modes(modes))

    def error(self, offsets: F64, modes: int | None = None) -> float:
        """The same as one number, px rms."""
        errors = self.errors(offsets, modes)
        freedom = np.isfinite(errors).sum() - len(self.modes(modes))
        return float(np.sqrt(np.nansum(errors**2) / freedom))


def without(values: F64, basis: F64) -> F64:
    """A map (y, x) less what the modes (mode, y, x) explain of it; NaN stay NaN."""
    good = np.isfinite(values)
    found = np.linalg.lstsq(basis[:, good].T, values[good], rcond=None)[0]
    return np.asarray(values - np.tensordot(found, basis, 1))


def plane(shape: tuple[int, ...]) -> F64:
    """Piston and slopes (3, y, x)."""
    y, x = np.indices(shape)
    return np.stack([np.ones(shape), x / shape[1] - 0.5, y / shape[0] - 0.5])


def harmonics(shape: tuple[int, ...], vector: tuple[float, float]) -> F64:
    """The fringe and its second harmonic, cosine and sine each (4, y, x)."""
    y, x = np.indices(shape)
    psi = vector[0] * x + vector[1] * y
    return np.stack([np.cos(psi), np.sin(psi), np.cos(2 * psi), np.sin(2 * psi)])


def phase_bound(
    *, iota: F64, visibility: float, psi: F64, level: F64, amplitude: F64, turn: F64, noise: F64
) -> F64:
    """Cramér-Rao bound of a pixel's phase, the frames known; rad², shape (p,).

    ``iota``: (p,) mean light, e-. ``visibility``: alpha / iota. ``psi``: (p,) phase, rad.
    ``level, amplitude``: (t,) B and A of the frames. ``turn``: (p, t) phi of the frames at the
    pixels, rad. ``noise``: (p,) variance without the shot noise of the light, e-².
    """
    wave, slope = np.sin(psi[:, None] + turn), np.cos(psi[:, None] + turn)
    alpha = visibility * iota[:, None]
    # What moves a sample: iota, alpha and psi.
    moves = np.stack([level + 0 * wave, amplitude * wave, alpha * amplitude * slope])
    mean = iota[:, None] * level + alpha * amplitude * wave
    information = np.einsum("ipt,jpt->pij", moves / (mean + noise[:, None]), moves)
    return np.asarray(np.linalg.inv(information)[:, 2, 2])
