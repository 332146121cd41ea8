"""Exposure times of the frames, with defaults where headers lack them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pixcal.estimators.detector.calibration import MIN_STEPS
from pixcal.model.arrays import F32

_SAME = 1e-3  # relative tolerance of equal exposure times: cameras may write measured times


@dataclass(frozen=True)
class Group:
    """Frames of one array and one exposure time."""

    array: str  # name of the array
    exptime: float  # median exposure time (s)
    frames: tuple[int, ...]  # their numbers in the array


@dataclass
class Exposures:
    """Groups of the calibration frames and exposure times of the fringe frames."""

    dark: list[Group] = field(default_factory=list)  # frames without light, bias among them
    flat: list[Group] = field(default_factory=list)  # sorted by exposure time
    # whether exposure times of the flats are known; if not, there is one group, at one second
    known: bool = True
    # exposure times (s) of the frames of each set, float32; zero: do not scale the dark signal
    fringes: dict[str, F32] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)  # sentences

    @property
    def has_rate(self) -> bool:
        """Whether the dark signal per second can be separated from the bias."""
        return len({group.exptime for group in self.dark}) > 1

    @property
    def read_series(self) -> Group | None:
        """Series that gives the read noise: bias, else the longest darks; None if single frames."""
        series = [group for group in self.dark if group.array == "bias"] or self.dark
        longest = max(series, key=lambda group: len(group.frames), default=None)
        return longest if longest is not None and len(longest.frames) > 1 else None


def group_exposures(tables: Mapping[str, Mapping[str, Sequence[Any]]]) -> Exposures:
    """Group frames of ``RUN/ingest/frames.json`` by exposure time."""
    times = {name: list(table["exptime_s"]) for name, table in tables.items()}
    lit = [name for name in times if name not in ("bias", "dark")]
    exposed = [t for name in ["dark", *lit] for t in times.get(name, [])]
    exposures = Exposures()
    if "dark" in times and all(t is None for t in exposed):
        # The exposure is the unit of time, and equal for all but the bias frames.
        times |= {name: [1.0] * len(times[name]) for name in ["dark", *lit]}
        unit = ", and dark_rate is in electrons per exposure" if "bias" in times else ""
        exposures.warnings.append(
            "no frame has EXPTIME: darks are assumed to have the same exposure time as the "
            f"others{unit}"
        )
    _group_darks(exposures, times)
    _group_flats(exposures, times.get("flat", []), tables.get("flat", {}).get("step"))
    for name in lit:
        if name != "flat":
            _time_fringes(exposures, name, times[name])
    return exposures


def _groups(
    array: str, times: Sequence[float | None], steps: Sequence[int] | None = None
) -> list[Group]:
    """Frames with a known time, in groups of the same time and step, sorted by both."""
    if steps is not None and any(steps):
        parts = []
        for step in sorted(set(steps)):
            of_step = [t if s == step else None for t, s in zip(times, steps, strict=True)]
            parts += _groups(array, of_step)
        return sorted(parts, key=lambda group: group.exptime)
    order = sorted((t, n) for n, t in enumerate(times) if t is not None)
    groups: list[list[tuple[float, int]]] = []
    for t, n in order:
        if groups and t <= groups[-1][-1][0] * (1 + _SAME):
            groups[-1].append((t, n))
        else:
            groups.append([(t, n)])
    return [Group(array, float(g[len(g) // 2][0]), tuple(sorted(n for _, n in g))) for g in groups]


def _group_darks(exposures: Exposures, times: Mapping[str, list[float | None]]) -> None:
    bias, dark = times.get("bias", []), times.get("dark", [])
    exposures.dark += _groups("bias", [t or 0.0 for t in bias])
    exposures.dark += _groups("dark", dark)
    unknown = sum(t is None for t in dark)
    if unknown:
        exposures.warnings.append(f"no EXPTIME in {unknown} of {len(dark)} dark frames: not used")
    if not exposures.dark:
        exposures.warnings.append(
            "no bias and no dark frames: bias and dark signal are assumed to be zero, the gain is "
            "not measured, and signals include the bias"
        )
    elif not bias and not exposures.has_rate:
        exposures.warnings.append(
            "no bias frames, and darks of one exposure time only: their mean is subtracted as "
            "bias and dark signal, which is valid only for frames of the same exposure time, and "
            "the read noise contains the noise of the dark signal"
        )
    elif not exposures.has_rate and dark:
        exposures.warnings.append(
            "darks and bias frames have the same exposure time: the dark signal is included in the "
            "bias"
        )


def _group_flats(
    exposures: Exposures, times: list[float | None], steps: Sequence[int] | None
) -> None:
    if not times:
        exposures.warnings.append("no flat frames: the flat is 1, the gain is not measured")
        return
    # Zero exposure gives no rate of the light.
    usable = [t if t else None for t in times]
    exposures.flat = _groups("flat", usable, steps)
    unknown, unexposed = sum(t is None for t in times), sum(t == 0 for t in times)
    if not exposures.flat:
        exposures.known = False
        exposures.flat = _groups("flat", [1.0] * len(times), steps)
        lost = ["linearity is not measured"] if len(exposures.flat) >= MIN_STEPS else []
        lost += ["their dark signal is not removed"] if exposures.has_rate else []
        if lost:
            lacking = "an EXPTIME of 0" if unexposed else "no EXPTIME"
            exposures.warnings.append(
                f"flat frames have {lacking}: {' and '.join(lost)}; write exposure times into the "
                "headers (for TIFF and PNG into headers.csv)"
            )
    elif unknown:
        exposures.warnings.append(f"no EXPTIME in {unknown} of {len(times)} flat frames: not used")
    elif unexposed:
        exposures.warnings.append(
            f"EXPTIME is 0 s in {unexposed} of {len(times)} flat frames: not used; write their "
            "exposure times into the headers, or list them under frames.bias if they hold no light"
        )
    if all(len(group.frames) < 2 for group in exposures.flat):
        exposures.warnings.append(
            "no two flats have the same level: gain and PRNU are not measured; take at least two "
            "flats at each level"
        )


def _time_fringes(exposures: Exposures, name: str, times: list[float | None]) -> None:
    unknown = sum(t is None for t in times)
    exposures.fringes[name] = np.array([t or 0.0 for t in times], np.float32)
    if exposures.has_rate and unknown:
        exposures.warnings.append(
            f"{name}: no EXPTIME in {unknown} of {len(times)} frames: their dark signal is "
            "assumed to be zero"
        )
    if len(exposures.dark) == 1 and exposures.dark[0].array == "dark":
        expected = exposures.dark[0].exptime
        other = sum(t is not None and abs(t - expected) > _SAME * expected for t in times)
        if other:
            exposures.warnings.append(
                f"{name}: the mean of the darks, {expected:g} s, is subtracted as bias and dark "
                f"signal, but EXPTIME differs in {other} of {len(times)} frames"
            )
