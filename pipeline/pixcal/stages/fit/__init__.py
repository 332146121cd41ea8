"""From reduced cubes to offset maps: sweep, shape of the fringes, combination, products."""

from pixcal.model.options import Fit as Config
from pixcal.stages.fit.stage import run

__all__ = ["Config", "run"]
