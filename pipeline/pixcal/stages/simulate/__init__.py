"""Body of the command ``pixcal simulate``."""

from pixcal.stages.simulate.stage import Config, acquire, run

__all__ = ["Config", "acquire", "run"]
