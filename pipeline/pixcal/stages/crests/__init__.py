"""``pixcal crests``: the fringe fit held against crests traced in single frames."""

from pixcal.stages.crests.stage import STAGE, Config, run

__all__ = ["STAGE", "Config", "run"]
