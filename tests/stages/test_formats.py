"""Whoever reads artefacts reads them in the formats that they are written in."""

from pixcal.api import opened
from pixcal.stages import allan, report
from pixcal.stages.correct import stage as correct
from pixcal.stages.diagnose import stage as diagnose
from pixcal.stages.fit import stage as fit
from pixcal.stages.fit import sweep
from pixcal.stages.ingest import stage as ingest
from pixcal.stages.reduce import stage as reduce

WRITTEN = {
    "ingest": ingest.FORMAT,
    "reduce": reduce.FORMAT,
    "sweep": sweep.FORMAT,
    "fit": fit.FORMAT,
    "allan": allan.FORMAT,
    "diagnose": diagnose.FORMAT,
    "corrected": correct.FORMAT,
    "report": report.FORMAT,
}


def test_readers_know_the_formats() -> None:
    for known in (opened.FORMATS, report.SHOWN_STAGES):
        assert known == {stage: WRITTEN[stage] for stage in known}
