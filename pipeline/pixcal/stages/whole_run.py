"""``pixcal run``: all steps that an acquisition allows, from its frames to the report."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from pixcal.engine.run import Runtime
from pixcal.model import options
from pixcal.model.acquisition import load_acquisition
from pixcal.model.errors import InputError
from pixcal.stages import allan, correct, diagnose, fit, ingest, reduce, report
from pixcal.storage.lock import flushed_last

Config = options.Run
# called with a step's name and its folder; the step runs inside the context
Step = Callable[[str, Path], AbstractContextManager[None]]


def run(
    acquisition: Path,
    out: Path,
    config: Config,
    runtime: Runtime,
    step: Step = lambda _name, _folder: nullcontext(),
    note: Callable[[str], object] = lambda _text: None,
) -> tuple[bool, bool]:
    """Run all steps, each in the context ``step``; return whether the run was fitted and diagnosed.

    ``note`` receives the reason if diagnosis or correction is not possible, which is no error.
    """
    of_fit = fit.Config(model=config.model)
    with flushed_last(out):
        with step("ingest", out / "ingest"):
            of_ingest = ingest.Config(config.overwrite, config.copy, config.cubes)
            ingest.run(acquisition, out, of_ingest, runtime)
        with step("reduce", out / "reduce"):
            reduce.run(out, reduce.Config(gain=config.gain, cubes=config.cubes), runtime)
        fringes = bool(load_acquisition(acquisition).frames.fringes)
        if fringes:
            with step("fit", out / "fit"):
                fit.run(out, of_fit, runtime)
            with step("allan", out / "allan"):
                allan.run(out, options.Allan(), runtime)
    diagnosed = config.diagnosed
    if diagnosed:
        try:
            with step("diagnose", out / "diagnose"):
                diagnose.run(out, diagnose.Config(), runtime)
        except InputError as error:
            note(f"diagnosis skipped: {error}")
            diagnosed = False
    if diagnosed and fringes:
        with step("corrected", out / "corrected"):
            refused = correct.attempt(out, of_fit, runtime)
        if refused is not None:
            note(f"no corrected maps (use the maps as fitted): {refused}")
    with step("report", out / "report"):
        report.run(out, options.Report(), runtime)
    return fringes, diagnosed
