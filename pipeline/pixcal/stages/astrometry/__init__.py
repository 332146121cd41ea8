"""What the maps are for: the error of star centroids without them and with them."""

from pixcal.stages.astrometry.stage import Config, run
from pixcal.stages.astrometry.summary import table

__all__ = ["Config", "run", "table"]
