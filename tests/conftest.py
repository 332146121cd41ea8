"""A bench that shares no code with pixcal: plain NumPy and astropy, in the contract's format."""

import itertools
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml
from astropy.io import fits
from hypothesis import settings
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pixcal.engine.run import Runtime


# Before Dask is imported, here and in workers that tests start: with Python 3.11 its profiler can
# stop a process for good (https://github.com/python/cpython/issues/106883).
os.environ["DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED"] = "False"

# Property tests try the same examples everywhere, however slow the machine.
settings.register_profile("pixcal", deadline=None, derandomize=True, database=None)
settings.load_profile("pixcal")

F64 = NDArray[np.float64]
SETS = {"vertical": (6.0, 0.0), "horizontal": (0.0, 6.0)}


@dataclass
class Bench:
    """Everything that a small acquisition is made of; lengths in mm, levels in electrons."""

    shape: tuple[int, int] = (61, 67)
    frames: int = 150
    sets: dict[str, tuple[float, float]] = field(default_factory=lambda: dict(SETS))
    interfringe: float | None = 5.0
    """Overrides the length of the baselines."""
    distance: float = 400.0
    offset: tuple[float, float] = (0.0, 0.0)
    visibility: float = 0.95
    level: float = 25_000.0
    read_noise: float = 16.0
    gain: float = 1.0
    delta: float = 6e-3
    laser_noise: float = 0.0
    visibility_noise: float = 0.0
    vector_noise: float = 0.0
    """Fringe vector noise: rad across the window, each frame."""
    response: float = 0.0
    """Pixel-to-pixel response, rms; flats are written when it is not zero."""
    n_bias: int = 12
    seed: int = 0
    phase: str = "random"

    pitch: float = 4.4e-3
    wavelength: float = 632.8e-6

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        rng = self.rng
        self.delta_x = rng.normal(0, self.delta, self.shape)
        self.delta_y = rng.normal(0, self.delta, self.shape)
        self.flat = 1 + self.response * rng.normal(size=self.shape)
        self.bias = 300 + 5 * rng.normal(size=self.shape)
        if self.interfringe is not None:
            length = self.wavelength * self.distance / (self.pitch * self.interfringe)
            self.sets = {
                n: (b[0] / np.hypot(*b) * length, b[1] / np.hypot(*b) * length)
                for n, b in self.sets.items()
            }

    def psi(self, name: str) -> F64:
        """Exact phase by plain differences in extended precision."""
        bx, by = self.sets[name]
        ny, nx = self.shape
        y, x = np.mgrid[:ny, :nx].astype(np.longdouble)
        px = (x - (nx - 1) / 2 + self.delta_x) * self.pitch
        py = (y - (ny - 1) / 2 + self.delta_y) * self.pitch
        ox, oy = self.offset
        a = np.sqrt((px - ox + bx / 2) ** 2 + (py - oy + by / 2) ** 2 + self.distance**2)
        b = np.sqrt((px - ox - bx / 2) ** 2 + (py - oy - by / 2) ** 2 + self.distance**2)
        return np.asarray(2 * np.pi * (a - b) / self.wavelength, dtype=float)

    def illumination(self) -> F64:
        ny, nx = self.shape
        y, x = np.mgrid[:ny, :nx] - np.array([ny / 2, nx / 2])[:, None, None]
        return np.asarray(np.exp(-(x**2 + y**2) / (3 * max(ny, nx)) ** 2))

    def scan(self, name: str) -> tuple[F64, F64, F64, F64]:
        """B, A, phi and (dkx, dky) of each frame."""
        rng = np.random.default_rng([self.seed, list(self.sets).index(name)])
        n = self.frames
        b = 1 + self.laser_noise * rng.normal(size=n)
        a = np.minimum(b * (1 + self.visibility_noise * rng.normal(size=n)), b / self.visibility)
        phi = rng.uniform(0, 2 * np.pi, n) if self.phase == "random" else np.linspace(0, 40, n)
        return b, a, phi, self.vector_noise / max(self.shape) * rng.normal(size=(n, 2))

    def electrons(self, name: str) -> tuple[F64, F64]:
        """Noise-free frames (t, y, x) and psi (y, x)."""
        b, a, phi, dk = self.scan(name)
        psi, light = self.psi(name), self.level * self.illumination() * self.flat
        ny, nx = self.shape
        y, x = np.mgrid[:ny, :nx] - np.array([ny / 2, nx / 2])[:, None, None]
        turn = phi[:, None, None] + dk[:, 0, None, None] * x + dk[:, 1, None, None] * y
        wave = self.visibility * a[:, None, None] * np.sin(psi + turn)
        return light * (b[:, None, None] + wave), psi

    def read_out(self, electrons: F64) -> NDArray[np.uint16]:
        """Shot noise, read noise, gain, bias, rounding."""
        noisy = self.rng.poisson(electrons) + self.rng.normal(0, self.read_noise, electrons.shape)
        return np.clip(np.rint(noisy / self.gain + self.bias), 0, 65535).astype(np.uint16)

    def bound(self, name: str, every: int = 97) -> float:
        """Cramér-Rao bound of the offset along the fringe axis, px, rms over some pixels."""
        b, a, phi, dk = self.scan(name)
        psi = self.psi(name).ravel()
        light = (self.level * self.illumination() * self.flat).ravel()
        ny, nx = self.shape
        variances = []
        for p in range(0, psi.size, every):
            turn = phi + dk[:, 0] * (p % nx - nx / 2) + dk[:, 1] * (p // nx - ny / 2)
            g = np.stack([b, a * np.cos(turn), a * np.sin(turn)], axis=1)
            theta = light[p] * np.array(
                [1, self.visibility * np.sin(psi[p]), self.visibility * np.cos(psi[p])]
            )
            information = (g / (g @ theta + self.read_noise**2 + 1 / 12)[:, None]).T @ g
            gradient = np.array([0, theta[2], -theta[1]]) / (theta[1] ** 2 + theta[2] ** 2)
            variances.append(gradient @ np.linalg.solve(information, gradient))
        return float(np.sqrt(np.mean(variances)) / self.wave_number(name))

    def wave_number(self, name: str) -> float:
        per_mm = 2 * np.pi * self.pitch / (self.wavelength * self.distance)
        return float(np.hypot(*self.sets[name]) * per_mm)

    def modes(self, name: str, quadratic: bool = False) -> F64:
        """Modes (mode, y, x) that the data cannot tell from the bench."""
        psi = self.psi(name)
        ny, nx = self.shape
        y, x = np.mgrid[:ny, :nx] / np.array([ny, nx], float)[:, None, None] - 0.5
        modes = [np.ones(self.shape), x, y]
        modes += [np.cos(psi), np.sin(psi), np.cos(2 * psi), np.sin(2 * psi)]
        if quadratic:
            modes += [x * x, x * y, y * y]
        return np.stack(modes)

    def without_modes(self, error: F64, name: str, **options: Any) -> F64:
        """An error map less the modes of a set; NaN stay NaN."""
        good = np.isfinite(error)
        basis = self.modes(name, **options)
        fit = np.linalg.lstsq(basis[:, good].T, error[good], rcond=None)[0]
        return np.asarray(error - np.tensordot(fit, basis, 1))

    def write(self, folder: Path) -> Path:
        """Write the acquisition: one 3-D cube a kind."""
        folder.mkdir(parents=True, exist_ok=True)
        frames: dict[str, Any] = {"bias": ["bias.fits"], "fringes": []}
        self._write(folder / "bias.fits", np.zeros((self.n_bias, *self.shape)), 0.02)
        if self.response:
            frames["flat"] = ["flat.fits"]
            self._write(folder / "flat.fits", np.full((40, *self.shape), 30_000.0) * self.flat, 0.1)
        for name, baseline in self.sets.items():
            electrons, _ = self.electrons(name)
            self._write(folder / f"{name}.fits", electrons, 0.02)
            frames["fringes"].append(
                {
                    "name": name,
                    "files": [f"{name}.fits"],
                    "baseline_mm": [float(v) for v in baseline],
                }
            )
        config = {
            "schema": "pixcal/acquisition/1",
            "detector": {
                "pitch_um": self.pitch * 1e3,
                "gain_e_per_adu": self.gain,
                "read_noise_e": self.read_noise,
            },
            "optics": {
                "wavelength_nm": 632.8,
                "distance_mm": self.distance,
                "frame_period_s": 0.14,
            },
            "frames": frames,
        }
        (folder / "acquisition.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
        return folder

    def _write(self, path: Path, electrons: F64, exposure: float) -> None:
        hdu = fits.PrimaryHDU(self.read_out(electrons))
        hdu.header["EXPTIME"] = exposure
        hdu.writeto(path, overwrite=True)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of the cases of a test that is marked ``quick(n)``, all but the first n are long."""
    cases: Counter[str] = Counter()
    for item in items:
        if quick := item.get_closest_marker("quick"):
            test = item.nodeid.partition("[")[0]
            cases[test] += 1
            if cases[test] > quick.args[0]:
                item.add_marker(pytest.mark.long)


@pytest.fixture(scope="module")
def dask_cluster() -> Iterator["Runtime"]:
    """A Dask cluster of two workers, reached by its address."""
    from distributed import LocalCluster

    from pixcal.engine.run import Runtime

    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=False,
        host="127.0.0.1",
        protocol="tcp://",
        dashboard_address=None,
    ) as local:
        yield Runtime(local.scheduler_address)


@pytest.fixture(scope="session", autouse=True)
def unsynced() -> Iterator[None]:
    """Files of tests outlive processes that are killed, not a loss of power: no wait for disks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


@pytest.fixture
def bench() -> Callable[..., Bench]:
    """Make a bench: ``bench(frames=60, interfringe=9.0)``."""
    return Bench


@pytest.fixture(scope="session")
def make_bench() -> Callable[..., Bench]:
    """As `bench`, for fixtures that live longer."""
    return Bench


@pytest.fixture(scope="session")
def reseal() -> Callable[..., None]:
    """Make artefacts that a test has altered look as if they had been written so."""
    from pixcal.storage.manifest import read_manifest, write_manifest

    def change(*folders: Path) -> None:
        for folder in folders:
            manifest = read_manifest(folder)
            assert manifest is not None
            write_manifest(folder, replace(manifest, files={}))

    return change


@pytest.fixture(scope="session")
def write_reduced() -> Callable[[Bench, Path], Path]:
    """Write what ingest and reduce leave, straight from a bench (bias 300, step 1 e-)."""
    return _reduced_run


def _reduced_run(bench: Bench, run: Path) -> Path:
    from pixcal.storage.artefact import build
    from pixcal.storage.cube import create_array, create_group, write_array
    from pixcal.storage.manifest import write_json

    bench.bias = np.full(bench.shape, 300.0)
    acquisition = {
        "schema": "pixcal/acquisition/1",
        "detector": {"pitch_um": 4.4, "gain_e_per_adu": 1.0, "read_noise_e": bench.read_noise},
        "optics": {"wavelength_nm": 632.8, "distance_mm": 400.0, "frame_period_s": 0.14},
        "frames": {
            "fringes": [
                {"name": n, "files": ["x"], "baseline_mm": list(map(float, b))}
                for n, b in bench.sets.items()
            ]
        },
    }
    with build(run, "ingest", 1, {}, {}) as made:
        write_json(made.folder / "acquisition.json", acquisition)
        write_json(made.folder / "frames.json", {})
    with build(run, "reduce", 1, {}, {"ingest": "x"}) as made:
        create_group(made.folder / "reduced.zarr")
        for name in bench.sets:
            group = made.folder / "reduced.zarr" / name
            create_group(group)
            codes = bench.read_out(bench.electrons(name)[0])
            attrs = {"scale_factor": 1.0, "add_offset": -300.0, "_FillValue": 65535}
            signal = create_array(
                group / "signal", codes.shape, "<u2", fill_value=65535, attrs=attrs
            )
            for t in range(0, len(codes), 64):
                for y in range(0, codes.shape[1], 128):
                    for x in range(0, codes.shape[2], 128):
                        signal.write((t, y, x), codes[t : t + 64, y : y + 128, x : x + 128])
            signal.finish()
            write_array(group / "time", np.arange(len(codes)) * 0.14, dims=("time",))
            variance = np.float32(bench.read_noise**2 + 1 / 12)
            for array, value in (
                ("read_variance", variance / bench.flat**2),
                ("shot_factor", 1 / bench.flat),
                ("mask", np.zeros(bench.shape, np.uint8)),
            ):
                dtype = np.uint8 if array == "mask" else np.float32
                data = np.broadcast_to(value, bench.shape).astype(dtype)
                write_array(group / array, data, dims=("y", "x"), chunks=(128, 128))
    return run


class Bucket:
    """A bucket of an object store, looked at without the libraries that pixcal uses for it."""

    def __init__(self, endpoint: str, name: str) -> None:
        import boto3

        self.name, self.url = name, f"s3://{name}"
        self.client: Any = boto3.client("s3", endpoint_url=endpoint)
        self.client.create_bucket(Bucket=name)

    def keys(self) -> list[str]:
        pages = self.client.get_paginator("list_objects_v2").paginate(Bucket=self.name)
        return [found["Key"] for page in pages for found in page.get("Contents", [])]

    def get(self, key: str) -> bytes:
        content: bytes = self.client.get_object(Bucket=self.name, Key=key)["Body"].read()
        return content

    def put(self, key: str, content: bytes) -> None:
        self.client.put_object(Bucket=self.name, Key=key, Body=content)

    def delete(self, key: str) -> None:
        self.client.delete_object(Bucket=self.name, Key=key)

    def tree(self, prefix: str) -> dict[str, bytes]:
        """Contents below a prefix, by their names from there on."""
        return {k[len(prefix) :]: self.get(k) for k in self.keys() if k.startswith(prefix)}


@pytest.fixture(scope="session")
def s3_endpoint() -> Iterator[str]:
    """A stand-in of S3 on this machine, and the environment that leads there."""
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "test")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        patch.setenv("AWS_CONFIG_FILE", os.devnull)
        yield f"http://{host}:{port}"
    server.stop()


@pytest.fixture(scope="session")
def make_bucket(s3_endpoint: str) -> Callable[[], Bucket]:
    """Make a bucket, for fixtures that live longer than a test."""
    numbers = itertools.count()
    return lambda: Bucket(s3_endpoint, f"bucket-{next(numbers)}")


@pytest.fixture
def bucket(make_bucket: Callable[[], Bucket]) -> Bucket:
    """A new bucket."""
    return make_bucket()
