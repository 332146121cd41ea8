"""Cameras whose clock jumps, stops, or gives two frames the same time stamp."""

import shutil
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta

import numpy as np
from astropy.io import fits

from faults import Outcome
from faults.bench import STAGES, Bench, line
from faults.forks import pixcal
from pixcal.storage.products import read_map

Stamps = Sequence[datetime]
Jump = Callable[[Stamps], list[datetime]]


def back_an_hour(stamps: Stamps) -> list[datetime]:
    """Half-way, as at the end of summer time."""
    half = len(stamps) // 2
    return [t - timedelta(hours=n >= half) for n, t in enumerate(stamps)]


def back_some_frames(stamps: Stamps) -> list[datetime]:
    """Half-way, by so little that frames mix."""
    half = len(stamps) // 2
    return [t - timedelta(seconds=2.03 * (n >= half)) for n, t in enumerate(stamps)]


def ahead_a_day(stamps: Stamps) -> list[datetime]:
    """Half-way."""
    half = len(stamps) // 2
    return [t + timedelta(days=n >= half) for n, t in enumerate(stamps)]


def reset_to_1970(stamps: Stamps) -> list[datetime]:
    """For one frame."""
    return [datetime(1970, 1, 1) if n == len(stamps) // 3 else t for n, t in enumerate(stamps)]


def in_pairs(stamps: Stamps) -> list[datetime]:
    """Every other frame has the stamp of the previous one."""
    return [stamps[n - n % 2] for n in range(len(stamps))]


def stands_still(stamps: Stamps) -> list[datetime]:
    """All frames have one stamp."""
    return [stamps[0]] * len(stamps)


JUMPS = {
    back_an_hour: "time stamps do not follow the file names",
    back_some_frames: "time stamps do not follow the file names",
    ahead_a_day: "",
    reset_to_1970: "time stamps do not follow the file names",
    in_pairs: "time stamps are the same as the one before",
    stands_still: "all files have the same time stamp",
}
"""What may happen, and what ingest says then (a pause is no fault)."""


def jump(bench: Bench, how: Jump) -> Outcome:
    """Alter the stamps of a fringe set: a warning says so, and the offsets do not change."""
    outcome = Outcome(f"camera clock: {how.__name__.replace('_', ' ')}")
    acquisition = bench.folder / "clock"
    shutil.rmtree(acquisition, ignore_errors=True)
    shutil.copytree(bench.acquisition, acquisition)
    files = sorted((acquisition / "vertical").glob("*.fits"))
    stamps = [datetime.fromisoformat(fits.getheader(file)["DATE-OBS"]) for file in files]
    for file, stamp in zip(files, how(stamps), strict=True):
        with fits.open(file, mode="update") as hdus:
            hdus[0].header["DATE-OBS"] = stamp.isoformat()
            hdus[0].header.remove("MJD-OBS", ignore_missing=True)
    run = bench.copy("jumped")
    said = pixcal(*line("ingest", acquisition, run)).succeeded().out
    assert JUMPS[how] in said, said
    for stage in (*STAGES[1:], "allan"):
        pixcal(*line(stage, acquisition, run)).succeeded()
    for name in ("delta_x.fits", "delta_y.fits"):
        delta, sigma, mask, _ = read_map(run / "products" / name)
        expected, _, same_mask, _ = read_map(bench.reference / "products" / name)
        np.testing.assert_array_equal(mask, same_mask)
        assert np.nanmax(np.abs(delta - expected) / sigma) < 0.05
    outcome.ends["warning; same offsets" if JUMPS[how] else "read as a pause; same offsets"] += 1
    return outcome
