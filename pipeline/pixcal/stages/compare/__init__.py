"""``pixcal compare``: repeatability, from maps of the same pixels."""

from pixcal.stages.compare.stage import Config, run

__all__ = ["Config", "run"]
