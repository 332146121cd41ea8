"""``pixcal blind``: an examination of the diagnosis, on data whose effects are withheld."""

from pixcal.model.blind_options import MakeConfig, RunConfig, ScoreConfig
from pixcal.stages.blind.cases import make
from pixcal.stages.blind.marking import score
from pixcal.stages.blind.running import run

__all__ = ["MakeConfig", "RunConfig", "ScoreConfig", "make", "run", "score"]
