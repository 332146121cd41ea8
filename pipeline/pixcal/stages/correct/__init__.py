"""``pixcal fit --with-diagnosis``: offset maps without the effects that a diagnosis found."""

from pixcal.stages.correct.stage import Config, attempt, run

__all__ = ["Config", "attempt", "run"]
