"""Error of star centroids without and with the maps."""

from pixcal.model.options import Astrometry as Config
from pixcal.stages.astrometry.stage import run
from pixcal.stages.astrometry.summary import table

__all__ = ["Config", "run", "table"]
