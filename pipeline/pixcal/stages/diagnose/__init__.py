"""``pixcal diagnose``: the gap between an acquisition and its simulation, and what causes it."""

from pixcal.stages.diagnose.stage import Config, run

__all__ = ["Config", "run"]
