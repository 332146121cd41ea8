"""``pixcal diagnose``: the gap between an acquisition and its simulation, and what causes it."""

from pixcal.model.options import Diagnose as Config
from pixcal.stages.diagnose.stage import run

__all__ = ["Config", "run"]
