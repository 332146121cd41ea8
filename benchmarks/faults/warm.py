"""Imported once, by the server that all commands are forked from: loads and compiles everything."""

import tempfile
from pathlib import Path

import pixcal_cli.main  # noqa: F401
from pixcal.engine.run import Runtime
from pixcal.stages import allan, correct, diagnose, fit, ingest, reduce, report, simulate

BENCH = Path(__file__).parents[2] / "tests" / "bench.yaml"
SYNC = Runtime("sync")
LATE = (correct, diagnose, report)  # commands import these late, some as who cannot compile

with tempfile.TemporaryDirectory() as folder:
    acquisition, run = Path(folder, "acquisition"), Path(folder, "run")
    simulate.run(BENCH, acquisition, simulate.Config(), SYNC)
    ingest.run(acquisition, run, ingest.Config(), SYNC)
    reduce.run(run, reduce.Config(), SYNC)
    fit.run(run, fit.Config(), SYNC)
    allan.run(run, allan.Config(), SYNC)
