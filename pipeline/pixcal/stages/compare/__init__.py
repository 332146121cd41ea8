"""``pixcal compare``: repeatability, from maps of the same pixels."""

from pixcal.model.options import Compare as Config
from pixcal.stages.compare.stage import run

__all__ = ["Config", "run"]
