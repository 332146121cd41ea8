"""``pixcal allan``: how the error of the offsets falls with the number of frames."""

from pixcal.model.options import Allan as Config
from pixcal.stages.allan.stage import run

__all__ = ["Config", "run"]
