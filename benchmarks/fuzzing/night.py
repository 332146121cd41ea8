"""A small acquisition with a known truth, to be damaged before it is written; plain NumPy."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy.io import fits
from numpy.typing import NDArray

from fuzzing.laws import Broken

F64 = NDArray[np.float64]

PITCH_UM, WAVELENGTH_NM, DISTANCE_MM = 4.4, 632.8, 400.0
WITHIN = 6.0
"""Errors of the offsets that are given, in their own SIGMA."""


@dataclass
class Night:
    """Frames of a window in straight fringes; lengths in px, levels in electrons."""

    rng: np.random.Generator
    shape: tuple[int, int] = (23, 29)  # rows and columns
    count: int = 40  # frames of each set
    # fringe vector (kx, ky) of each set, rad/px
    vectors: dict[str, tuple[float, float]] = field(default_factory=dict)
    level: float = 20_000.0
    visibility: float = 0.9
    delta_rms: float = 5e-3
    read_noise: float = 16.0
    gain: float = 1.0
    bias: float = 300.0
    n_bias: int = 12
    phases: F64 | None = None
    """Of the frames, rad; random over a turn when None."""

    def __post_init__(self) -> None:
        rng, shape = self.rng, self.shape
        if not self.vectors:
            k = 2 * np.pi / 5.3
            self.vectors = {"vertical": (k, 0.02), "horizontal": (0.01, k)}
            if rng.random() < 0.5:
                del self.vectors[str(rng.choice(list(self.vectors)))]
        self.delta_x, self.delta_y = rng.normal(0, self.delta_rms, (2, *shape))
        self.spoilt = np.zeros(shape, bool)  # pixels that must have no value in the maps
        # samples (t, y, x) in ADU, float64, not yet rounded; by file stem
        self.frames: dict[str, F64] = {}
        self.described = self._describe()  # contents of ``acquisition.yaml``, as it should be
        self._expose()

    def _expose(self) -> None:
        rng, shape = self.rng, self.shape
        pedestal = self.bias + rng.normal(0, 3, shape)
        self.frames["bias"] = self._read_out(np.zeros((self.n_bias, *shape)), pedestal)
        y, x = np.indices(shape)
        for name, (kx, ky) in self.vectors.items():
            psi = kx * (x + self.delta_x) + ky * (y + self.delta_y)
            turn = rng.uniform(0, 2 * np.pi, self.count) if self.phases is None else self.phases
            wave = np.sin(psi + turn[:, None, None])
            mean = self.level * (1 + self.visibility * wave)
            self.frames[name] = self._read_out(rng.poisson(mean).astype(float), pedestal)

    def _read_out(self, electrons: F64, pedestal: F64) -> F64:
        noisy = electrons + self.rng.normal(0, self.read_noise, electrons.shape)
        return np.asarray(noisy / self.gain + pedestal)

    def _describe(self) -> dict[str, Any]:
        per_px = WAVELENGTH_NM * 1e-6 * DISTANCE_MM / (2 * np.pi * PITCH_UM * 1e-3)
        return {
            "schema": "pixcal/acquisition/1",
            "detector": {
                "name": "a window",
                "pitch_um": PITCH_UM,
                "gain_e_per_adu": self.gain,
                "read_noise_e": self.read_noise,
                "full_well_e": 5e4,
                "saturation_adu": 65535.0,
            },
            "optics": {
                "wavelength_nm": WAVELENGTH_NM,
                "distance_mm": DISTANCE_MM,
                "frame_period_s": 0.14,
            },
            "frames": {
                "bias": ["bias.fits"],
                "dark": [],
                "flat": [],
                "fringes": [
                    {
                        "name": name,
                        "files": [f"{name}.fits"],
                        "baseline_mm": [float(kx * per_px), float(ky * per_px)],
                    }
                    for name, (kx, ky) in self.vectors.items()
                ],
            },
        }

    def write(self, folder: Path, dtype: str = "uint16") -> Path:
        """Write the acquisition, one cube a kind; integers are rounded and clipped."""
        folder.mkdir(parents=True, exist_ok=True)
        for stem, frames in self.frames.items():
            samples = frames
            if dtype != "float32":
                ends = np.iinfo(dtype)
                samples = np.clip(np.rint(frames), ends.min, ends.max)
            hdu = fits.PrimaryHDU(samples.astype(dtype))
            hdu.header["EXPTIME"] = 0.02
            hdu.writeto(folder / f"{stem}.fits", overwrite=True)
        described = yaml.safe_dump(self.described, allow_unicode=True)
        (folder / "acquisition.yaml").write_text(described, encoding="utf-8")
        return folder

    def check(self, run: Path) -> None:
        """Compare the products of a run with the truth.

        Raises Broken if flags, NaN and SIGMA disagree, a damaged pixel has a value, or an error
        exceeds `WITHIN` times its SIGMA after removal of the degenerate modes.
        """
        told = json.loads((run / "products" / "fit.json").read_text())
        for name in told["outputs"]:
            with fits.open(run / "products" / f"{name}.fits") as hdus:
                value, sigma = (np.asarray(hdus[n].data, float) for n in (0, "SIGMA"))
                mask = np.asarray(hdus["MASK"].data)
            _check_flags(name, value, sigma, mask)
            given = np.isfinite(value)
            if (given & self.spoilt).any():
                raise Broken(f"{name}: {(given & self.spoilt).sum()} spoilt pixels have a value")
            sets = told["sets"]
            axis = {"delta_x": (1.0, 0.0), "delta_y": (0.0, 1.0)}.get(name)
            if axis is None:
                axis = next(iter(sets.values()))["axis"]
            error = value - axis[0] * self.delta_x - axis[1] * self.delta_y
            self._check_errors(name, error, sigma, sets)

    def _check_errors(self, name: str, error: F64, sigma: F64, sets: Mapping[str, Any]) -> None:
        good = np.isfinite(error)
        y, x = np.nonzero(good)
        modes = [np.ones(len(x)), x - x.mean(), y - y.mean()]
        for facts in sets.values():
            if "hyperbolic" in facts["model"]:
                modes += [modes[1] ** 2, modes[1] * modes[2], modes[2] ** 2]
        for kx, ky in self.vectors.values():
            psi = kx * x + ky * y
            modes += [np.cos(psi), np.sin(psi), np.cos(2 * psi), np.sin(2 * psi)]
        basis = np.stack(modes, axis=1) / sigma[good][:, None]
        if len(basis) < 2 * basis.shape[1]:
            return
        z = error[good] / sigma[good]
        z -= basis @ np.linalg.lstsq(basis, z, rcond=None)[0]
        if abs(z).max() > WITHIN:
            raise Broken(
                f"{name}: an error of {abs(z).max():.1f} SIGMA ({(abs(z) > WITHIN).sum()} of "
                f"{len(z)} pixels beyond {WITHIN:g}, rms {np.sqrt(np.mean(z**2)):.2f})"
            )
        spread = np.sqrt(np.sum(z**2) / (len(z) - basis.shape[1]))
        # SIGMA comes from some frames, and the pixels are not many.
        if spread > 1.25 + 4 / np.sqrt(2 * len(z)):
            raise Broken(f"{name}: errors are {spread:.2f} times SIGMA, {len(z)} pixels")


def _check_flags(name: str, value: F64, sigma: F64, mask: NDArray[np.uint8]) -> None:
    given = np.isfinite(value)
    if not np.array_equal(given, mask == 0):
        raise Broken(f"{name}: {(given != (mask == 0)).sum()} pixels have a value and a flag")
    if not (np.isfinite(sigma) == given).all() or (sigma[given] <= 0).any():
        raise Broken(f"{name}: SIGMA is not there where the values are")
