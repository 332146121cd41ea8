"""From FITS frames to checksummed cubes."""

from pixcal.stages.ingest.stage import Config, run

__all__ = ["Config", "run"]
