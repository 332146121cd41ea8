"""Measured time series of a fringe set, for simulations that repeat it."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.fringe_motion import vector_changes
from pixcal.kernels.scene import FrameStates
from pixcal.model.arrays import F64
from pixcal.model.config import quantity
from pixcal.simulation.forward import Scalable
from pixcal.simulation.recording import Recording


@dataclass(frozen=True)
class Track(Scalable):
    """A quantity of the frames of a fringe set, linear between points, constant beyond them."""

    strengths = ("value",)

    set: str = quantity(doc="name of the fringe set")
    time_s: tuple[float, ...] = quantity(unit="s")
    """seconds after the first frame of the set, ascending"""
    value: tuple[float, ...] = quantity(low=-1e6, high=1e6, doc="values at these times")

    @classmethod
    def of(cls, name: str, time_s: F64, value: F64) -> Self:
        """From arrays (t,)."""
        values = np.clip(value, -1e6, 1e6)
        return cls(name, tuple(map(float, time_s)), tuple(map(float, values)))


def at(tracks: Iterable[Track], name: str, time_s: F64 | float) -> F64:
    """Sum of the tracks of a set at given times."""
    total = np.zeros(np.shape(time_s))
    for track in tracks:
        if track.set == name and track.time_s:
            total = total + np.interp(time_s, track.time_s, track.value)
    return total


def vector_tracks(evidence: Evidence, *, slow: bool) -> list[tuple[Track, ...]]:
    """Slow or fast change of the fringe vectors along x and along y, rad/px, as measured."""
    courses = vector_changes(evidence)
    changes = [(name, time, slowly if slow else fast) for name, time, slowly, fast in courses]
    return [tuple(Track.of(name, time, c[:, axis]) for name, time, c in changes) for axis in (0, 1)]


def moved(
    states: FrameStates, recording: Recording, change: F64, *along: Iterable[Track]
) -> FrameStates:
    """States whose fringe vectors change by (t, 2), and by tracks along x and along y, rad/px."""
    tracks = [at(track, recording.set_name, recording.times_s) for track in along]
    dkx, dky = (change + np.stack(tracks, axis=1)).T
    return replace(states, dkx=states.dkx + dkx, dky=states.dky + dky)
