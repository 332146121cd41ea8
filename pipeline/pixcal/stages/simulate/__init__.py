"""Body of the command ``pixcal simulate``."""

from pixcal.model.options import Simulate as Config
from pixcal.stages.simulate.stage import acquire, run

__all__ = ["Config", "acquire", "run"]
