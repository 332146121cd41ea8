"""``pixcal fit --with-diagnosis``: offset maps without the effects that a diagnosis found."""

from pixcal.model.options import Fit as Config
from pixcal.stages.correct.stage import attempt, run

__all__ = ["Config", "attempt", "run"]
