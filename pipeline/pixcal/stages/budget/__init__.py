"""``pixcal budget``: frames and hours needed for a given precision."""

from pixcal.model.options import Budget as Config
from pixcal.stages.budget.stage import run

__all__ = ["Config", "run"]
