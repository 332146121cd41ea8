"""Series of bias and dark frames: light between them may leave charge in the frames after it."""

from collections.abc import Mapping

import numpy as np

from pixcal.estimators.diagnosis.evidence import SOON_S
from pixcal.model.arrays import F64
from pixcal.stages.diagnose.parts import Table
from pixcal.stages.evidence import DAY_S, frame_days, groups

FEWEST = 4  # least frames of a series, else it is not divided: both halves need two of each


def in_series(tables: Mapping[str, Table]) -> dict[str, Table]:
    """Tables with the number of each bias and dark frame's series (``step``), and ``after_light``.

    Light divides the frames of one exposure time if the next ones begin soon after it. ``last`` is
    the number of the last frame of its series.
    """
    dark = {name: table for name, table in tables.items() if name in ("bias", "dark")}
    every = [frame_days(table) for name, table in tables.items() if name not in dark]
    light = np.sort(np.concatenate([*every, []]))
    found = dict(tables)
    if light.size and np.isfinite(light).all():
        found |= {name: _numbered(table, light) for name, table in dark.items()}
    kinds = {name: found[name] for name in ("bias", "dark", "flat") if name in found}
    return found | {name: _with_ends(table) for name, table in kinds.items()}


def _with_ends(table: Table) -> Table:
    """Table of calibration frames with the number of the last frame of each one's series."""
    last = np.zeros(len(table["time_s"]), int)
    for own in groups(table):
        last[own] = own[-1]
    return {**table, "last": last.tolist()}


def _numbered(table: Table, light: F64) -> Table:
    """Table of bias or dark frames, in series; ``light``: times of lit frames, days, ascending."""
    days = frame_days(table)
    if not np.isfinite(days).all():
        return table
    before = np.searchsorted(light, days)
    since = days - np.append(-np.inf, light)[before]
    soon = since * DAY_S < SOON_S
    step, after = np.zeros(len(days), int), np.zeros(len(days), np.bool_)
    for own in groups(table):
        begins = own[np.flatnonzero(np.diff(before[own], prepend=-1))]
        begins = begins[(begins == own[0]) | soon[begins]]
        series = np.searchsorted(begins, own, side="right") - 1
        if np.bincount(series).min() < FEWEST:
            series, begins = np.zeros_like(series), begins[:1]
        step[own], after[own] = series, soon[begins][series]
    return {**table, "step": step.tolist(), "after_light": after.tolist()}
