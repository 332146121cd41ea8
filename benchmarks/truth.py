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

    def error(self, offsets: F64, modes: int | None = None) -> float:
        """Error of a map, px rms, with modes removed.

        ``offsets``: (y, x) along the fringe axis, px; NaN where there are none. ``modes``: how many
        of the seven modes of the physics note's section 2 are removed: the first ``PLANE``, or all.
        """
        good = np.isfinite(offsets)
        y, x = np.nonzero(good)
        psi = self.vector[0] * x + self.vector[1] * y
        slopes = [np.ones(len(x)), x - x.mean(), y - y.mean()]
        fringes = [np.cos(psi), np.sin(psi), np.cos(2 * psi), np.sin(2 * psi)]
        basis = np.stack([*slopes, *fringes][:modes], axis=1)
        error = (offsets - self.delta)[good]
        error -= basis @ np.linalg.lstsq(basis, error, rcond=None)[0]
        return float(np.sqrt(np.sum(error**2) / (len(error) - basis.shape[1])))


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
