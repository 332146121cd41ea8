"""Body of the command ``pixcal allan``."""

from pixcal.model.options import Allan as Config
from pixcal.stages.allan.stage import run

__all__ = ["Config", "run"]
