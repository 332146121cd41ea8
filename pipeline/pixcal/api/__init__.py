"""For notebooks and programs: the commands as functions, runs as arrays, from arrays to maps.

All of these names can be had from `pixcal` itself.
"""

from pixcal.api.arrays import calibrate
from pixcal.api.centroids import correct_centroids, distortion_wcs
from pixcal.api.commands import (
    allan,
    astrometry,
    budget,
    compare,
    crests,
    diagnose,
    fit,
    ingest,
    reduce,
    run,
    simulate,
    write_report,
)
from pixcal.api.opened import FringeSet, OffsetMap, Run, open_run
from pixcal.api.picture import Picture
from pixcal.api.sample import sample_acquisition
from pixcal.engine.run import Runtime
from pixcal.model.errors import InputError, PixcalError
from pixcal.model.flags import PixelFlag

__all__ = [
    "FringeSet",
    "InputError",
    "OffsetMap",
    "Picture",
    "PixcalError",
    "PixelFlag",
    "Run",
    "Runtime",
    "allan",
    "astrometry",
    "budget",
    "calibrate",
    "compare",
    "correct_centroids",
    "crests",
    "diagnose",
    "distortion_wcs",
    "fit",
    "ingest",
    "open_run",
    "reduce",
    "run",
    "sample_acquisition",
    "simulate",
    "write_report",
]
