"""Body of the command ``pixcal allan``."""

from pixcal.stages.allan.stage import STAGE, Config, run

__all__ = ["STAGE", "Config", "run"]
