"""``pixcal crests``: an independent check of the fit, from crests traced in single frames."""

from pixcal.stages.crests.stage import STAGE, Config, run

__all__ = ["STAGE", "Config", "run"]
