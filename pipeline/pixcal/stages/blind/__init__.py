"""``pixcal blind``: an examination of the diagnosis, on data whose effects are withheld."""

from pixcal.stages.blind.cases import MakeConfig, make
from pixcal.stages.blind.marking import ScoreConfig, score
from pixcal.stages.blind.sitting import RunConfig, run

__all__ = ["MakeConfig", "RunConfig", "ScoreConfig", "make", "run", "score"]
