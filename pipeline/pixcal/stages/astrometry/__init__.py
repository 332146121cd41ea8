"""Error of star centroids without and with the maps."""

from pixcal.stages.astrometry.stage import Config, run
from pixcal.stages.astrometry.summary import table

__all__ = ["Config", "run", "table"]
