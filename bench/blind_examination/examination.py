"""The steps of ``pixcal blind`` and their options."""

from blind_examination.cases import make
from blind_examination.marking import score
from blind_examination.options import MakeConfig, RunConfig, ScoreConfig
from blind_examination.running import run

__all__ = ["MakeConfig", "RunConfig", "ScoreConfig", "make", "run", "score"]
