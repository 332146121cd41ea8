"""``pixcal simulate``: an acquisition as a bench would write it, and its truth separately."""

from pixcal.model.options import Simulate as Config
from pixcal.stages.simulate.stage import acquire, run

__all__ = ["Config", "acquire", "run"]
