"""From FITS frames to checksummed cubes."""

from pixcal.model.options import Ingest as Config
from pixcal.stages.ingest.stage import run

__all__ = ["Config", "run"]
