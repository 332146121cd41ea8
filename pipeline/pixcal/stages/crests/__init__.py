"""``pixcal crests``: an independent check of the fit, from crests traced in single frames."""

from pixcal.model.options import Crests as Config
from pixcal.stages.crests.stage import run

__all__ = ["Config", "run"]
