"""``pixcal crests``: an independent check of the fit, from crests traced in single frames."""

from pixcal.model.options import Crests as Config
from pixcal.stages.crests.stage import STAGE, run

__all__ = ["STAGE", "Config", "run"]
