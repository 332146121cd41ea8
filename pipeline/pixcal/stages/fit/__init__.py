"""From reduced cubes to offset maps: sweep, shape of the fringes, combination, products."""

from pixcal.stages.fit.stage import Config, run

__all__ = ["Config", "run"]
