"""``pixcal budget``: frames and hours needed for a given precision."""

from pixcal.stages.budget.stage import Config, run

__all__ = ["Config", "run"]
